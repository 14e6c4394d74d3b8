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
from refu_core._numbers import NOT_NUMBERS, as_whole

Buffer = bytes | bytearray | memoryview

HEADER_BYTES = 4
LITTLE_ENDIAN_HEADER = b"\x00\x01\x00\x00"
NS_PER_S = 1_000_000_000
_BYTE_ORDERS = {0: ">", 1: "<"}
_PRIMITIVES = {order + code: struct.Struct(order + code) for order in "<>" for code in "?BbiIfd"}
# RTPS pads payloads to a multiple of 4; rclpy's serialize_message leaves up to 12 unused bytes after empty sequences.
_MAX_TRAILING = 15
MOST_ITEMS = 10_000
"""The most strings, transforms or markers in a sequence. They are read one by one: ten megabytes of them took up to
seven seconds, in which a node does nothing else."""


class CdrReader:
    """Reads one message front to back; every length is checked against what is left before anything is allocated."""

    def __init__(self, data: Buffer) -> None:
        self._data = memoryview(data).cast("B")
        if len(self._data) < HEADER_BYTES:
            msg = f"wanted a CDR message with a header of {HEADER_BYTES} bytes, got {len(self._data)} bytes"
            raise DecodeError(msg)
        if self._data[0] != 0 or self._data[1] not in _BYTE_ORDERS:
            raise DecodeError(f"wanted a plain CDR header (00 00 or 00 01), got {self._data[:2].hex(' ')}")
        self._order = _BYTE_ORDERS[self._data[1]]
        self.place = HEADER_BYTES
        """Where the next field begins, in bytes from the start."""

    def since(self, place: int) -> tuple[str, bytes]:
        """The bytes read since `place`, with their byte order: equal bytes hold equal fields, see `repeats`."""
        return self._order, bytes(self._data[place : self.place])

    def repeats(self, known: tuple[str, bytes]) -> bool:
        """Whether the bytes that `since` gave for another message come next; if so they are skipped.

        Both must begin where the strictest alignment of their fields is satisfied.
        """
        order, raw = known
        if order != self._order or bytes(self._data[self.place : self.place + len(raw)]) != raw:
            return False
        self.place += len(raw)
        return True

    @property
    def remaining(self) -> int:
        return len(self._data) - self.place

    def align(self, size: int) -> None:
        """Skip padding up to a multiple of `size` bytes of payload."""
        self.place += (HEADER_BYTES - self.place) % size

    def skip(self, n_bytes: int) -> memoryview:
        """The next `n_bytes`, as a view."""
        end = self.place + n_bytes
        if end > len(self._data):
            msg = f"wanted {n_bytes} more bytes at byte {self.place}, the message has {max(self.remaining, 0)}"
            raise DecodeError(msg)
        view = self._data[self.place : end]
        self.place = end
        return view

    def fields(self, codes: str) -> tuple[Any, ...]:
        """Consecutive fields: a `struct` code is a primitive, aligned to its size; s a string, T a time [ns]."""
        values: list[Any] = []
        for code in codes:
            if code == "s":
                values.append(self.string())
            elif code == "T":
                values.append(self.stamp_ns())
            else:
                values.append(self._primitive(code))
        return tuple(values)

    def _primitive(self, code: str) -> Any:
        primitive = _PRIMITIVES[self._order + code]
        self.align(primitive.size)
        return primitive.unpack(self.skip(primitive.size))[0]

    def length(self, *, item_bytes: int) -> int:
        """Length of a sequence whose items take at least `item_bytes` each."""
        count: int = self._primitive("I")
        if count * item_bytes > self.remaining:
            raise DecodeError(
                f"a sequence claims {count} items of at least {item_bytes} bytes, the message has {self.remaining} left"
            )
        return count

    def items(self, *, item_bytes: int) -> range:
        """A number for each item of a sequence that is read item by item."""
        count = self.length(item_bytes=item_bytes)
        if count > MOST_ITEMS:
            raise DecodeError(f"wanted up to {MOST_ITEMS} items in a sequence, got {count}")
        return range(count)

    def string(self) -> str:
        """A string: its length including the final NUL, then the bytes in UTF-8."""
        raw = self.skip(self.length(item_bytes=1))
        if not raw:
            return ""  # some senders write an empty string without its NUL
        if raw[-1] != 0:
            raise DecodeError(f"wanted a string that ends in NUL, got {bytes(raw[-16:])!r}")
        try:
            return str(raw[:-1], "utf-8")
        except UnicodeDecodeError as error:
            raise DecodeError(f"wanted a string in UTF-8, got {bytes(raw[:32])!r}: {error.reason}") from None

    def strings(self) -> list[str]:
        return [self.string() for _ in self.items(item_bytes=4)]

    def array(self, kind: str, count: int) -> NDArray[Any]:
        """A read-only view of `count` numbers of a numpy kind ("f4", "f8") in the byte order of the message."""
        dtype = np.dtype(f"{self._order}{kind}")
        if count:  # an empty sequence isn't aligned
            self.align(dtype.itemsize)
        return np.frombuffer(self.skip(count * dtype.itemsize), dtype)

    def stamp_ns(self) -> int:
        """builtin_interfaces/Time (or Duration) in nanoseconds."""
        seconds: int = self._primitive("i")
        nanoseconds: int = self._primitive("I")
        return seconds * NS_PER_S + nanoseconds

    def finish(self) -> None:
        """Check that the message ends here, apart from a few bytes of padding."""
        if self.remaining > _MAX_TRAILING:
            raise DecodeError(f"{self.remaining} bytes follow the message's last field; is it of another type?")


