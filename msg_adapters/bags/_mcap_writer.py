"""Writes an MCAP file record by record; a separate thread may pack its chunks.

The mcap package's own Writer isn't used: it copies each message, of about a megabyte, five times and packs chunks
while the caller waits. The tests compare the files of both, byte for byte.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import BinaryIO

import zstandard

from msg_adapters.bags._mcap import CHANNEL, CHUNK, DATA_END, FOOTER, MAGIC, MESSAGE, SCHEMA, STATISTICS

HEADER, MESSAGE_INDEX, CHUNK_INDEX, METADATA, METADATA_INDEX, SUMMARY_OFFSET = 0x01, 0x07, 0x08, 0x0C, 0x0D, 0x0E
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS_BYTES = 22
_LEVEL = 3
"""zstd's own default. It packs marker arrays to a sixth in 4.2 ms a frame (1.5 MB); levels 2 to -10 leave more, up to
three times as much, and save 0.1 to 2 ms."""


def _record(opcode: int, *content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, sum(map(len, content))) + b"".join(content)


def _text(value: str) -> bytes:
    return _bytes(value.encode())


def _bytes(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def _text_map(values: Mapping[str, str]) -> bytes:
    return _bytes(b"".join(_text(key) + _text(value) for key, value in values.items()))


def _number_map(values: Mapping[int, int]) -> bytes:
    return _bytes(b"".join(struct.pack("<HQ", key, value) for key, value in values.items()))


@dataclass(eq=False)
class _Chunk:
    """Records that are packed together."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    """Size of all parts [bytes]."""
    times: list[int] = field(default_factory=list)
    """Log time of each message [ns]."""
    index: dict[int, list[bytes]] = field(default_factory=dict)
    """Log time and place of the messages of each channel."""


class McapWriter:
    """Writes one MCAP file to a newly opened stream. Errors are the stream's own."""

    def __init__(self, stream: BinaryIO, *, chunk_bytes: int, in_background: bool) -> None:
        """With `in_background`, a thread packs and writes a full chunk while the next one fills; its errors are raised
        by the next call that waits for it."""
        self.whole = 0
        """Where the last complete record ends [bytes]."""
        self.n_whole = 0
        """Messages before that: those in complete chunks."""
        self._stream = stream
        self._chunk_bytes = chunk_bytes
        self._packer = zstandard.ZstdCompressor(level=_LEVEL)
        self._chunk = _Chunk()
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self.counts: dict[int, int] = {}
        """Messages of each channel that has any."""
        self.first_ns, self.last_ns = 0, 0
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._thread = ThreadPoolExecutor(1, "bag") if in_background else None
        self._under_way: Future[None] | None = None

    def start(self, *, profile: str, library: str) -> None:
        """Writes the first record."""
        self._write(MAGIC + _record(HEADER, _text(profile), _text(library)))

    def add_channel(self, topic: str, message_type: str, definition: str, metadata: Mapping[str, str]) -> int:
        """Declares a topic of CDR messages and, as `ros2msg` text, their type; returns the channel's number."""
        number = len(self._channels) + 1
        schema = (struct.pack("<H", number), _text(message_type), _text("ros2msg"), _text(definition))
        self._schemas.append(_record(SCHEMA, *schema))
        self._add(self._schemas[-1])
        channel = (struct.pack("<HH", number, number), _text(topic), _text("cdr"), _text_map(metadata))
        self._channels.append(_record(CHANNEL, *channel))
        self._add(self._channels[-1])
        return number

    def add_message(self, channel: int, data: bytes, *, log_time_ns: int) -> None:
        self.first_ns = min(self.first_ns, log_time_ns) if self.counts else log_time_ns
        self.last_ns = max(self.last_ns, log_time_ns)
        sequence = self.counts.get(channel, 0)
        self.counts[channel] = sequence + 1
        self._chunk.times.append(log_time_ns)
        self._chunk.index.setdefault(channel, []).append(struct.pack("<QQ", log_time_ns, self._chunk.size))
        length = _MESSAGE_FIELDS_BYTES + len(data)
        head = _MESSAGE.pack(MESSAGE, length, channel, sequence & 0xFFFFFFFF, log_time_ns, log_time_ns)
        self._add(head, bytes(data))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Appends a metadata record after everything written so far."""
        self.flush()
        record = _record(METADATA, _text(name), _text_map(values))
        place = struct.pack("<QQ", self._stream.tell(), len(record))
        self._metadata_indexes.append(_record(METADATA_INDEX, place, _text(name)))
        self._write(record)

    def flush(self) -> None:
        """Ends the chunk under way, and hands all messages to the operating system."""
        self._end_chunk()
        self._wait()
        self._stream.flush()

    def finish(self) -> None:
        """Writes the summary and the closing records; the stream stays open."""
        self.flush()
        self._write(_record(DATA_END, bytes(4)))
        start = self._stream.tell()
        statistics = struct.pack(
            "<QHIIIIQQ",
            sum(self.counts.values()),
            *(len(self._schemas), len(self._channels), 0, len(self._metadata_indexes), len(self._chunk_indexes)),
            *(self.first_ns, self.last_ns),
        )
        groups = {
            SCHEMA: self._schemas,
            CHANNEL: self._channels,
            STATISTICS: [_record(STATISTICS, statistics, _number_map(self.counts))],
            CHUNK_INDEX: self._chunk_indexes,
            0x0A: [],  # index of attachments
            METADATA_INDEX: self._metadata_indexes,
        }
        summary, offsets = b"", b""
        for opcode, records in groups.items():
            place = struct.pack("<BQQ", opcode, start + len(summary), sum(map(len, records)))
            offsets += _record(SUMMARY_OFFSET, place)
            summary += b"".join(records)
        footer = struct.pack("<BQQQ", FOOTER, 8 + 8 + 4, start, start + len(summary))
        self._write(summary + offsets + footer + struct.pack("<I", zlib.crc32(summary + offsets + footer)) + MAGIC)
        self.close()

    def close(self) -> None:
        """Ends the thread once it has written what is under way; its errors aren't raised."""
        if self._thread is not None:
            self._thread.shutdown(wait=True)

    def _add(self, *parts: bytes) -> None:
        self._chunk.parts += parts
        self._chunk.size += sum(map(len, parts))
        if self._chunk.size > self._chunk_bytes:
            self._end_chunk()

    def _end_chunk(self) -> None:
        if not self._chunk.times:  # declarations alone wait until a message comes
            return
        self._wait()
        full, self._chunk = self._chunk, _Chunk()
        if self._thread is None:
            self._write_chunk(full)
        else:
            self._under_way = self._thread.submit(self._write_chunk, full)

    def _wait(self) -> None:
        under_way, self._under_way = self._under_way, None
        if under_way is not None:
            under_way.result()

    def _write_chunk(self, chunk: _Chunk) -> None:
        records = b"".join(chunk.parts)
        chunk.parts.clear()
        packed = self._packer.compress(records)
        times, start = struct.pack("<QQ", min(chunk.times), max(chunk.times)), self._stream.tell()
        fields = struct.pack("<QI", len(records), zlib.crc32(records)) + _text("zstd")
        head = times + fields + struct.pack("<Q", len(packed))
        length = len(head) + len(packed)
        self._stream.write(struct.pack("<BQ", CHUNK, length) + head)
        self._stream.write(packed)
        end = start + 1 + 8 + length
        indexes = [
            _record(MESSAGE_INDEX, struct.pack("<H", channel), _bytes(b"".join(entries)))
            for channel, entries in chunk.index.items()
        ]
        places, at = {}, end
        for channel, index in zip(chunk.index, indexes, strict=True):
            places[channel] = at
            at += len(index)
        self._write(b"".join(indexes))
        self.n_whole += len(chunk.times)
        where = times + struct.pack("<QQ", start, end - start) + _number_map(places) + struct.pack("<Q", at - end)
        sizes = struct.pack("<QQ", len(packed), len(records))
        self._chunk_indexes.append(_record(CHUNK_INDEX, where, _text("zstd"), sizes))

    def _write(self, records: bytes) -> None:
        self._stream.write(records)
        self._stream.flush()
        self.whole = self._stream.tell()
