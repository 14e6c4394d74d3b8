"""One MCAP file of a bag, taken apart without trusting any of its lengths: its topics, as they are met, and messages.

A record is an opcode, a length and its content; a chunk's content is more records, compressed. Damaged parts
are reported and left out; what comes before them (and, where the framing holds, after them) is read.

The mcap package's own StreamReader isn't used: it stops at the first damage, accepts a truncated field as a whole
one, reads unwanted records into memory, and limits neither a chunk's unpacked size nor its number of records.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import BinaryIO

import zstandard

from msg_adapters.bags._metadata import BETAS_OF, TopicInfo
from msg_adapters.cdr import Buffer
from msg_adapters.definitions import full_type_name
from msg_adapters.errors import BagError
from refu_core._files import open_file

MAGIC = b"\x89MCAP0\r\n"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0B, 0x0F
_WANTED = frozenset({FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END})

_RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE_HEADER = struct.Struct("<HIQQ")
_FOOTER = struct.Struct("<QQI")
_MAX_CHANNELS = 1 << 16
_FOOTER_BYTES = _RECORD_HEADER.size + _FOOTER.size + len(MAGIC)
_LONGEST = 1 << 62
_LONGEST_MAGIC = 16
WANTED_FILE = (
    "a .mcap or .db3 file, a rosbag2 directory, or a file of motion (.npz, .pkl, .pt, .bvh …: docs/guide/inputs.md)"
)
_NO_OPCODE = "zeros where a record should start"  # an end that never reached the disk often reads as zeros
MAX_CHUNK_BYTES = 128 << 20
"""A chunk that claims to unpack to more is left out: a few kilobytes could otherwise claim all memory."""


_MAX_RATIO, _SMALL_CHUNK = 1000, 8 << 20
"""A chunk that claims to unpack to more than `_MAX_RATIO` times its own size, and `_SMALL_CHUNK` [bytes], is a bomb."""


class DamageError(Exception):
    """Something that can't be read, as a template and its values; never leaves this package."""

    def __init__(self, template: str, *values: object) -> None:
        super().__init__(template, *values)
        self.template = template
        """The same for all damage of one kind, of which a file may have a million cases."""
        self.where = ""

    def __str__(self) -> str:
        return self.template.format(*self.args[1:]) + self.where


class Budget:
    """What one pass over a bag may cost, given its size on the disk [bytes].

    Real recordings stay far below these limits: each record takes more than 16 bytes of the file even when compressed,
    and chunks unpack to no more than about a hundred times their size. A malicious kilobyte can hold a million empty
    records.
    """

    def __init__(self, size: int) -> None:
        self._left = {
            "records": (1 << 14) + size // 16,
            "bytes unpacked": (192 << 20) + 128 * size,
            "bytes of declarations": (16 << 20) + 2 * size,
        }

    def spend(self, what: str, amount: int = 1) -> None:
        """Raises `DamageError` when there is nothing left."""
        left = self._left[what] - amount
        if left < 0:
            raise DamageError("more {} than a bag of this size has; the rest is left out", what)
        self._left[what] = left


class Fields:
    """Reads the fields of one record's content."""

    def __init__(self, content: memoryview) -> None:
        self.left = content

    def take(self, size: int) -> memoryview:
        if size > len(self.left):
            raise DamageError("a field of {} bytes where {} are left", size, len(self.left))
        view, self.left = self.left[:size], self.left[size:]
        return view

    def number(self, size: int) -> int:
        return int.from_bytes(self.take(size), "little")

    def string(self) -> str:
        try:
            return str(self.take(self.number(4)), "utf-8")
        except UnicodeDecodeError as error:
            raise DamageError("a string that isn't UTF-8 ({})", error.reason) from None

    def string_map(self, budget: Budget) -> dict[str, str]:
        entries, result = Fields(self.take(self.number(4))), {}
        while entries.left:
            budget.spend("records")
            key = entries.string()
            result[key] = entries.string()
        return result


