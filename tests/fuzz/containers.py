"""Damage inside of containers: members of a zip archive, records of an MCAP file, headers of arrays.

A flipped bit in a compressed or summed block is refused for its checksum. What is behind the checksum is reached only
by taking the container apart, changing a part, and putting it together again as a valid one.
"""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard
from hypothesis import strategies as st

from tests.fuzz.strategies import INTEGERS, LARGEST, edited

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hypothesis.strategies import DrawFn
    from numpy.typing import NDArray

_CHUNK = 0x06
_COMPRESSOR = zstandard.ZstdCompressor(level=1)
_MAGIC = b"\x89MCAP0\r\n"
_UNPACKED = 64 << 20
"""What a bomb claims or has at least [bytes]."""
_SHAPES = (b"(1000000000000,)", b"(100000, 100000)", b"(-1, 72)", b"(2, 72, 0)", b"()", b"(True, 72)", b"(" * 500)
_DTYPES = (
    *(b"'|O'", b"'<f16'", b"'|V8'", b"'|V0'", b"'<c16'", b"'<M8[s]'", b"'|S1000000000'", b"'<U9'", b"'<U0'", b"'|i1'"),
    *(b"'<f2'", b"'|b1'", b"'<i8'", b"[('a', '<f8')]", b"{}", b"[[]]"),
)


def npy_bytes(array: NDArray[Any]) -> bytes:
    """An array as a file."""
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@st.composite
def near_npy(draw: DrawFn, data: bytes) -> bytes:
    """An array file with another shape or type in its header, or with damaged bytes."""
    action = draw(st.sampled_from(("shape", "type", "bytes", "bytes")))
    if action == "shape":
        start, end = data.find(b"(", 10), data.find(b")", 10)
        if 0 <= start < end:
            return _reheaded(data, data[:start] + draw(st.sampled_from(_SHAPES)) + data[end + 1 :])
    elif action == "type":
        start = data.find(b"'descr':", 10)
        end = data.find(b", '", start)
        if 0 <= start < end:
            return _reheaded(data, data[: start + 9] + draw(st.sampled_from(_DTYPES)) + data[end:])
    return draw(edited(data))


def _reheaded(old: bytes, new: bytes) -> bytes:
    """With the header's length as it now is."""
    (length,) = struct.unpack_from("<H", old, 8)
    return new[:8] + struct.pack("<H", (length + len(new) - len(old)) % (1 << 16)) + new[10:]


def pack_zip(members: Sequence[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of these members; a name may occur twice."""
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method, compresslevel=1) as archive:
        warnings.simplefilter("ignore")
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return buffer.getvalue()


@st.composite
def near_zip(draw: DrawFn, seeds: Sequence[bytes]) -> bytes:
    """An archive with one member changed, renamed, doubled or removed, or with its own bytes damaged."""
    seed = draw(st.sampled_from(seeds))
    if not draw(st.integers(0, 3)):
        return draw(edited(seed))
    with zipfile.ZipFile(io.BytesIO(seed)) as archive:
        members = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    at = draw(st.integers(0, len(members) - 1))
    name, content = members[at]
    action = draw(st.sampled_from(("npy", "npy", "npy", "name", "double", "remove", "swap", "zeros", "bomb", "many")))
    method = draw(st.sampled_from((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))
    if action == "npy":
        members[at] = name, draw(near_npy(content))
    elif action == "name":
        members[at] = (
            draw(st.sampled_from((name.upper(), f"../{name}", f"/{name}", f"{name}.npy", "", "\x1b"))),
            content,
        )
    elif action == "double":
        members.append(members[at])
    elif action == "remove":
        del members[at]
    elif action == "swap":
        members[at] = name, draw(st.sampled_from(members))[1]
    elif action == "zeros":
        members[at] = name, bytes(draw(st.sampled_from((0, 1, 1000, 100_000))))
    elif action == "bomb":  # small numbers, packed well, which widen to eight bytes each
        dtype = draw(st.sampled_from((np.int8, np.bool_, np.float16, np.float64)))
        width = draw(st.sampled_from((3, 16, 24, 72, 156)))
        rows = _UNPACKED // width // np.dtype(dtype).itemsize
        members[at], method = (name, npy_bytes(np.zeros((rows, width), dtype))), zipfile.ZIP_DEFLATED
    else:
        members += [(f"{i}.npy", b"") for i in range(5000)]
    return pack_zip(members, method)


def split_mcap(data: bytes) -> list[tuple[int, bytes]]:
    """Opcode and content of the records of a whole file."""
    records, at = [], len(_MAGIC)
    while at + 9 <= len(data) - len(_MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        records.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return records


def join_mcap(records: Sequence[tuple[int, bytes]]) -> bytes:
    """A file of these records."""
    return _MAGIC + b"".join(struct.pack("<BQ", code, len(content)) + content for code, content in records) + _MAGIC


def mcap_chunk(records: bytes, *, claimed: int | None = None) -> bytes:
    """The content of a chunk of these records, which claims to unpack to `claimed` bytes."""
    packed = _COMPRESSOR.compress(records)
    head = struct.pack("<QQQI", 0, 1, len(records) if claimed is None else claimed, zlib.crc32(records))
    return head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed


@st.composite
def near_mcap(draw: DrawFn, seeds: Sequence[bytes]) -> bytes:
    """A bag with a record or a chunk's content changed, or with its own bytes damaged."""
    seed = draw(st.sampled_from(seeds))
    if not draw(st.integers(0, 3)):
        return draw(edited(seed))
    records = split_mcap(seed)
    at = draw(st.integers(0, len(records) - 1))
    opcode, content = records[at]
    action = draw(st.sampled_from(("change", "change", "change", "change", "opcode", "double", "remove", "many")))
    if action == "change":
        content = draw(_near_chunk(content)) if opcode == _CHUNK else draw(edited(content))
        records[at] = opcode, content
    elif action == "opcode":
        records[at] = draw(st.integers(0, 255)), content
    elif action == "double":
        records.insert(at, draw(st.sampled_from(records)))
    elif action == "remove":
        del records[at]
    else:
        records[at:at] = [(opcode, content)] * min(50_000, LARGEST // (9 + len(content)))
    return join_mcap(records)


@st.composite
def _near_chunk(draw: DrawFn, content: bytes) -> bytes:
    (name,) = struct.unpack_from("<I", content, 28)
    packed = content[32 + name + 8 :]
    records = zstandard.ZstdDecompressor().decompress(packed) if name else packed
    action = draw(st.sampled_from(("change", "change", "change", "claim", "bomb")))
    if action == "claim":
        return mcap_chunk(records, claimed=draw(st.sampled_from(INTEGERS)))
    if action == "bomb":  # much of nothing, of records that are too small to be any, of channels that nobody declared
        part = draw(st.sampled_from(mcap_bombs(records)))
        return mcap_chunk(part * (_UNPACKED // len(part)))
    return mcap_chunk(draw(edited(records)))


def mcap_bombs(records: bytes) -> list[bytes]:
    """Contents of which a chunk may hold very many."""
    (length,) = struct.unpack_from("<Q", records, 1)
    undeclared = b"".join(
        struct.pack("<BQHIQQ", 5, 22, channel, 0, 0, 0) for channel in range(0, 1 << 16, 7)
    )  # messages of thousands of channels
    return [
        bytes(1 << 20),
        b"\x7f" + bytes(8),
        struct.pack("<BQ", 5, 22) + bytes(22),
        records[: 9 + length],
        undeclared,
    ]
