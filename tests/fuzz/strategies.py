"""Hypothesis strategies of hostile input: bytes and values near valid ones, damage behind checksums, special files."""

from __future__ import annotations

import enum
import json
import os
import shutil
import socket
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hypothesis import strategies as st

from tests.fuzz.contract import own_work

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hypothesis.strategies import DrawFn, SearchStrategy

LARGEST = 1 << 20
"""Of any input [bytes]."""
_EDGES = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 1 << 20, (1 << 31) - 1, 1 << 31, (1 << 32) - 1)
INTEGERS = (*_EDGES, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
"""Lengths and counts at which readers break."""
FLOATS = (0.0, -0.0, 1e-320, 1e-12, 1.0, -1.0, 3.15, 1e3, 1e9, 1e38, 1e300, float("inf"), float("-inf"), float("nan"))
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**12, 10**400, 0.5, 1e308, float("nan"), float("inf")),
    *("", "x", "x" * 5000, "\0", "\ud800", "\x1b[2J", "../../../etc/passwd", "9" * 400, "nan", "1:1:1", "~nobody/x"),
    *([], {}, [[]], [0] * 100, {"": {}}, [10**6], [10**9, 10**9], [1] * 3000, -5, 1e9, 10**6, 10**9),
)
"""What may stand where something else was expected."""


# Bytes --------------------------------------------------------------------------------------------


def _flip(draw: DrawFn, data: bytearray, _: Sequence[bytes]) -> None:
    if data:
        data[draw(st.integers(0, len(data) - 1))] ^= 1 << draw(st.integers(0, 7))


def _set_number(draw: DrawFn, data: bytearray, _: Sequence[bytes]) -> None:
    code = draw(st.sampled_from(("<H", "<I", "<I", "<Q", ">I", "<f", "<d")))
    size = struct.calcsize(code)
    if len(data) >= size:
        # Fields lie on multiples of their size as a rule, but not in every format.
        at = draw(st.integers(0, len(data) - size))
        at -= at % size if draw(st.booleans()) else 0
        if code in ("<f", "<d"):
            value = draw(st.sampled_from(FLOATS))
            struct.pack_into(code, data, at, float("inf") if code == "<f" and value > 4e38 else value)
        else:
            near = struct.unpack_from(code, data, at)[0]
            value = draw(st.sampled_from((*INTEGERS, near + 1, near - 1, 2 * near)))
            struct.pack_into(code, data, at, value % (1 << 8 * size))


def _cut(draw: DrawFn, data: bytearray, _: Sequence[bytes]) -> None:
    del data[draw(st.integers(0, len(data))) :]


def _remove(draw: DrawFn, data: bytearray, _: Sequence[bytes]) -> None:
    at = draw(st.integers(0, len(data)))
    del data[at : at + draw(st.integers(1, 16))]


def _insert(draw: DrawFn, data: bytearray, words: Sequence[bytes]) -> None:
    at = draw(st.integers(0, len(data)) | st.just(max(len(data) - 1, 0)))
    data[at:at] = draw(st.sampled_from(words) if words and draw(st.booleans()) else st.binary(max_size=32))


def _repeat(draw: DrawFn, data: bytearray, words: Sequence[bytes]) -> None:
    """Much of the same, which is where time and memory go."""
    at = draw(st.integers(0, len(data)))
    part = bytes(data[at : at + draw(st.sampled_from((1, 4, 9, 16, 64, 256)))])
    part = draw(st.sampled_from(words)) if words and draw(st.booleans()) else part
    if part:
        many = draw(st.sampled_from((1, 2, 60, 1000, 100_000, LARGEST)))
        data[at:at] = part * min(many, max(1, (LARGEST - len(data)) // len(part)))


def _splice(draw: DrawFn, data: bytearray, _: Sequence[bytes]) -> None:
    start, at = draw(st.integers(0, len(data))), draw(st.integers(0, len(data)))
    part = data[start : start + draw(st.integers(1, 256))]
    data[at : at + len(part) * draw(st.integers(0, 1))] = part


_EDITS: tuple[Callable[[DrawFn, bytearray, Sequence[bytes]], None], ...] = (
    *(_flip, _flip, _set_number, _set_number, _set_number, _cut, _remove, _insert, _insert, _repeat, _splice),
)


@st.composite
def edited(draw: DrawFn, data: bytes, words: Sequence[bytes] = ()) -> bytes:
    """`data` with one to four edits, mostly one; `words` are put in, once or very often."""
    content = bytearray(data)
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 4)))):
        draw(st.sampled_from(_EDITS))(draw, content, words)
    return bytes(content[:LARGEST])


