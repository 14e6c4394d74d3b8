"""Readers of messages and parameters: CDR bytes, message objects, marker encoding, a node's settings."""

from __future__ import annotations

import json
import random
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

import msg_adapters as adapters
from refu_core import SmplFrame
from refu_ros._settings import NodeSettings, defaults
from refu_ros.fuzz._mutate import FLOATS, INTEGERS, ODD_VALUES, mutate_bytes, mutate_json, mutate_text

_WORDS = [
    b"float32[3]",
    b"float64[10]",
    b"float64[99999999]",
    b"transl",
    b"\n",
    b"====",
    b"#",
    b"std_msgs/Header",
    b"0" * 999,
]


_INTEGERS = (0, 1, 10**9, 2**31 - 1, -(2**31), *INTEGERS, *(-number for number in INTEGERS))


def some_frame(seed: int = 0, *, with_style: bool = False) -> SmplFrame:
    """A frame with all its fields set."""
    rng = np.random.default_rng(seed)
    pose, betas, style = (rng.normal(size=n).astype(np.float32) for n in (72, 10, 4))
    return SmplFrame(pose, betas=betas, transl=rng.normal(size=3), style=style if with_style else None, stamp_ns=7)


def check_frame(frame: SmplFrame) -> None:
    """What a decoder promises of a frame."""
    arrays = (frame.pose, frame.betas, frame.transl, *(() if frame.style is None else (frame.style,)))
    assert all(np.isfinite(array).all() for array in arrays), "a frame that isn't finite"
    assert [frame.pose.shape, frame.betas.shape, frame.transl.shape] == [(24, 3), (10,), (3,)], (
        "a frame of another shape"
    )


