"""Readers of messages, parameters and command lines."""

from __future__ import annotations

import contextlib
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st

import msg_adapters as adapters
from msg_adapters.markers import encode_delete
from msg_adapters.transforms import Transform, encode_transforms
from refu_core import SmplFrame
from refu_core.options import specs_of
from refu_lab.cli import _parser, main
from refu_ros._settings import NodeSettings
from tests.fuzz.contract import check_line
from tests.fuzz.corpus import some_frame
from tests.fuzz.strategies import FLOATS, INTEGERS, Special, near, near_file, odd_value, place

if TYPE_CHECKING:
    import argparse

    from hypothesis.strategies import DrawFn, SearchStrategy

Reader = tuple["SearchStrategy[Any]", Callable[[Any], None]]

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


def check_frame(frame: SmplFrame) -> None:
    """What a decoder promises of a frame."""
    arrays = (frame.pose, frame.betas, frame.transl, *(() if frame.style is None else (frame.style,)))
    assert all(np.isfinite(array).all() for array in arrays), "a frame that isn't finite"
    assert [array.shape for array in arrays[:3]] == [(24, 3), (10,), (3,)], "a frame of another shape"


# CDR ----------------------------------------------------------------------------------------------


def cdr(input_type: str) -> Callable[[Path], Reader]:
    """A message of an input type; what is decoded is encoded and decoded once more, to the same frame."""
    decode = adapters.decoder_for(input_type).from_bytes
    encode = adapters.encoder_for(input_type)
    good = [encode(some_frame(seed, with_style=seed > 0)) for seed in range(2)]

    def read(data: bytes) -> None:
        frame = decode(data)
        check_frame(frame)
        if 0 <= frame.stamp_ns < 2**61 and input_type != "pose_array":  # which doesn't carry betas
            assert np.array_equal(decode(encode(frame)).pose, frame.pose), "encoded and decoded, the pose is another"

    return lambda _: (near([*good, *good, b"", b"\0\1\0\0", bytes(4096), b"\0\1\0\0" + b"\xff" * 4096]), read)


def definition(_: Path) -> Reader:
    """The text of a message type that came with a bag, by which smpl_msgs is read."""
    message = adapters.encoder_for("smpl_msgs")(some_frame())

    def read(data: bytes) -> None:
        text = data.decode("utf-8", "replace")
        check_frame(adapters.decoder_for("smpl_msgs", definition=text).from_bytes(message))

    return near([adapters.message_definition("smpl_msgs/msg/Smpl").text.encode()], _WORDS), read


def markers(_: Path) -> Reader:
    """A MarkerArray, which Foxglove and our own evaluation read."""
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    meshes = adapters.MarkerArrayEncoder([adapters.MarkerMesh("a/b", faces, 4)])
    good = meshes.encode([np.eye(4, 3)], stamp_ns=5)
    others = [encode_delete(["a", "b"], stamp_ns=1)]

    def read(data: bytes) -> None:
        for marker in adapters.decode_marker_array(data):
            adapters.vertices_from_points(marker.points, faces)

    return near([good, good, *others]), read


def surroundings(_: Path) -> Reader:
    """What else the node reads of a graph, by the first byte: transforms, ids, cameras."""
    numbers = Transform(5, "map", "cam", np.zeros(3), np.array([0.0, 0, 0, 1]))
    transforms = encode_transforms([numbers, numbers])
    readers: list[Callable[[bytes], object]] = [
        lambda data: adapters.TransformBuffer().put(data, is_static=False),
        adapters.decode_ids,
        adapters.decode_camera_info,
    ]
    good = [bytes([kind]) + transforms for kind in range(len(readers))]

    def read(data: bytes) -> None:
        if data:
            readers[data[0] % len(readers)](data[1:])

    return near(good), read


@st.composite
def _odd_array(draw: DrawFn, array: Any) -> Any:
    """The array, mostly as it is; otherwise of another shape or type, or with an odd number in it."""
    action = draw(st.integers(0, 30))
    if action == 1:
        return array.reshape(-1)
    if action == 2:
        return array[..., :2]
    if action == 3:
        return array.astype(draw(st.sampled_from(("f2", "i4", "O", "c8", "U3", "?"))))
    if action == 4:
        return draw(st.sampled_from(([], None, "x", 3.0, [[1, 2], [3]], [array])))
    if action < 10 and action and array.size and array.dtype.kind == "f":
        array.flat[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from(FLOATS))
    return array


