"""Readers of files that this project writes: weights and their cards, data sets, what a training goes on from."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from refu_core import load_body, load_garment
from refu_core.backbones import BasisDecoder, MlpConfig, TailorNetConfig, build_backbone, save_backbone, save_basis
from refu_core.backbones._files import read_backbone
from refu_core.repulsion import Refu, read_refu, refu_tensors
from refu_core.sdf._neural import SDF_PRESETS, SdfNetwork, load_sdf_network, save_sdf_network
from refu_core.simulation import GarmentDataset, GarmentSequences
from refu_core.simulation._store import FORMAT, SEQUENCES, sample_columns, sequence_columns
from refu_core.training import TrainingLog, load_checkpoint, save_checkpoint
from refu_ros.fuzz._containers import GADGETS, MOST_READ, mutate_npy, mutate_zip, npy_bytes, pack_zip
from refu_ros.fuzz._mutate import ODD_VALUES, mutate_bytes, mutate_json

if TYPE_CHECKING:
    import random

_GARMENT = "short-pant-male"
_SIZES: list[Any] = [
    *ODD_VALUES,
    10**6,
    10**9,
    [10**6],
    [10**9, 10**9],
    [1] * 3000,
    "relu",
    "rotvec",
    "distance",
    -5,
    [0],
    1e9,
]


class WeightTensors:
    """The tensors of a backbone, with a card that vouches for them."""

    def __init__(self, folder: Path) -> None:
        self._stem, self._garment = small_weights(folder / "weights", TailorNetConfig)
        self._path = Path(f"{self._stem}.safetensors")
        self._card = json.loads(Path(f"{self._stem}.json").read_text())
        good = self._path.read_bytes()
        (length,) = struct.unpack_from("<Q", good)
        self.seeds = [good, good[: 8 + length], struct.pack("<Q", 2) + b"{}", struct.pack("<Q", 1 << 60) + good[8:]]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """The header as JSON, or bytes."""
        length = struct.unpack_from("<Q", data)[0] if len(data) > 8 else 0
        if rng.random() < 0.6 and length < len(data):
            header = mutate_json(rng, data[8 : 8 + length])
            return struct.pack("<Q", len(header)) + header + data[8 + length :]
        return mutate_bytes(rng, data, other)

    def execute(self, data: bytes) -> None:
        """Loads the backbone and the layer."""
        self._path.write_bytes(data)
        card = self._card | {"sha256": hashlib.sha256(data).hexdigest()}
        Path(f"{self._stem}.json").write_text(json.dumps(card))
        read_backbone(self._stem, self._garment, expect={"garment": self._garment.name})
        read_refu(self._stem)


class WeightCard:
    """The card of a backbone: sizes that nobody can have, above all."""

    def __init__(self, folder: Path) -> None:
        self._pairs = [small_weights(folder / config.__name__, config) for config in (TailorNetConfig, MlpConfig)]
        self.seeds = [Path(f"{stem}.json").read_bytes() for stem, _ in self._pairs]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:  # noqa: ARG002
        """Values of the card."""
        return mutate_json(rng, data, _SIZES)

    def execute(self, data: bytes) -> None:
        """Loads the backbone and the layer."""
        stem, garment = self._pairs[b'"mlp"' in data]
        Path(f"{stem}.json").write_bytes(data)
        read_refu(stem)
        read_backbone(stem, garment, expect={"garment": garment.name})


class DistanceCard:
    """The card of a network for the body's distance."""

    def __init__(self, folder: Path) -> None:
        self._body = load_body("male")
        self._stem = folder / "sdf"
        network = SdfNetwork(SDF_PRESETS["tiny"])
        save_sdf_network(self._stem, network, {"body_fingerprint": self._body.fingerprint})
        self.seeds = [Path(f"{self._stem}.json").read_bytes()]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:  # noqa: ARG002
        """Values of the card."""
        return mutate_json(rng, data, _SIZES)

    def execute(self, data: bytes) -> None:
        """Loads the network."""
        Path(f"{self._stem}.json").write_bytes(data)
        load_sdf_network(self._stem, self._body)


class DataSet:
    """A data set of samples: its card and its arrays, one of them damaged. The first line says which."""

    kind = FORMAT

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "set"
        self._files = {
            name: content
            for name, content in _set_files(self.kind).items()
            if not name.endswith(("seconds.npy", "speed.npy"))
        }
        for name, content in _set_files(self.kind).items():
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        self.seeds = [name.encode() + b"\n" + content for name, content in self._files.items()]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:  # noqa: ARG002
        """The card as JSON, an array by its header and its bytes."""
        name, _, content = data.partition(b"\n")
        changed = mutate_json(rng, content, _SIZES) if name.endswith(b".json") else mutate_npy(rng, content)
        return name + b"\n" + changed

    def execute(self, data: bytes) -> None:
        """Opens the set and reads all rows, then puts the file right again."""
        first, _, content = data.partition(b"\n")
        name = first.decode("utf-8", "replace")
        if name not in self._files:
            return
        path = self._folder / name
        path.write_bytes(content)
        try:
            self._read()
        finally:
            path.write_bytes(self._files[name])

    def _read(self) -> None:
        dataset = GarmentDataset(self._folder)
        for i in range(min(len(dataset), MOST_READ)):
            assert np.isfinite(dataset.sample(i).vertices).all(), "a garment that isn't finite"
        dataset.column("asked")