@dataclass(eq=False)
class CdrInput:
    """A message of an input type in CDR; what is decoded is encoded and decoded once more, to the same frame."""

    input_type: str
    definition: str | None = None
    seeds: list[bytes] = field(init=False)

    def __post_init__(self) -> None:
        self._decode = adapters.decoder_for(self.input_type, definition=self.definition).from_bytes
        self._encode = adapters.encoder_for(self.input_type)
        good = [self._encode(some_frame(seed, with_style=seed > 0)) for seed in range(2)]
        self.seeds = [*good, b"", b"\0\1\0\0", bytes(4096), b"\0\1\0\0" + b"\xff" * 4096]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Bytes, integers and floats of the message."""
        return mutate_bytes(rng, data, other)

    def execute(self, data: bytes) -> None:
        """Decodes, and checks what came out."""
        frame = self._decode(data)
        check_frame(frame)
        if 0 <= frame.stamp_ns < 2**61 and self.input_type != "pose_array":  # which doesn't carry betas
            again = self._decode(self._encode(frame))
            assert np.array_equal(again.pose, frame.pose), "encoded and decoded, the pose is another"


@dataclass(eq=False)
class SmplDefinition:
    """The text of a message type that came with a bag, by which smpl_msgs is read."""

    seeds: list[bytes] = field(init=False)

    def __post_init__(self) -> None:
        self.seeds = [adapters.message_definition("smpl_msgs/msg/Smpl").text.encode()]
        self._message = adapters.encoder_for("smpl_msgs")(some_frame())

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:  # noqa: ARG002
        """Text."""
        return mutate_text(rng, data, _WORDS)

    def execute(self, data: bytes) -> None:
        """Reads a message by the definition."""
        text = data.decode("utf-8", "replace")
        check_frame(adapters.decoder_for("smpl_msgs", definition=text).from_bytes(self._message))


@dataclass(eq=False)
class MarkerDecoding:
    """A MarkerArray in CDR."""

    seeds: list[bytes] = field(init=False)

    def __post_init__(self) -> None:
        faces = np.array([[0, 1, 2], [2, 1, 3]])
        self._faces = faces
        encoder = adapters.MarkerArrayEncoder([adapters.MarkerMesh("a/b", faces, 4, vertex_colors=True)])
        good = encoder.encode([np.eye(4, 3)], stamp_ns=5, colors=[np.ones((4, 4))])
        self.seeds = [
            good,
            adapters.encode_delete([("a", 0), ("b", 1)], stamp_ns=1),
            adapters.encode_delete_all(stamp_ns=1),
        ]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:
        """Bytes, integers and floats of the message."""
        return mutate_bytes(rng, data, other)

    def execute(self, data: bytes) -> None:
        """Decodes, and asks for the vertices."""
        for marker in adapters.decode_marker_array(data):
            adapters.vertices_from_points(marker.points, self._faces)


class _FromSeed:
    """Input that is a number, from which all the rest is drawn: for readers of objects."""

    @property
    def seeds(self) -> list[bytes]:
        """The first numbers."""
        return [i.to_bytes(8, "little") for i in range(16)]

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:  # noqa: ARG002
        """Another number."""
        return rng.randbytes(8)


class MarkerEncoding(_FromSeed):
    """Vertices, colours, faces and names of every kind, to a MarkerArray: refused, or decoded again to what went in."""

    def execute(self, data: bytes) -> None:
        """Encodes what the number stands for."""
        rng = random.Random(data)
        numbers = np.random.default_rng(int.from_bytes(data, "little"))

        def pick(usual: Any, *odd: Any) -> Any:
            return usual if rng.random() < 0.9 else rng.choice(odd)

        n, f = pick(4, 0, 1, 300), pick(7, 0, 1)
        faces = _odd_array(rng, numbers.integers(pick(0, -1), max(n, 1) + pick(0, 1), (f, 3)))
        name = pick("a/b", "", "\0", "é", "\ud800", "x" * 3000)
        color = tuple(pick(0.5, *FLOATS) for _ in range(pick(4, 3)))
        with_colors = rng.random() < 0.3
        mesh = adapters.MarkerMesh(name, faces, n, color=color, id=pick(0, *_INTEGERS), vertex_colors=with_colors)
        vertices = _odd_array(rng, numbers.normal(size=(n, 3)).astype(rng.choice((np.float32, np.float64))))
        colors = [_odd_array(rng, np.ones((n, 4)))] if with_colors != pick(False, True) else None
        stamp = pick(5, *_INTEGERS)
        transl = _odd_array(rng, numbers.normal(size=rng.choice((3, (1, 3)))))
        encoder = adapters.MarkerArrayEncoder(
            [mesh], frame_id=pick("map", "", "\ud800"), axes=rng.choice(("smpl", "frame"))
        )
        message = encoder.encode([vertices], stamp_ns=stamp, transl=pick(transl, None), colors=colors)
        (marker,) = adapters.decode_marker_array(message)
        assert (marker.ns, marker.stamp_ns, marker.points.shape) == (name, stamp, (3 * len(faces), 3)), "another marker"
        assert np.isfinite(marker.points).all(), "points that aren't finite"


class MessageObjects(_FromSeed):
    """Message objects whose fields are missing, or are of other kinds."""

    def execute(self, data: bytes) -> None:
        """Decodes the object that the number stands for."""
        rng = random.Random(data)
        odd = [*ODD_VALUES, object(), b"bytes", np.zeros((2, 2)), np.array(["x"]), np.float64("nan"), 1j]
        point = SimpleNamespace(x=0.0, y=1.0, z=2.0, w=1.0)
        header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=2), frame_id="map")
        names = [f"{joint}_{axis}" for joint in adapters.SMPL_JOINTS for axis in "xyz"]
        dimensions = [SimpleNamespace(label="pose", size=72, stride=72)]
        message = {
            "multiarray": {"layout": SimpleNamespace(dim=dimensions, data_offset=0), "data": np.zeros(72)},
            "joint_state": {"header": header, "name": names, "position": [0.0] * 72},
            "pose_array": {"header": header, "poses": [SimpleNamespace(position=point, orientation=point)] * 24},
            "smpl_msgs": {"header": header, "body_pose": [0.0] * 69, "global_orient": [0.0] * 3, "betas": [0.0] * 10}
            | {"transl": [0.0] * 3},
        }
        kind = rng.choice(list(message))
        fields: dict[str, Any] = message[kind]
        holders = (fields, vars(header), vars(header.stamp), vars(point), vars(dimensions[0]))
        for _ in range(rng.randrange(3)):
            holder = rng.choice(holders)
            holder[rng.choice(list(holder))] = rng.choice(odd)
        if rng.random() < 0.1:
            del fields[rng.choice(list(fields))]
        check_frame(adapters.decoder_for(kind).from_message(SimpleNamespace(**fields)))


@dataclass(eq=False)
class Parameters:
    """The parameters of the node."""

    seeds: list[bytes] = field(init=False)

    def __post_init__(self) -> None:
        self.seeds = [
            json.dumps(defaults()).encode(),
            json.dumps(
                {"garments": ["shirt-male"], "max_rate": 30, "style": [1, 0, 0, 0], "persons": ["a", "b"]}
            ).encode(),
        ]
        self._settings = NodeSettings()

    def mutate(self, rng: random.Random, data: bytes, other: bytes) -> bytes:  # noqa: ARG002
        """Values of all kinds."""
        return mutate_json(rng, data)

    def execute(self, data: bytes) -> None:
        """Takes the values over."""
        try:
            values = json.loads(data)
        except (ValueError, RecursionError):
            return
        if isinstance(values, dict):
            settings = self._settings.changed(values)
            assert settings.changed({}) == settings, "settings that aren't valid themselves"


def _odd_array(rng: random.Random, array: Any) -> Any:
    """The array, mostly as it is; otherwise of another shape or type, or with an odd number in it."""
    action = rng.randrange(60)
    if action == 0:
        return array.reshape(-1)
    if action == 1:
        return array[..., :2]
    if action == 2:
        return array.astype(rng.choice(("f2", "i4", "O", "c8", "U3", "?")))
    if action == 3:
        return rng.choice(([], None, "x", 3.0, [[1, 2], [3]], [array]))
    if action < 10 and array.size and array.dtype.kind == "f":
        array.flat[rng.randrange(array.size)] = rng.choice(FLOATS)
    return array
