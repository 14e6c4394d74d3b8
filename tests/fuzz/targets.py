"""All that is fuzzed: every reader of what somebody else has written, by name."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml
from hypothesis import strategies as st

import msg_adapters as adapters
from refu_core import FrameError, load_body
from refu_core.backbones import MlpConfig, TailorNetConfig
from refu_core.fitting import read_surface
from refu_core.refu import trained_from_weights
from refu_core.sdf._neural import SDF_PRESETS, SdfNetwork, load_sdf_network, save_sdf_network
from refu_core.simulation import GarmentDataset, GarmentSequences, load_clips
from refu_core.simulation._store import FORMAT, SEQUENCES
from refu_core.training import TrainingLog
from refu_core.training._record import load_checkpoint, save_checkpoint
from refu_core.weights import load_weights
from tests.fuzz import corpus
from tests.fuzz import messages as ms
from tests.fuzz.containers import near_mcap, near_npy, near_zip, pack_zip, split_mcap
from tests.fuzz.strategies import Special, edited, near, near_file, near_json, place

if TYPE_CHECKING:
    from hypothesis.strategies import DrawFn, SearchStrategy

MOST_READ = 200
"""Messages, frames or rows that are read of each file."""

Reader = tuple["SearchStrategy[Any]", Callable[[Any], None]]
"""What is read, and the reader: it returns or raises `RefuError`, an `AssertionError` being a finding, too."""


@dataclass(frozen=True)
class Target:
    """A reader by name."""

    name: str
    what: str
    """What is read, in a few words."""
    open: Callable[[Path], Reader]
    """Makes the reader, which may write below a folder of its own."""
    examples: int = 60
    """In each run of the suite."""


# Bags and motion ----------------------------------------------------------------------------------


def _read_bag(path: Path) -> None:
    """All there is, as messages and as frames."""
    with adapters.BagReader(path) as reader:
        for topic in reader.topics[:MOST_READ]:
            assert topic.message_count >= 0, "a negative count"
        for message in itertools.islice(reader.messages(), MOST_READ):
            assert 0 <= message.log_time_ns < 2**63, "a time that ROS can't hold"
    for kind in ("multiarray", "smpl_msgs"):
        with contextlib.suppress(adapters.AdapterError):
            for record in itertools.islice(adapters.open_smpl_bag(path, topic=f"/{kind}/smpl_params"), MOST_READ):
                assert (record.frame is None) != (record.error is None), "a record that is neither frame nor error"
                if record.frame is not None:
                    ms.check_frame(record.frame)


def _mcap(folder: Path) -> Reader:
    path = folder / "bag.mcap"
    seeds = corpus.bags(path)
    whole = [seed for seed in seeds if len(split_mcap(seed)) > 2]

    def read(content: bytes | Special) -> None:
        place(path, content)
        _read_bag(path)

    return near_file(st.sampled_from(seeds) | near_mcap(whole) | near_mcap(whole) | near_mcap(whole)), read


def _bag_folder(folder: Path) -> Reader:
    bag = folder / "bag"
    metadata, name = corpus.bag_folder(bag)
    content = (bag / name).read_bytes()
    seeds = [metadata, corpus.BOMB_YAML, corpus.MERGED_YAML, b"[" * 20_000, b"a: " * 5000]
    seeds.append(metadata.replace(b"- " + name.encode(), (b"- " + name.encode() + b"\n  ") * 3000))
    seeds += [metadata.replace(name.encode(), other) for other in (b"/dev/zero", b"../bag", b".", b'"\\0"', b"\x1b[2J")]
    values = json.dumps(yaml.safe_load(metadata)).encode()  # what is JSON is YAML, too
    texts = near(seeds, corpus.YAML_WORDS) | near_json([values])

    def read(drawn: tuple[bytes | Special, bytes | Special]) -> None:
        place(bag / "metadata.yaml", drawn[0])
        place(bag / name, drawn[1])
        _read_bag(bag)

    return st.tuples(near_file(texts), near_file(st.just(content))), read


def _motion_pickle(folder: Path) -> Reader:
    """What trackers write."""
    path = folder / "file.pkl"

    def read(content: bytes | Special) -> None:
        place(path, content)
        motion = adapters.read_motion(path, fps=30.0)
        for i in range(min(len(motion), MOST_READ)):
            with contextlib.suppress(FrameError):
                ms.check_frame(motion.frame(i))

    return near_file(near(corpus.motion_pickles(), corpus.GADGETS)), read


def _sqlite(folder: Path) -> Reader:
    path = folder / "bag.db3"

    def read(content: bytes | Special) -> None:
        place(path, content)
        _read_bag(path)

    return near_file(near([corpus.sqlite_bag(folder / "seed.db3")])), read


def _bvh(folder: Path) -> Reader:
    path = folder / "file.bvh"

    def read(content: bytes | Special) -> None:
        place(path, content)
        adapters.read_motion(path)

    return near_file(near([corpus.BVH], corpus.BVH_WORDS)), read


def _mesh(folder: Path) -> Reader:
    seeds = corpus.meshes()

    def read(drawn: tuple[str, bytes | Special]) -> None:
        suffix, content = drawn
        place(folder / f"file{suffix}", content)
        read_surface(folder / f"file{suffix}")

    def one(suffix: str) -> SearchStrategy[tuple[str, bytes | Special]]:
        contents = near_json([seeds[suffix]]) if suffix == ".gltf" else near([seeds[suffix]], corpus.MESH_WORDS)
        return st.tuples(st.just(suffix), near_file(contents))

    return st.one_of(*map(one, seeds)), read


def _motion(folder: Path) -> Reader:
    path = folder / "file.npz"

    def read(content: bytes | Special) -> None:
        """By both of its readers; its frames, and resampled."""
        place(path, content)
        try:
            motion = adapters.read_motion(path)
        except adapters.AdapterError:
            load_clips(path)
            return
        for i in range(min(len(motion), MOST_READ)):
            with contextlib.suppress(FrameError):  # a frame that isn't finite is refused by itself
                ms.check_frame(motion.frame(i))
        if len(motion) / motion.fps < 100:
            motion.resampled(30.0)

    return near_file(near_zip(corpus.motions())), read


# Bodies -------------------------------------------------------------------------------------------


def _body(name: str, contents: Callable[[], SearchStrategy[bytes]]) -> Callable[[Path], Reader]:
    def open_body(folder: Path) -> Reader:
        path = folder / name

        def read(content: bytes | Special) -> None:
            place(path, content)
            body = load_body(path)
            assert torch.isfinite(body(np.zeros((1, 24, 3))).vertices).all(), "a body that isn't finite"

        return near_file(contents()), read

    return open_body


# Weights, data sets, trainings --------------------------------------------------------------------


def _tensors(folder: Path) -> Reader:
    stem, garment = corpus.small_weights(folder / "weights", TailorNetConfig)
    path, card_path = Path(f"{stem}.safetensors"), Path(f"{stem}.json")
    card = json.loads(card_path.read_text())
    good = path.read_bytes()
    (length,) = struct.unpack_from("<Q", good)
    seeds = [good, good[: 8 + length], struct.pack("<Q", 2) + b"{}", struct.pack("<Q", 1 << 60) + good[8:]]
    types = [good.replace(b'"F32"', name) for name in (b'"F64"', b'"BOOL"', b'"F8_E4M3"', b'"I32"', b'"C64"')]

    @st.composite
    def near_tensors(draw: DrawFn) -> bytes:
        header = draw(near_json([good[8 : 8 + length]]))
        return struct.pack("<Q", len(header)) + header + good[8 + length :]

    def read(content: bytes | Special) -> None:
        """With a card that vouches for them: the backbone and the layer."""
        place(path, content)
        digest = hashlib.sha256(content).hexdigest() if isinstance(content, bytes) else "0" * 64
        card_path.write_text(json.dumps(card | {"sha256": digest}))
        trained_from_weights(load_weights(stem, expect={"garment": garment.name}), garment)

    return near_file(near_tensors() | near(seeds) | st.sampled_from(types)), read


def _card(folder: Path) -> Reader:
    pairs = [corpus.small_weights(folder / config.__name__, config) for config in (TailorNetConfig, MlpConfig)]
    seeds = [Path(f"{stem}.json").read_bytes() for stem, _ in pairs]

    def read(content: bytes | Special) -> None:
        stem, garment = pairs[isinstance(content, bytes) and b'"mlp"' in content]
        place(Path(f"{stem}.json"), content)
        trained_from_weights(load_weights(stem, expect={"garment": garment.name}), garment)

    return near_file(near_json(seeds)), read


def _distance_card(folder: Path) -> Reader:
    body, stem = load_body("male"), folder / "sdf"
    save_sdf_network(stem, SdfNetwork(SDF_PRESETS["tiny"]), {"body_fingerprint": body.fingerprint})
    path = Path(f"{stem}.json")
    seeds = [path.read_bytes()]

    def read(content: bytes | Special) -> None:
        place(path, content)
        load_sdf_network(stem, body)

    return near_file(near_json(seeds)), read


def _data_set(kind: str) -> Callable[[Path], Reader]:
    def open_set(folder: Path) -> Reader:
        files = corpus.set_files(kind)
        names = [name for name in files if not name.endswith(("seconds.npy", "speed.npy"))]
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)

        def one(name: str) -> SearchStrategy[tuple[str, bytes | Special]]:
            contents = near_json([files[name]]) if name.endswith(".json") else near_npy(files[name])
            return st.tuples(st.just(name), near_file(contents))

        def read(drawn: tuple[str, bytes | Special]) -> None:
            """Opens a set with one file changed and reads all rows, then puts the file right again."""
            name, content = drawn
            place(folder / name, content)
            try:
                _read_set(folder, kind)
            finally:
                place(folder / name, files[name])

        return st.one_of(*map(one, [*names, "card.json", "card.json"])), read

    return open_set


def _read_set(folder: Path, kind: str) -> None:
    if kind == SEQUENCES:
        sequences = GarmentSequences(folder)
        for i in range(min(len(sequences), MOST_READ)):
            assert np.isfinite(sequences.sequence(i).vertices()).all(), "a garment that isn't finite"
        return
    dataset = GarmentDataset(folder)
    for i in range(min(len(dataset), MOST_READ)):
        assert np.isfinite(dataset.sample(i).vertices).all(), "a garment that isn't finite"


def _checkpoint(folder: Path) -> Reader:
    path = folder / "checkpoint.pt"
    save_checkpoint(path, {"identity": "x", "done": ["a"], "stage": None, "model": {"w": torch.ones(3, 2)}})
    good = path.read_bytes()
    seeds = [pack_zip([("archive/data.pkl", gadget + b"."), ("archive/version", b"3\n")]) for gadget in corpus.GADGETS]

    def read(content: bytes | Special) -> None:
        place(path, content)
        load_checkpoint(path)

    return near_file(st.sampled_from(seeds) | near_zip([good]) | near_zip([good]) | edited(good)), read


def _loss_log(folder: Path) -> Reader:
    log = TrainingLog(folder, name="log", quiet=True)
    for step in (10, 20):
        log.check("low", step, train=1.0, validation=2.0)
    path = folder / "log.jsonl"
    lines = path.read_bytes().splitlines()

    def read(content: bytes | Special) -> None:
        """Goes on with it, as a training that was interrupted."""
        place(path, content)
        TrainingLog(folder, name="log", quiet=True).begin("low", step=15, steps=20)

    return near_file(st.lists(near_json(lines), max_size=3).map(b"\n".join)), read


_ALL = (
    Target("multiarray", "std_msgs/Float32MultiArray in CDR", ms.cdr("multiarray")),
    Target("joint_state", "sensor_msgs/JointState in CDR", ms.cdr("joint_state")),
    Target("pose_array", "geometry_msgs/PoseArray in CDR", ms.cdr("pose_array")),
    Target("smpl_msgs", "smpl_msgs/Smpl in CDR", ms.cdr("smpl_msgs")),
    Target("definition", "the .msg text that a bag carries", ms.definition),
    Target("markers", "visualization_msgs/MarkerArray in CDR", ms.markers),
    Target("surroundings", "transforms, tracked ids, cameras and points in CDR", ms.surroundings),
    Target("encoder", "odd meshes to a MarkerArray", ms.encoder),
    Target("parameters", "parameters of the node", ms.parameters),
    Target("arguments", "command lines", ms.arguments),
    Target("mcap", "MCAP files", _mcap, 40),
    Target("bag", "rosbag2 directories", _bag_folder, 40),
    Target("db3", "SQLite bags", _sqlite, 40),
    Target("bvh", "motion as .bvh", _bvh),
    Target("mesh", "meshes of garments: .obj, .ply, .stl, .off, .glb, .gltf", _mesh),
    Target("motion", "AMASS-style .npz", _motion),
    Target("motion_pkl", "motion as .pkl, as trackers write it", _motion_pickle),
    Target("body_npz", "bodies as .npz", _body("file.npz", lambda: near_zip(corpus.body_archives()))),
    Target(
        "body_pkl", "bodies as official .pkl", _body("file.pkl", lambda: near(corpus.body_pickles(), corpus.GADGETS))
    ),
    Target("tensors", "weights as safetensors", _tensors),
    Target("card", "cards of weights", _card),
    Target("distance_card", "cards of distance networks", _distance_card),
    Target("data_set", "data sets of samples", _data_set(FORMAT)),
    Target("sequences", "data sets of sequences", _data_set(SEQUENCES)),
    Target("checkpoint", "checkpoints of a training", _checkpoint),
    Target("loss_log", "loss curves of a training", _loss_log),
)
TARGETS: dict[str, Target] = {target.name: target for target in _ALL}
"""What is fuzzed, by name."""