class CdrWriter:
    """Appends to a little-endian message; padding is zero, so equal values give equal bytes."""

    def __init__(self) -> None:
        self._payload = bytearray()

    def __len__(self) -> int:
        return len(self._payload)

    def align(self, size: int) -> None:
        """Pad to a multiple of `size` bytes."""
        self._payload += bytes(-len(self._payload) % size)

    def fields(self, codes: str, *values: Any) -> int:
        """Append fields by their codes, as in `CdrReader.fields`; returns the payload offset of the first one."""
        start = -1
        for code, value in zip(codes, values, strict=True):
            if code == "s":
                at = self._string(value)
            elif code == "T":
                at = self.fields("iI", *split_stamp(value))
            else:
                primitive = _PRIMITIVES["<" + code]
                self.align(primitive.size)
                at = len(self._payload)
                try:
                    self._payload += primitive.pack(value)
                except (struct.error, OverflowError) as error:
                    raise EncodeError(f"{value!r} doesn't fit the message's field: {error}") from None
            start = at if start < 0 else start
        return start

    def _string(self, text: str) -> int:
        """Append the text in UTF-8, with its length and a final NUL."""
        try:
            raw = text.encode() + b"\0"
        except UnicodeEncodeError as error:
            raise EncodeError(f"{text!r} can't be written in UTF-8: {error.reason}") from None
        at = self.fields("I", len(raw))
        self._payload += raw
        return at

    def strings(self, texts: Sequence[str]) -> None:
        self.fields("I" + "s" * len(texts), len(texts), *texts)

    def array(self, kind: str, values: Any) -> int:
        """Append an array's numbers as a numpy kind ("f4", "f8"), without a length; returns their payload offset.

        Raises `EncodeError` for doubles that float32 can't hold.
        """
        dtype = np.dtype(f"<{kind}")
        try:
            with np.errstate(over="raise"):
                array = np.ascontiguousarray(values, dtype=dtype)
        except FloatingPointError:
            largest = np.abs(values).max()
            raise EncodeError(f"wanted numbers that {dtype.name} can hold, got magnitudes up to {largest:g}") from None
        if array.size:
            self.align(dtype.itemsize)
        start = len(self._payload)
        self._payload += array.tobytes()
        return start

    def sequence(self, kind: str, values: Any) -> None:
        """Append an unbounded sequence of numbers, or of rows of them: its length, then the numbers."""
        self.fields("I", len(values))
        self.array(kind, values)

    def to_bytes(self) -> bytes:
        """The whole message with its encapsulation header."""
        return LITTLE_ENDIAN_HEADER + bytes(self._payload)


def split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Seconds and nanoseconds of a ROS time.

    Raises `EncodeError` for anything but a whole number, and when the seconds don't fit the message's 32 bits.
    """
    try:
        seconds, nanoseconds = divmod(as_whole(stamp_ns), NS_PER_S)
    except NOT_NUMBERS as error:
        raise EncodeError(f"a stamp is a whole number of nanoseconds, got {stamp_ns!r}") from error
    if not -(2**31) <= seconds < 2**31:
        msg = f"a ROS time holds 32 bits of seconds, got {stamp_ns} ns; give nanoseconds since the sender's epoch"
        raise EncodeError(msg)
    return seconds, nanoseconds
