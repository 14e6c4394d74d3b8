"""The records of an MCAP file, read one after another without trusting any of their lengths.

A record is an opcode, a length and its content; a chunk's content is again records, compressed. What is damaged is
reported and left out; what comes before it (and, where the framing holds, after it) is read.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, BinaryIO

import zstandard

from msg_adapters.errors import BagError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B, 0x0F
_WANTED = frozenset({FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END})

_RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE_HEADER = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<QQI")
_FOOTER_BYTES = _RECORD_HEADER.size + _FOOTER.size + len(MAGIC)
MAX_CHUNK_BYTES = 256 << 20
"""A chunk that claims to unpack to more is left out: a few kilobytes could otherwise claim all memory."""


_MAX_RATIO, _SMALL_CHUNK = 1000, 8 << 20
"""A chunk above that size [bytes] that claims to be so much larger than it is packed is a bomb: recorders fill theirs
to less than a megabyte, and the few messages that are larger aren't all one byte."""


class DamageError(Exception):
    """A record whose content can't be read; never leaves this package."""


class _Fields:
    """Reads the fields of one record's content."""

    def __init__(self, content: memoryview) -> None:
        self._content = content
        self._at = 0

    def take(self, size: int) -> memoryview:
        if size > len(self._content) - self._at:
            msg = f"a field of {size} bytes where {len(self._content) - self._at} are left"
            raise DamageError(msg)
        view = self._content[self._at : self._at + size]
        self._at += size
        return view

    def number(self, size: int) -> int:
        return int.from_bytes(self.take(size), "little")

    def string(self) -> str:
        try:
            return str(self.take(self.number(4)), "utf-8")
        except UnicodeDecodeError as error:
            msg = f"a string that isn't UTF-8 ({error.reason})"
            raise DamageError(msg) from None

    def string_map(self) -> dict[str, str]:
        entries = _Fields(self.take(self.number(4)))
        result = {}
        while entries._at < len(entries._content):
            key = entries.string()
            result[key] = entries.string()
        return result


@dataclass(frozen=True)
class Schema:
    """A message type and its definition."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A topic."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True)
class Message:
    """A message, its payload still a view of the chunk."""

    channel_id: int
    log_time_ns: int
    publish_time_ns: int
    data: memoryview


@dataclass(frozen=True)
class Record:
    """A record of the file; `offset` is where it starts [bytes]."""

    opcode: int
    content: memoryview
    offset: int


def parse_schema(content: memoryview) -> Schema:
    """Raises `DamageError`, like all parsers here."""
    fields = _Fields(content)
    return Schema(fields.number(2), fields.string(), fields.string(), bytes(fields.take(fields.number(4))))


def parse_channel(content: memoryview) -> Channel:
    """A channel record."""
    fields = _Fields(content)
    return Channel(fields.number(2), fields.number(2), fields.string(), fields.string(), fields.string_map())


def parse_message(content: memoryview) -> Message:
    """A message record."""
    if len(content) < _MESSAGE_HEADER.size:
        msg = f"a message record of {len(content)} bytes"
        raise DamageError(msg)
    channel_id, _, log_time_ns, publish_time_ns = _MESSAGE_HEADER.unpack_from(content)
    return Message(channel_id, log_time_ns, publish_time_ns, content[_MESSAGE_HEADER.size :])


def parse_message_counts(content: memoryview) -> dict[int, int]:
    """Messages of each channel id, of a statistics record."""
    fields = _Fields(content)
    fields.take(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)
    counts = _Fields(fields.take(fields.number(4)))
    result = {}
    while counts._at < len(counts._content):
        channel_id = counts.number(2)
        result[channel_id] = counts.number(8)
    return result


def unpack_chunk(content: memoryview) -> memoryview:
    """The records of a chunk, decompressed and checked."""
    fields = _Fields(content)
    fields.take(16)  # first and last log time
    size, crc = fields.number(8), fields.number(4)
    compression = fields.string()
    packed = fields.take(fields.number(8))
    if size > MAX_CHUNK_BYTES:
        msg = f"a chunk that unpacks to {size >> 20} MiB, at most {MAX_CHUNK_BYTES >> 20} are read"
        raise DamageError(msg)
    if size > max(_SMALL_CHUNK, _MAX_RATIO * len(packed)):
        msg = f"a chunk of {len(packed)} bytes that unpacks to {size >> 20} MiB"
        raise DamageError(msg)
    records = packed if not compression else memoryview(_decompress(compression, packed, size))
    if len(records) != size:
        msg = f"a chunk that unpacks to {len(records)} bytes where {size} were announced"
        raise DamageError(msg)
    if crc and zlib.crc32(records) != crc:
        msg = "a chunk whose checksum is wrong"
        raise DamageError(msg)
    return records


def _decompress(compression: str, packed: memoryview, size: int) -> bytes:
    """At most one byte more than `size`, whatever the compressed data claims."""
    if compression == "zstd":
        try:
            with zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES).stream_reader(
                packed, read_across_frames=True
            ) as reader:
                return reader.read(size + 1)
        except (zstandard.ZstdError, MemoryError) as error:
            msg = f"a chunk that zstd can't unpack ({error})"
            raise DamageError(msg) from None
    if compression == "lz4":
        try:
            lz4 = import_module("lz4.frame")  # optional: rosbag2 compresses with zstd
        except ImportError as error:
            msg = "the bag is compressed with lz4; install it: pip install lz4"
            raise BagError(msg) from error
        try:
            return bytes(lz4.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
        except (RuntimeError, EOFError, MemoryError) as error:
            msg = f"a chunk that lz4 can't unpack ({error})"
            raise DamageError(msg) from None
    msg = f"a chunk of unknown compression {compression!r}"
    raise DamageError(msg)


def split_records(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of the records of a chunk or a summary; raises `DamageError` where one doesn't fit."""
    at = 0
    while at < len(content):
        if len(content) - at < _RECORD_HEADER.size:
            msg = f"{len(content) - at} bytes where a record should start"
            raise DamageError(msg)
        opcode, length = _RECORD_HEADER.unpack_from(content, at)
        if opcode == 0:
            msg = "a record without an opcode"  # the format has none; nothing but zeros would be millions of them
            raise DamageError(msg)
        at += _RECORD_HEADER.size
        if length > len(content) - at:
            msg = f"a record of {length} bytes where {len(content) - at} are left"
            raise DamageError(msg)
        yield opcode, content[at : at + length]
        at += length