def parse_message(content: memoryview) -> tuple[int, int, int, memoryview]:
    """A message's channel, log time and publish time [ns], and its payload, still a view. Raises `DamageError`."""
    if len(content) < _MESSAGE_HEADER.size:
        raise DamageError("a message record of {} bytes", len(content))
    channel, _, log_ns, publish_ns = _MESSAGE_HEADER.unpack_from(content)
    return channel, log_ns, publish_ns, content[_MESSAGE_HEADER.size :]


def parse_message_counts(content: memoryview) -> dict[int, int]:
    """Number of messages in each channel, from a statistics record."""
    fields = Fields(content)
    fields.take(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)
    counts = Fields(fields.take(fields.number(4)))
    if len(counts.left) > _MAX_CHANNELS * 10:
        raise DamageError("statistics of more channels than there can be")
    result = {}
    while counts.left:
        channel = counts.number(2)
        result[channel] = counts.number(8)
    return result


def unpack_chunk(content: memoryview, budget: Budget) -> memoryview:
    """The records of a chunk, decompressed and checked."""
    fields = Fields(content)
    fields.take(16)  # first and last log time
    size, crc = fields.number(8), fields.number(4)
    compression = fields.string()
    packed = fields.take(fields.number(8))
    records = _unpacked("a chunk", compression, packed, size, budget)
    if crc and zlib.crc32(records) != crc:
        raise DamageError("a chunk whose checksum is wrong")
    return memoryview(records)


def unpack_message(data: Buffer, budget: Budget) -> Buffer:
    """A message in CDR, also where rosbag2 has compressed each message by itself: CDR begins otherwise."""
    if data[: len(ZSTD_MAGIC)] != ZSTD_MAGIC:
        return data
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError as error:
        raise DamageError("a message that zstd can't unpack ({})", error) from None
    if size < 0:
        raise DamageError("a message packed by zstd without its size")
    return _unpacked("a message", "zstd", data, size, budget)


def _unpacked(what: str, compression: str, packed: Buffer, size: int, budget: Budget) -> Buffer:
    if size > MAX_CHUNK_BYTES:
        raise DamageError("{} that unpacks to {} MiB, at most {} are read", what, size >> 20, MAX_CHUNK_BYTES >> 20)
    if size > max(_SMALL_CHUNK, _MAX_RATIO * len(packed)):
        raise DamageError("{} of {} bytes that unpacks to {} MiB", what, len(packed), size >> 20)
    budget.spend("bytes unpacked", size)
    unpacked = packed if not compression else _decompress(what, compression, packed, size)
    if len(unpacked) != size:
        raise DamageError("{} that unpacks to {} bytes where {} were announced", what, len(unpacked), size)
    return unpacked


