"""Readers of files that others wrote: bags, motions, bodies."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import pickle
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

import msg_adapters as adapters
from refu_core import FrameError, load_body
from refu_core.simulation import load_clips
from refu_ros.fuzz._containers import (
    GADGETS,
    MOST_READ,
    join_mcap,
    mcap_chunk,
    mutate_mcap,
    mutate_pickle,
    mutate_zip,
    npy_bytes,
    pack_zip,
    split_mcap,
)
from refu_ros.fuzz._messages import check_frame, some_frame
from refu_ros.fuzz._mutate import mutate_text

if TYPE_CHECKING:
    import random

    from numpy.typing import NDArray

_YAML_WORDS = [
    b"\n",
    b":",
    b"-",
    b"&a",
    b"*a",
    b"<<:",
    b"!!python/object:os.system",
    b"[",
    b"{",
    b"mcap",
    b"0",
    b"~",
    b"9" * 99,
]
_BOMB_YAML = "\n".join(
    ["rosbag2_bagfile_information:", "  storage_identifier: mcap", "  a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    + [f"  a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    + ["  relative_file_paths: [*a9]"]
).encode()


class Bag:
    """An MCAP file: its topics, its messages, and its frames."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "bag.mcap"
        self.seeds: list[bytes] = []
        for compression in ("zstd", "none"):
            with adapters.BagWriter(self._path, compression=compression, chunk_bytes=900, overwrite=True) as writer:
                for kind in ("multiarray", "smpl_msgs"):
                    writer.add_topic(f"/{kind}/smpl_params", adapters.INPUT_TYPES[kind])
                    for i in range(3):
                        data = adapters.encoder_for(kind)(some_frame(i))
                        writer.write(f"/{kind}/smpl_params", data, log_time_ns=1 + i)
            self.seeds.append(self._path.read_bytes())
        # Bombs: much of nothing, of records that are too small to be any, and of empty messages; and a claim.
        first = split_mcap(self.seeds[0])[:1]
        for records in (bytes(48 << 20), b"\x7f" + bytes(8), struct.pack("<BQ", 5, 22) + bytes(22)):
            many = records * max(1, (48 << 20) // len(records))
            self.seeds += [
                join_mcap([*first, (6, mcap_chunk(many))]),
                join_mcap([*first, (6, mcap_chunk(records, claimed=1 << 60))]),
            ]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Records, the content of chunks, and bytes."""
        return mutate_mcap(rng, data, other)

    def execute(self, data: bytes) -> None:
        """Reads all there is."""
        self._path.write_bytes(data)
        with adapters.BagReader(self._path) as reader:
            for topic in reader.topics[:MOST_READ]:
                assert topic.message_count >= 0, "a negative count"
            for message in itertools.islice(reader.messages(), MOST_READ):
                assert 0 <= message.log_time_ns < 2**63, "a time that ROS can't hold"
        for kind in ("multiarray", "smpl_msgs"):
            try:
                bag = adapters.open_smpl_bag(self._path, topic=f"/{kind}/smpl_params")
            except adapters.AdapterError:
                continue
            for record in itertools.islice(bag, MOST_READ):
                assert (record.frame is None) != (record.error is None), "a record that is neither frame nor error"
                if record.frame is not None:
                    check_frame(record.frame)


class BagMetadata:
    """The metadata.yaml of a rosbag2 directory."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "bag"
        with adapters.BagWriter(self._folder) as writer:
            writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
            writer.write("/smpl_params", adapters.encoder_for("multiarray")(some_frame()), log_time_ns=5)
        self._path = self._folder / "metadata.yaml"
        merged = _BOMB_YAML.replace(b"[*a9]", b"[x]") + b"\n  z: {<<: [*a8, *a9]}"
        self.seeds = [self._path.read_bytes(), _BOMB_YAML, merged, b"[" * 20_000, b"a: " * 5000]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:  # noqa: ARG002
        """Text."""
        return mutate_text(rng, data, _YAML_WORDS)

    def execute(self, data: bytes) -> None:
        """Opens the directory."""
        self._path.write_bytes(data)
        with adapters.BagReader(self._folder) as reader:
            assert reader.topics is not None


class _Archive:
    """An `.npz` of some arrays."""

    def __init__(self, folder: Path, arrays: list[dict[str, NDArray[Any]]]) -> None:
        self._path = folder / "file.npz"
        self.seeds = [_npz(content) for content in arrays]
        claims = pack_zip([(f"{name}.npy", _claiming(array)) for name, array in arrays[0].items()])
        size = struct.pack("<II", 1 << 20, (1 << 32) - 2)
        self.seeds += [claims, self.seeds[0].replace(self.seeds[0][-60:-52], size)]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Members, their headers, and bytes."""
        return mutate_zip(rng, data, other)


class MotionFile(_Archive):
    """An AMASS-style motion, by both of its readers."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(0)
        common = {"trans": rng.normal(size=(4, 3)), "betas": rng.normal(size=16), "mocap_framerate": np.array(30.0)}
        motions = [{"poses": rng.normal(size=(4, width)), **common} for width in (72, 156, 165)]
        motions.append(
            {"poses": np.zeros((1, 72), np.float32), "mocap_frame_rate": np.array([30]), "gender": np.array(b"male")}
        )
        super().__init__(folder, motions)

    def execute(self, data: bytes) -> None:
        """Reads the motion, its frames, and resamples it."""
        self._path.write_bytes(data)
        try:
            motion = adapters.read_motion(self._path)
        except adapters.AdapterError:
            load_clips(self._path)
            return
        for i in range(min(len(motion), MOST_READ)):
            with contextlib.suppress(FrameError):  # a frame that isn't finite is refused by itself
                check_frame(motion.frame(i))
        if len(motion) / motion.fps < 100:
            motion.resampled(30.0)


class BodyArchive(_Archive):
    """A body model as `.npz`."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, [_model(8)])

    def execute(self, data: bytes) -> None:
        """Loads and poses the body."""
        self._path.write_bytes(data)
        _pose_body(self._path)


class BodyPickle:
    """A body model as an official `.pkl`."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "file.pkl"
        self.seeds = [*(pickle.dumps(_model(6), protocol) for protocol in range(5)), _chumpy_pickle()]
        self.seeds += [self.seeds[2][:-1] + gadget + b"." for gadget in GADGETS]
        self.seeds.append(
            b"(dS'f'\n" + b"cchumpy.ch\nCh\n)\x81q\x01}S'x'\nh\x01sbs."
        )  # a variable that is its own value

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Opcodes and bytes."""
        return mutate_pickle(rng, data, other)

    def execute(self, data: bytes) -> None:
        """Loads and poses the body."""
        self._path.write_bytes(data)
        _pose_body(self._path)


def _npz(arrays: dict[str, NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _claiming(array: NDArray[Any]) -> bytes:
    """An array file that claims to hold a million times as much as there is."""
    header = npy_bytes(np.zeros((1, *array.shape[1:]), array.dtype)) if array.ndim else npy_bytes(array)
    return header.replace(b"(1,", b"(1000000000000,").replace(b", }" + b" " * 12, b", }")


def _model(n: int) -> dict[str, NDArray[Any]]:
    """An SMPL-layout body of `n` vertices."""
    rng = np.random.default_rng(n)
    weights = rng.random((n, 24))
    parents = [2**32 - 1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
    return {
        "v_template": rng.normal(size=(n, 3)),
        "f": np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": np.full((24, n), 1 / n),
        "kintree_table": np.array([parents, range(24)]),
        "shapedirs": rng.normal(size=(n, 3, 10)),
        "posedirs": rng.normal(size=(n, 3, 207)),
    }


def _chumpy_pickle() -> bytes:
    """A pickle as the official files are: text opcodes, chumpy variables, a sparse regressor."""
    model = _model(6)
    body = b"(d"
    for name, array in model.items():
        value = pickle.dumps(array, 2)[2:-1]
        if name == "shapedirs":
            value = b"cchumpy.ch\nCh\n)\x81}S'x'\n" + value + b"sb"
        elif name == "J_regressor":
            parts = {"data": array.T.ravel(), "indices": np.tile(np.arange(24), 6), "indptr": np.arange(0, 145, 24)}
            state = b"".join(
                b"S'%s'\n" % key.encode() + pickle.dumps(part, 2)[2:-1] + b"s" for key, part in parts.items()
            )
            value = b"cscipy.sparse.csc\ncsc_matrix\n)\x81}" + state + b"S'_shape'\n(K\x18K\x06tsb"
        body += b"S'%s'\n" % name.encode() + value + b"s"
    return body + b"."


def _pose_body(path: Path) -> None:
    body = load_body(path)
    assert torch.isfinite(body(np.zeros((1, 24, 3))).vertices).all(), "a body that isn't finite"


def working_folder() -> str | None:
    """Where files that live for a millisecond should lie: in memory where there is such a place."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