class SequenceSet(DataSet):
    """A data set of sequences."""

    kind = SEQUENCES

    def _read(self) -> None:
        sequences = GarmentSequences(self._folder)
        for i in range(min(len(sequences), MOST_READ)):
            assert np.isfinite(sequences.sequence(i).vertices()).all(), "a garment that isn't finite"


class Checkpoint:
    """What a training goes on from."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "checkpoint.pt"
        save_checkpoint(self._path, {"identity": "x", "done": ["a"], "stage": None, "model": {"w": torch.ones(3, 2)}})
        good = self._path.read_bytes()
        self.seeds = [
            good,
            *(pack_zip([("archive/data.pkl", gadget + b"."), ("archive/version", b"3\n")]) for gadget in GADGETS),
        ]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Members of the archive, and bytes."""
        return mutate_zip(rng, data, other)

    def execute(self, data: bytes) -> None:
        """Loads it."""
        self._path.write_bytes(data)
        load_checkpoint(self._path)


class LossLog:
    """The loss curves of a training that was interrupted."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        log = TrainingLog(folder, name="log", quiet=True)
        for step in (10, 20):
            log.check("low", step, train=1.0, validation=2.0)
        self._path = folder / "log.jsonl"
        self.seeds = [self._path.read_bytes()]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Lines and values."""
        lines = data.split(b"\n")
        at = rng.randrange(len(lines))
        lines[at] = mutate_json(rng, lines[at]) if rng.random() < 0.7 else mutate_bytes(rng, lines[at], other)
        return b"\n".join(lines)

    def execute(self, data: bytes) -> None:
        """Goes on with it."""
        self._path.write_bytes(data)
        TrainingLog(self._folder, name="log", quiet=True).begin("low", step=15, steps=20)


def small_weights(folder: Path, kind: type[TailorNetConfig] | type[MlpConfig]) -> tuple[Path, Any]:
    """Stem of untrained weights with a ReFU layer, small in all but the number of vertices, and their garment."""
    garment = load_garment(_GARMENT)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        basis = BasisDecoder(
            torch.zeros(garment.n_vertices, 3), torch.linalg.qr(torch.randn(3 * garment.n_vertices, 4)).Q.T
        )
        sizes: dict[str, Any] = (
            {"low": (4,), "high": (4,), "style_shape": (4,)} if kind is TailorNetConfig else {"hidden": (4, 4)}
        )
        network = build_backbone(kind((0, 1, 2), **sizes), garment, basis=basis, pivots=torch.randn(2, 14))
        layer = Refu(garment.n_vertices, least=0.0)
    folder.mkdir(parents=True, exist_ok=True)
    card = {"garment": garment.name, "body_fingerprint": load_body(garment.body).fingerprint}
    save_basis(folder, basis, card)
    name = "tailornet" if kind is TailorNetConfig else "mlp"
    stem = folder / f"{name}-hybrid"
    save_backbone(stem, network, {**card, "refu": layer.config}, others=refu_tensors(layer))
    return stem, garment


def _set_files(kind: str) -> dict[str, bytes]:
    """The files of a data set of three rows."""
    rows, n, frames = 3, 5, 4
    is_sequences = kind == SEQUENCES
    columns = sequence_columns((frames, n, 3)) if is_sequences else sample_columns((n, 3))
    files = {}
    for name, (shape, dtype) in columns.items():
        array = np.zeros((rows, *shape), dtype)
        if name == "slot":
            array[:] = np.arange(rows)
        if name == "state":
            array[:] = 1
        files[f"shard-0-of-1/{name}.npy"] = npy_bytes(array)
    if not is_sequences:
        files["unseen.npy"] = npy_bytes(np.zeros(rows, np.float32))
        files["asked.npy"] = npy_bytes(np.zeros((rows, 24, 3), np.float32))
    card = {
        "format": kind,
        "garment": _GARMENT,
        "body": "male",
        "body_fingerprint": "0",
        "quantum_m": 2.0**-14,
        "plan": {"garment": _GARMENT, "count": rows, "seed": 0, "pivots": 4},
        "clips": {"train": ["walk"], "test": ["run"]},
        "settings": asdict(MlpConfig((0,))),
    }
    return {"card.json": json.dumps(card).encode(), **files}
