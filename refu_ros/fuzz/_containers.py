"""Damage inside of containers: members of a zip archive, records of an MCAP file, opcodes of a pickle.

A flipped bit in a compressed or summed block is refused for its checksum. What is behind the checksum is reached only
by taking the container apart, changing a part, and putting it together again as a valid one.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard

from refu_ros.fuzz._mutate import INTEGERS, mutate_bytes

if TYPE_CHECKING:
    import random

    from numpy.typing import NDArray

_CHUNK = 0x06
_MOST_UNPACKED = 1 << 15
MOST_READ = 200
"""Messages, frames or rows that are read of each file."""
_COMPRESSOR = zstandard.ZstdCompressor(level=1)
_MAGIC = b"\x89MCAP0\r\n"
_HEADERS = [b"(1000000000000,)", b"(100000, 100000)", b"(-1, 72)", b"(2, 72, 0)", b"()", b"(True, 72)", b"(" * 500]
_DTYPES = [
    b"'|O'",
    b"'<f16'",
    b"'|V8'",
    b"'<c16'",
    b"'<M8[s]'",
    b"'|S1000000000'",
    b"'<U9'",
    b"[('a', '<f8')]",
    b"{}",
    b"[[]]",
]

GADGETS = [
    b"cos\nsystem\n(S'true'\ntR",
    b"c__builtin__\neval\n(S'1'\ntR",
    b"cbuiltins\ngetattr\n(cnumpy\nndarray\nS'__init__'\ntR",
    b"cnumpy\nndarray\n)\x81",
    b"c_codecs\nencode\n(S'x'\nS'latin1'\ntR",
    b"c_codecs\nencode\n(N}S'__defaults__'\n(S'x'\ntstb",
    b"cchumpy.ch\nCh\n)\x81}S'x'\nN\x73b",
    b"cscipy.sparse.csc\ncsc_matrix\n)\x81",
    b"ccopy_reg\n_reconstructor\n(cnumpy\nndarray\nc__builtin__\nobject\nNtR",
    b"r\xff\xff\xff\x7f",  # a memo of two thousand million entries
    b"p4000000000\n",
    b"T\xff\xff\xff\x7f",  # a string of 2 GiB, which isn't there
    b"\x8e" + struct.pack("<Q", 1 << 40),
    b"\x96" + struct.pack("<Q", 1 << 33),
    b"\x95" + struct.pack("<Q", 1 << 50),
    b"\x8b\xff\xff\xff\x7f",  # a number of 2 GiB
    b"]" * 3000 + b"a" * 2999,
    b"(" * 2000 + b"t" * 2000,
    b"Pid\n",
    b"\x82\x01",
    b"\x97",
    b"2",
    b"0",
    b"N",
    b"}",
    b"s",
    b"b",
    b"R",
    b"(lp0\nh\x00a",
]
"""Opcodes of pickles: calls, states, references, and lengths that nobody should believe."""


def mutate_zip(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """An archive with one member changed, renamed, doubled or removed, or with its own bytes damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [
                (entry.filename, archive.read(entry)) for entry in archive.infolist() if entry.file_size < 1 << 20
            ]
    except Exception:
        return mutate_bytes(rng, data, other)
    if not members or rng.random() < 0.35:
        return mutate_bytes(rng, data, other)
    at = rng.randrange(len(members))
    name, content = members[at]
    action = rng.randrange(12)
    if action < 7:
        members[at] = name, mutate_npy(rng, content)
    elif action == 7:
        members[at] = rng.choice((name.upper(), "../" + name, "/" + name, name + ".npy", "")), content
    elif action == 8:
        members.append(members[at])
    elif action == 9:
        del members[at]
    elif action == 10:
        members[at] = name, rng.choice(members)[1]
    else:
        members[at] = name, bytes(rng.choice((0, 1, 1000, 100_000)))
    method = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    return pack_zip(members, method)