def _decompress(what: str, compression: str, packed: Buffer, size: int) -> bytes:
    """At most one byte more than `size`, whatever the compressed data claims."""
    if compression == "zstd":
        try:
            with zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES).stream_reader(
                packed, read_across_frames=True
            ) as reader:
                return reader.read(size + 1)
        except (zstandard.ZstdError, MemoryError) as error:
            raise DamageError("{} that zstd can't unpack ({})", what, error) from None
    if compression == "lz4":
        try:
            lz4 = import_module("lz4.frame")  # optional: rosbag2 compresses with zstd
        except ImportError as error:
            raise BagError("the bag is compressed with lz4; install it: pip install lz4") from error
        try:
            return bytes(lz4.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
        except (RuntimeError, EOFError, MemoryError) as error:
            raise DamageError("{} that lz4 can't unpack ({})", what, error) from None
    raise DamageError("{} of unknown compression {!r}", what, compression)


def split_records(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Opcode and content of the records of a chunk or a summary; raises `DamageError` where one doesn't fit."""
    at = 0
    while at < len(content):
        if len(content) - at < _RECORD_HEADER.size:
            raise DamageError("{} bytes where a record should start", len(content) - at)
        opcode, length = _RECORD_HEADER.unpack_from(content, at)
        if opcode == 0:
            raise DamageError(_NO_OPCODE)
        at += _RECORD_HEADER.size
        if length > len(content) - at:
            raise DamageError("a record of {} bytes where {} are left", length, len(content) - at)
        yield opcode, content[at : at + length]
        at += length


def open_bag_file(path: Path) -> tuple[BinaryIO, bytes]:
    """A file, positioned after its first bytes, and these bytes. Raises `BagError` when it can't be opened or read."""
    file = open_file(path, most=_LONGEST, error=BagError, wanted=WANTED_FILE)
    try:
        return file, file.read(_LONGEST_MAGIC)
    except OSError as error:
        file.close()
        raise BagError(f"{path}: can't be read: {error.strerror}") from error


def read_summary(file: BinaryIO) -> Iterable[tuple[int, memoryview]]:
    """The records of the summary section; empty if it is missing or damaged. Moves the file's position."""
    size = file.seek(0, os.SEEK_END)
    if size < len(MAGIC) + _FOOTER_BYTES:
        return ()
    file.seek(size - _FOOTER_BYTES)
    tail = file.read(_FOOTER_BYTES)
    opcode, length = _RECORD_HEADER.unpack_from(tail)
    start, _, crc = _FOOTER.unpack_from(tail, _RECORD_HEADER.size)
    section = size - _FOOTER_BYTES - start
    whole = tail.endswith(MAGIC) and opcode == FOOTER and length == _FOOTER.size
    if not whole or start < len(MAGIC) or not 0 < section <= MAX_CHUNK_BYTES:
        return ()
    file.seek(start)
    summary = file.read(section)
    if crc and zlib.crc32(summary + tail[: -len(MAGIC) - 4]) != crc:
        return ()
    try:
        for _ in split_records(memoryview(summary)):  # all of it or nothing
            pass
    except DamageError:
        return ()
    return split_records(memoryview(summary))


def iter_records(file: BinaryIO) -> Iterator[tuple[int, memoryview, int]]:
    """Opcode, content and place [bytes] of the file's records up to the end of its data, one in memory at a time.

    Raises `DamageError` where the file ends too early.
    """
    size = file.seek(0, os.SEEK_END)
    at = file.seek(len(MAGIC))
    while True:
        header = file.read(_RECORD_HEADER.size)
        if len(header) < _RECORD_HEADER.size:
            raise DamageError("the file ends at byte {} without its closing records", size)
        opcode, length = _RECORD_HEADER.unpack(header)
        if opcode == 0:
            raise DamageError(_NO_OPCODE)
        if length > size - at - _RECORD_HEADER.size:
            msg = "the record at byte {} wants {} bytes, the file has {} left"
            raise DamageError(msg, at, length, size - at - _RECORD_HEADER.size)
        if opcode in _WANTED and length > MAX_CHUNK_BYTES:
            msg = "the record at byte {} has {} MiB, at most {} are read"
            raise DamageError(msg, at, length >> 20, MAX_CHUNK_BYTES >> 20)
        if opcode in _WANTED:
            yield opcode, memoryview(file.read(length)), at
        else:
            file.seek(length, os.SEEK_CUR)
        if opcode in (DATA_END, FOOTER):
            return
        at += _RECORD_HEADER.size + length


StoredMessage = tuple[TopicInfo, int, int, Buffer]
"""A message's topic, log time and publish time [ns], and the message."""


class _Catalogue:
    """The schemas and channels of one file, as they are met."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._schemas: dict[int, tuple[str, str]] = {}
        """Type and `ros2msg` text."""
        self.channels: dict[int, tuple[int, str, str, dict[str, str]]] = {}
        """Schema's number, topic, encoding and metadata, by the channel's number."""
        self._known: dict[tuple[int, bytes], bytes] = {}
        self._topics: dict[int, TopicInfo] = {}

    def add(self, opcode: int, content: memoryview) -> None:
        """Take in a schema or channel record; raises `DamageError`."""
        if opcode not in (SCHEMA, CHANNEL):
            return
        raw = bytes(content)
        key = opcode, raw[:2]  # its number
        if self._known.get(key) == raw:  # each chunk may repeat it, and so does the summary
            return
        self._budget.spend("bytes of declarations", len(content))
        fields = Fields(content)
        number = fields.number(2)
        if opcode == SCHEMA:
            name, encoding = fields.string(), fields.string()
            text = str(fields.take(fields.number(4)), "utf-8", "replace") if encoding == "ros2msg" else ""
            self._schemas[number] = full_type_name(name), text
        else:
            schema, topic, encoding = fields.number(2), fields.string(), fields.string()
            self.channels[number] = schema, topic, encoding, fields.string_map(self._budget)
        self._known[key] = raw
        self._topics.clear()

    def topic(self, number: int) -> TopicInfo | None:
        """The topic of a channel; None for one that wasn't declared."""
        if number not in self._topics and number in self.channels:
            schema, topic, encoding, metadata = self.channels[number]
            message_type, definition = self._schemas.get(schema, ("", ""))
            type_hash, betas_of = metadata.get("topic_type_hash", ""), metadata.get(BETAS_OF, "")
            self._topics[number] = TopicInfo(topic, message_type, encoding, 0, definition, type_hash, betas_of)
        return self._topics.get(number)


class McapFile:
    """Reads an MCAP file; damaged parts are reported and left out. Raises `BagError` where it can't be read."""

    def __init__(self, path: Path, report: Callable[[DamageError], None]) -> None:
        self._path, self.report = path, report

    def topics(self, budget: Budget, *, by_reading: bool) -> tuple[list[tuple[TopicInfo, int]], bool]:
        """The topics with their message counts, and whether these are only claimed by the summary.

        The summary is trusted if it declares every channel that it counts, and not `by_reading`.
        """
        catalogue, counts = self._summary(budget)
        claimed = not by_reading and counts is not None and counts.keys() <= catalogue.channels.keys()
        if not claimed or counts is None:
            counts = Counter(channel for channel, *_ in self._all_messages(catalogue, budget))
        found = ((catalogue.topic(number), counts.get(number, 0)) for number in catalogue.channels)
        return [(topic, count) for topic, count in found if topic is not None], claimed

    def messages(self, budget: Budget) -> Iterator[StoredMessage]:
        """The messages in the order they were recorded."""
        catalogue, _ = self._summary(budget)
        for channel, log_ns, publish_ns, data in self._all_messages(catalogue, budget):
            topic = catalogue.topic(channel)
            if topic is None:
                self.report(DamageError("a message of the undeclared channel {}", channel))
            else:
                yield topic, log_ns, publish_ns, data

    @contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        """The open file; damage ends the `with` block and is reported."""
        file, _ = open_bag_file(self._path)
        with file:
            try:
                yield file
            except DamageError as damage:
                self.report(damage)
            except OSError as error:
                raise BagError(f"{self._path}: can't be read: {error.strerror}") from error

    def _summary(self, budget: Budget) -> tuple[_Catalogue, Mapping[int, int] | None]:
        """The channels that the summary at the file's end declares, and their message counts (None: it gives none)."""
        catalogue = _Catalogue(budget)
        counts: dict[int, int] | None = None
        with self._opened() as file:
            for opcode, content in read_summary(file):
                catalogue.add(opcode, content)
                if opcode == STATISTICS:
                    counts = parse_message_counts(content)
        return catalogue, counts

    def _all_messages(self, catalogue: _Catalogue, budget: Budget) -> Iterator[tuple[int, int, int, memoryview]]:
        with self._opened() as file:
            for opcode, content, place in iter_records(file):
                try:
                    if opcode == CHUNK:
                        for inner, record in split_records(unpack_chunk(content, budget)):
                            budget.spend("records")
                            if inner == MESSAGE:
                                yield parse_message(record)
                            else:
                                catalogue.add(inner, record)
                    elif opcode == MESSAGE:
                        yield parse_message(content)
                    else:
                        catalogue.add(opcode, content)
                except DamageError as damage:  # noqa: PERF203 - the next record may be whole
                    damage.where = f", in the record at byte {place}"
                    self.report(damage)