def open_mcap(path: Path) -> BinaryIO:
    """The file, positioned after its magic bytes.

    Raises `BagError` when it can't be opened or isn't an MCAP file.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        msg = f"{path}: can't be opened: {error.strerror}"
        raise BagError(msg) from error
    try:
        start = file.read(len(MAGIC))
    except OSError as error:
        file.close()
        msg = f"{path}: can't be read: {error.strerror}"
        raise BagError(msg) from error
    if start != MAGIC:
        file.close()
        what = "an empty file" if not start else "not an MCAP file"
        hint = "; convert it with `ros2 bag convert`" if start.startswith((b"SQLite", b"#ROSBAG")) else ""
        msg = f"{path}: {what}{hint or '; wanted a .mcap file, a rosbag2 directory or an AMASS-style .npz'}"
        raise BagError(msg)
    return file


def read_summary(file: BinaryIO) -> list[tuple[int, memoryview]] | None:
    """The records of the summary section; None where the file has none, or a damaged one. Leaves the file elsewhere."""
    size = file.seek(0, os.SEEK_END)
    if size < len(MAGIC) + _FOOTER_BYTES:
        return None
    file.seek(size - _FOOTER_BYTES)
    tail = file.read(_FOOTER_BYTES)
    opcode, length = _RECORD_HEADER.unpack_from(tail)
    start, _, crc = _FOOTER.unpack_from(tail, _RECORD_HEADER.size)
    section = size - _FOOTER_BYTES - start
    whole = tail.endswith(MAGIC) and opcode == FOOTER and length == _FOOTER.size
    if not whole or start < len(MAGIC) or not 0 < section <= MAX_CHUNK_BYTES:
        return None
    file.seek(start)
    summary = file.read(section)
    if crc and zlib.crc32(summary + tail[: -len(MAGIC) - 4]) != crc:
        return None
    try:
        return list(split_records(memoryview(summary)))
    except DamageError:
        return None


def iter_records(file: BinaryIO) -> Iterator[Record]:
    """The file's records from its first one to the end of its data, one in memory at a time.

    Raises `DamageError` where the file ends too early.
    """
    size = file.seek(0, os.SEEK_END)
    at = file.seek(len(MAGIC))
    while True:
        header = file.read(_RECORD_HEADER.size)
        if len(header) < _RECORD_HEADER.size:
            msg = f"the file ends at byte {size} without its closing records"
            raise DamageError(msg)
        opcode, length = _RECORD_HEADER.unpack(header)
        if length > size - at - _RECORD_HEADER.size:
            msg = f"the record at byte {at} wants {length} bytes, the file has {size - at - _RECORD_HEADER.size} left"
            raise DamageError(msg)
        if opcode in _WANTED and length > MAX_CHUNK_BYTES:
            msg = f"the record at byte {at} has {length >> 20} MiB, at most {MAX_CHUNK_BYTES >> 20} are read"
            raise DamageError(msg)
        if opcode in _WANTED:
            yield Record(opcode, memoryview(file.read(length)), at)
        else:
            file.seek(length, os.SEEK_CUR)
        if opcode in (DATA_END, FOOTER):
            return
        at += _RECORD_HEADER.size + length