def encoder(_: Path) -> Reader:
    """Vertices, colours, faces and names of every kind, to a MarkerArray: refused, or decoded again to what went in."""

    def rarely(usual: Any, *odd: Any) -> SearchStrategy[Any]:
        return st.integers(0, 9).flatmap(lambda roll: st.sampled_from(odd) if roll == 9 else st.just(usual))

    @st.composite
    def drawn(draw: DrawFn) -> dict[str, Any]:
        n, f = draw(rarely(4, 0, 1, 300)), draw(rarely(7, 0, 1))
        numbers = np.random.default_rng(draw(st.integers(0, 99)))
        faces = numbers.integers(draw(rarely(0, -1)), max(n, 1) + draw(rarely(0, 1)), (f, 3))
        vertices = numbers.normal(size=(n, 3)).astype(draw(st.sampled_from(("f4", "f8"))))
        integers = (0, 10**9, -(2**31), *INTEGERS, *(-number for number in INTEGERS))
        return {
            "name": draw(rarely("a/b", "", "\0", "é", "\ud800", "x" * 3000)),
            "faces": draw(_odd_array(faces)),
            "n": n,
            "color": draw(st.lists(rarely(0.5, *FLOATS), min_size=3, max_size=4)),
            "vertices": draw(_odd_array(vertices)),
            "stamp_ns": draw(rarely(5, *integers)),
            "transl": draw(rarely(None, np.ones(3), np.ones((1, 3)), [np.nan] * 3, "x", np.ones(2))),
            "frame_id": draw(rarely("map", "", "\ud800")),
            "axes": draw(st.sampled_from(("smpl", "frame"))),
        }

    def read(v: dict[str, Any]) -> None:
        mesh = adapters.MarkerMesh(v["name"], v["faces"], v["n"], color=tuple(v["color"]))
        meshes = adapters.MarkerArrayEncoder([mesh], frame_id=v["frame_id"], axes=v["axes"])
        message = meshes.encode([v["vertices"]], stamp_ns=v["stamp_ns"], transl=v["transl"])
        (marker,) = adapters.decode_marker_array(message)
        assert (marker.ns, marker.stamp_ns) == (v["name"], v["stamp_ns"]), "another marker"
        assert marker.points.shape == (3 * len(v["faces"]), 3), "other points"
        assert np.isfinite(marker.points).all(), "points that aren't finite"

    return drawn(), read


def parameters(_: Path) -> Reader:
    """The parameters of the node."""
    settings = NodeSettings()
    usual = json.loads(json.dumps({name: one.default for name, one in specs_of(NodeSettings).items()}))
    others = usual | {"garments": ["shirt-male"], "max_rate": 30, "style": [1, 0, 0, 0], "persons": ["a", "b"]}

    def read(values: Any) -> None:
        if isinstance(values, dict):
            changed = settings.changed(values)
            assert changed.changed({}) == changed, "settings that aren't valid themselves"

    return st.sampled_from((usual, others)).flatmap(odd_value), read


# Command lines ------------------------------------------------------------------------------------

_TEXTS = (
    "",
    "\0",
    "-",
    "--",
    "~nobody/x",
    "/proc/nope/x",
    "\udcff",
    "x" * 5000,
    "1e999",
    "nan",
    "-1",
    "meta",
    "\x1b[31mred",
)
_HOSTILE = {
    "replay": (),
    "train": ("tshirt-male", "--data"),
    "evaluate": ("--data",),
    "info": ("--body",),
    "stress": ("--replay",),
    "simulate": ("tshirt-male", "--count", "2", "--output", "set", "--motions"),
}
"""What stands before the file that none of these commands can read."""


def arguments(folder: Path) -> Reader:
    """A command with a file that it can't read and options of any kind: one line, and exit code 2."""
    file = folder / "file"
    (chooser,) = (action for action in _parser()._actions if action.dest == "command")
    options: dict[str, list[argparse.Action]] = {
        command: [
            action for action in chooser.choices[command]._actions if action.option_strings and action.dest != "help"
        ]
        for command in _HOSTILE
    }

    @st.composite
    def drawn(draw: DrawFn) -> tuple[bytes | Special, list[str]]:
        command = draw(st.sampled_from(list(_HOSTILE)))
        name = draw(st.sampled_from((str(file), f"{file}.npz", f"{file}.pkl", f"{file}.mcap", *_TEXTS[:-1])))
        words = [command, *_HOSTILE[command], name]
        for action in draw(st.lists(st.sampled_from(options[command]), max_size=3)):
            if action.option_strings[-1] in words:
                continue
            odd = st.sampled_from((*_TEXTS, *map(str, action.choices or ()), str(action.default), "1", "x,y"))
            words.append(action.option_strings[-1])
            words += [] if action.nargs == 0 else [draw(odd | st.text(max_size=9))]
        return draw(near_file(st.sampled_from((b"", b"PK\3\4", bytes(99), b"\x80\2N.")))), words

    def read(value: tuple[bytes | Special, list[str]]) -> None:
        content, words = value
        for suffix in ("", ".npz", ".pkl", ".mcap"):
            place(Path(f"{file}{suffix}"), content)
        here, errors = Path.cwd(), io.StringIO()
        os.chdir(folder)
        try:
            with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
                code = main(words)
        except SystemExit as end:
            code = end.code
        finally:
            os.chdir(here)
        assert code == 2, f"exit code {code} for {words}: {errors.getvalue()[-500:]}"
        check_line(errors.getvalue().rstrip("\n"), f"refu {words[0]}")

    return drawn(), read