def pack_zip(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of these members; a name may occur twice."""
    import warnings

    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method) as archive:
        warnings.simplefilter("ignore")
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return buffer.getvalue()


def mutate_npy(rng: random.Random, data: bytes) -> bytes:
    """An array file with another shape or type in its header, or with damaged bytes."""
    action = rng.random()
    if action < 0.25:
        start, end = data.find(b"(", 10), data.find(b")", 10)
        if 0 <= start < end:
            return _reheaded(data, data[:start] + rng.choice(_HEADERS) + data[end + 1 :])
    elif action < 0.5:
        start = data.find(b"'descr':", 10)
        end = data.find(b", '", start)
        if 0 <= start < end:
            return _reheaded(data, data[: start + 9] + rng.choice(_DTYPES) + data[end:])
    return mutate_bytes(rng, data)


def _reheaded(old: bytes, new: bytes) -> bytes:
    """With the header's length as it now is."""
    (length,) = struct.unpack_from("<H", old, 8)
    return new[:8] + struct.pack("<H", (length + len(new) - len(old)) % (1 << 16)) + new[10:]


def mutate_mcap(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """A bag with a record or a chunk's content changed, or with its own bytes damaged."""
    if rng.random() < 0.3:
        return mutate_bytes(rng, data, other)
    records = split_mcap(data)
    if not records:
        return mutate_bytes(rng, data, other)
    at = rng.randrange(len(records))
    opcode, content = records[at]
    action = rng.randrange(10)
    if opcode == _CHUNK and action < 8:
        content = _mutate_chunk(rng, content)
    elif action < 6:
        content = mutate_bytes(rng, content)
    elif action == 6:
        opcode = rng.randrange(256)
    elif action == 7:
        records.insert(at, records[rng.randrange(len(records))])
    elif action == 8:
        del records[at]
        return join_mcap(records)
    records[at] = opcode, content
    return join_mcap(records)


def split_mcap(data: bytes) -> list[tuple[int, bytes]]:
    """Opcode and content of the records of a whole file; nothing where it isn't one."""
    records, at = [], len(_MAGIC)
    while at + 9 <= len(data) - len(_MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if length > len(data) - at - 9:
            return []
        records.append((opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return records


def join_mcap(records: list[tuple[int, bytes]]) -> bytes:
    """A file of these records."""
    return _MAGIC + b"".join(struct.pack("<BQ", code, len(content)) + content for code, content in records) + _MAGIC


def mcap_chunk(records: bytes, *, claimed: int | None = None) -> bytes:
    """The content of a chunk of these records, which claims to unpack to `claimed` bytes."""
    packed = _COMPRESSOR.compress(records)
    head = struct.pack("<QQQI", 0, 1, len(records) if claimed is None else claimed, zlib.crc32(records))
    return head + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed


def _mutate_chunk(rng: random.Random, content: bytes) -> bytes:
    try:
        size, _, name = struct.unpack_from("<QII", content, 16)
        if size > _MOST_UNPACKED:
            return mutate_bytes(rng, content)
        packed = content[32 + name + 8 :]
        records = (
            packed if not name else zstandard.ZstdDecompressor().decompress(packed, max_output_size=_MOST_UNPACKED)
        )
    except (struct.error, zstandard.ZstdError):
        return mutate_bytes(rng, content)
    claimed = rng.choice(INTEGERS) if rng.random() < 0.1 else None
    return mcap_chunk(mutate_bytes(rng, records), claimed=claimed)


def mutate_pickle(rng: random.Random, data: bytes, other: bytes) -> bytes:
    """A pickle with opcodes put in, also just before its end."""
    if rng.random() < 0.5:
        return mutate_bytes(rng, data, other)
    content = data
    for _ in range(rng.randrange(1, 4)):
        at = len(content) - 1 if rng.random() < 0.4 else rng.randrange(len(content) + 1)
        content = content[:at] + rng.choice(GADGETS) + content[at:]
    return content


def npy_bytes(array: NDArray[Any]) -> bytes:
    """An array as a file."""
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()