def near(seeds: Sequence[bytes], words: Sequence[bytes] = ()) -> SearchStrategy[bytes]:
    """One of these inputs, as it is or edited."""
    return st.sampled_from(seeds) | st.sampled_from(seeds).flatmap(lambda seed: edited(seed, words))


# Values -------------------------------------------------------------------------------------------


@st.composite
def odd_value(draw: DrawFn, value: Any, odd: Sequence[Any] = ODD_VALUES) -> Any:
    """A value as JSON knows them, with one entry somewhere replaced, removed, added or doubled."""
    if not isinstance(value, (dict, list)) or not value or not draw(st.integers(0, 9)):
        if isinstance(value, (int, float)) and draw(st.booleans()):
            return draw(st.sampled_from((-value, value + 1, value - 1, value * 2, [value], str(value))))
        return draw(st.sampled_from(odd))
    key = draw(st.sampled_from(list(value) if isinstance(value, dict) else range(len(value))))
    result = value.copy()
    action = draw(st.sampled_from(("change", "change", "change", "remove", "add")))
    if action == "change":
        result[key] = draw(odd_value(value[key], odd))
    elif action == "remove":
        del result[key]
    elif isinstance(result, list):
        result.insert(key, draw(st.sampled_from((value[key], *odd))))
    else:
        result[draw(st.sampled_from(("", "extra", "\0", f"{key} ")))] = draw(st.sampled_from(odd))
    return result


@st.composite
def near_json(draw: DrawFn, seeds: Sequence[bytes]) -> bytes:
    """A JSON file with odd values in odd places, nested beyond reason, or damaged as text."""
    seed = draw(st.sampled_from(seeds))
    if not draw(st.integers(0, 4)):
        return draw(edited(seed, (b"[", b'{"a":', b"1", b'"\\ud800"', b"NaN,", b"\x1b[2J")))
    value = json.loads(seed)
    for _ in range(draw(st.integers(1, 3))):
        value = draw(odd_value(value))
    return json.dumps(value).encode()


# Special files ------------------------------------------------------------------------------------


class Special(enum.Enum):
    """What may lie where a file is looked for."""

    FIFO = enum.auto()
    SOCKET = enum.auto()
    FOLDER = enum.auto()
    MISSING = enum.auto()
    SPARSE = enum.auto()
    LOOP = enum.auto()
    ZERO = "/dev/zero"
    NULL = "/dev/null"
    RANDOM = "/dev/urandom"
    MEMORY = "/proc/self/mem"
    STATUS = "/proc/self/status"
    TERMINAL = "/dev/ptmx"


@st.composite
def near_file(draw: DrawFn, contents: SearchStrategy[bytes]) -> bytes | Special:
    """Such a content, or one time in twenty no regular file at all."""
    return draw(contents) if draw(st.integers(0, 19)) else draw(st.sampled_from(Special))


def place(path: Path, content: bytes | Special) -> None:
    """Puts it there, instead of what was there before."""
    with own_work():
        _place(path, content)


def _place(path: Path, content: bytes | Special) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    elif path.is_symlink() or (path.exists() and not (path.is_file() and isinstance(content, bytes))):
        path.unlink()
    if isinstance(content, bytes):
        path.write_bytes(content)
        return
    path.unlink(missing_ok=True)
    if content is Special.FIFO:
        os.mkfifo(path)
    elif content is Special.SOCKET:
        with socket.socket(socket.AF_UNIX) as made, _short(path.parent) as folder:
            made.bind(f"{folder}/{path.name}")
    elif content is Special.FOLDER:
        path.mkdir()
    elif content is Special.SPARSE:
        with path.open("wb") as file:
            file.truncate(1 << 40)
    elif content is Special.LOOP:
        path.symlink_to(path)
    elif content is not Special.MISSING:
        path.symlink_to(content.value)


class _short:  # noqa: N801
    """A name of a folder that is short enough for the address of a socket."""

    def __init__(self, folder: Path) -> None:
        self._file = os.open(folder, os.O_RDONLY)

    def __enter__(self) -> str:
        return f"/proc/self/fd/{self._file}"

    def __exit__(self, *_: object) -> None:
        os.close(self._file)
