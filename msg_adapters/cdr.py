"""Reading and writing XCDR1, the serialisation of ROS 2 messages.

Four bytes of encapsulation header (its second byte says the byte order) precede the payload; every primitive is aligned
to its size, counted from the start of the payload.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.errors import DecodeError, EncodeError

Buffer = bytes | bytearray | memoryview

HEADER_BYTES = 4
LITTLE_ENDIAN_HEADER = b"\x00\x01\x00\x00"
NS_PER_S = 1_000_000_000
_BYTE_ORDERS = {0: ">", 1: "<"}
# RTPS pads payloads to a multiple of 4; rclpy's serialize_message leaves up to 12 unused bytes after empty sequences.
_MAX_TRAILING = 15


class CdrReader:
    """Reads one message front to back; every length is checked against what is left before anything is allocated."""

    def __init__(self, data: Buffer) -> None:
        self._data = memoryview(data).cast("B")
        if len(self._data) < HEADER_BYTES:
            msg = f"wanted a CDR message with a header of {HEADER_BYTES} bytes, got {len(self._data)} bytes"
            raise DecodeError(msg)
        if self._data[0] != 0 or self._data[1] not in _BYTE_ORDERS:
            msg = f"wanted a plain CDR header (00 00 or 00 01), got {self._data[:2].hex(' ')}"
            raise DecodeError(msg)
        self._order = _BYTE_ORDERS[self._data[1]]
        self._at = HEADER_BYTES

    @property
    def place(self) -> int:
        """Where the next field begins, in bytes from the start."""
        return self._at

    def since(self, place: int) -> tuple[str, bytes]:
        """What was read since then, with the byte order: the same again is the same fields again, see `repeats`."""
        return self._order, bytes(self._data[place : self._at])

    def repeats(self, known: tuple[str, bytes]) -> bool:
        """Whether what `since` gave of another message comes next; if so it is skipped.

        Both must begin where the strictest of their alignments is satisfied.
        """
        order, raw = known
        if order != self._order or bytes(self._data[self._at : self._at + len(raw)]) != raw:
            return False
        self._at += len(raw)
        return True

    @property
    def remaining(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._at

    def align(self, size: int) -> None:
        """Skip padding up to a multiple of `size` bytes of payload."""
        self._at += (HEADER_BYTES - self._at) % size

    def skip(self, n_bytes: int) -> memoryview:
        """The next `n_bytes`, as a view."""
        if not 0 <= n_bytes <= self.remaining:
            msg = f"wanted {n_bytes} more bytes at byte {self._at}, the message has {max(self.remaining, 0)}"
            raise DecodeError(msg)
        view = self._data[self._at : self._at + n_bytes]
        self._at += n_bytes
        return view

    def numbers(self, codes: str) -> tuple[Any, ...]:
        """Consecutive primitives by their `struct` codes, each aligned to its own size."""
        values = []
        for code in codes:
            size = struct.calcsize(f"={code}")
            self.align(size)
            values.append(struct.unpack(f"{self._order}{code}", self.skip(size))[0])
        return tuple(values)

    def length(self, *, item_bytes: int) -> int:
        """Length of a sequence whose items take at least `item_bytes` each."""
        (count,) = self.numbers("I")
        if count * item_bytes > self.remaining:
            msg = (
                f"a sequence claims {count} items of at least {item_bytes} bytes, the message has {self.remaining} left"
            )
            raise DecodeError(msg)
        return int(count)

    def string(self) -> str:
        """A string: its length with the final NUL, the bytes in UTF-8."""
        raw = self.skip(self.length(item_bytes=1))
        if not raw:
            return ""  # some senders write an empty string without its NUL
        if raw[-1] != 0:
            msg = f"wanted a string that ends in NUL, got {bytes(raw[-16:])!r}"
            raise DecodeError(msg)
        try:
            return str(raw[:-1], "utf-8")
        except UnicodeDecodeError as error:
            msg = f"wanted a string in UTF-8, got {bytes(raw[:32])!r}: {error.reason}"
            raise DecodeError(msg) from None

    def array(self, kind: str, count: int) -> NDArray[Any]:
        """A read-only view of `count` numbers of a numpy kind ("f4", "f8") in the byte order of the message."""
        dtype = np.dtype(f"{self._order}{kind}")
        if count:  # an empty sequence isn't aligned
            self.align(dtype.itemsize)
        return np.frombuffer(self.skip(count * dtype.itemsize), dtype)

    def stamp_ns(self) -> int:
        """builtin_interfaces/Time (or Duration) in nanoseconds."""
        seconds, nanoseconds = self.numbers("iI")
        return int(seconds) * NS_PER_S + int(nanoseconds)

    def finish(self) -> None:
        """The message must end here, but for a few bytes of padding."""
        if self.remaining > _MAX_TRAILING:
            msg = f"{self.remaining} bytes follow the message's last field; is it of another type?"
            raise DecodeError(msg)


class CdrWriter:
    """Appends to a little-endian message; padding is zero, so equal values give equal bytes."""

    def __init__(self) -> None:
        self._payload = bytearray()

    def __len__(self) -> int:
        """Bytes of payload so far."""
        return len(self._payload)

    def align(self, size: int) -> None:
        """Pad to a multiple of `size` bytes."""
        self._payload += bytes(-len(self._payload) % size)

    def numbers(self, codes: str, *values: float) -> int:
        """Append primitives by their `struct` codes; returns the payload offset of the first one."""
        start = -1
        for code, value in zip(codes, values, strict=True):
            self.align(struct.calcsize(f"={code}"))
            start = len(self._payload) if start < 0 else start
            try:
                self._payload += struct.pack(f"<{code}", value)
            except (struct.error, OverflowError) as error:
                msg = f"{value!r} doesn't fit the message's field: {error}"
                raise EncodeError(msg) from None
        return start

    def string(self, text: str) -> None:
        """Append a string in UTF-8 with its length and final NUL."""
        try:
            raw = text.encode() + b"\0"
        except UnicodeEncodeError as error:
            msg = f"{text!r} can't be written in UTF-8: {error.reason}"
            raise EncodeError(msg) from None
        self.numbers("I", len(raw))
        self._payload += raw

    def strings(self, texts: Sequence[str]) -> None:
        """Append a sequence of strings."""
        self.numbers("I", len(texts))
        for text in texts:
            self.string(text)

    def array(self, kind: str, values: Any) -> int:
        """Append an array's numbers as a numpy kind ("f4", "f8"), without a length; returns their payload offset."""
        dtype = np.dtype(f"<{kind}")
        array = np.ascontiguousarray(values, dtype=dtype)
        if array.size:
            self.align(dtype.itemsize)
        start = len(self._payload)
        self._payload += array.tobytes()
        return start

    def sequence(self, kind: str, values: Any) -> None:
        """Append an unbounded sequence of numbers: its length, then the numbers."""
        self.numbers("I", int(np.size(values)))
        self.array(kind, values)

    def stamp(self, stamp_ns: int) -> int:
        """Append builtin_interfaces/Time (or Duration); returns its payload offset."""
        return self.numbers("iI", *split_stamp(stamp_ns))

    def header(self, stamp_ns: int, frame_id: str) -> int:
        """Append std_msgs/Header; returns the payload offset of its stamp."""
        at = self.stamp(stamp_ns)
        self.string(frame_id)
        return at

    def to_bytes(self) -> bytes:
        """The whole message with its encapsulation header."""
        return LITTLE_ENDIAN_HEADER + bytes(self._payload)


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds of a ROS time.

    Raises `EncodeError` when the seconds don't fit the message's 32 bits.
    """
    seconds, nanoseconds = divmod(int(stamp_ns), NS_PER_S)
    if not -(2**31) <= seconds < 2**31:
        msg = f"a ROS time holds 32 bits of seconds, got {stamp_ns} ns; give nanoseconds since the sender's epoch"
        raise EncodeError(msg)
    return seconds, nanoseconds
