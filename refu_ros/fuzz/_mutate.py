"""Mutations: of bytes, of text, of JSON values. All draw from a `random.Random`, so a seed names a whole run."""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

_EDGES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 1 << 20, (1 << 31) - 1, 1 << 31, (1 << 32) - 1]
INTEGERS = [*_EDGES, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1]
"""Lengths and counts at which readers break."""
FLOATS = [0.0, -0.0, 1e-320, 1e-12, 1.0, -1.0, 3.15, 1e3, 1e9, 1e38, 1e300, float("inf"), float("-inf"), float("nan")]
ODD_VALUES: list[Any] = [
    *(None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**12, 10**400, 0.5, 1e308, float("nan"), float("inf")),
    *("", "x", "x" * 5000, "\0", "\ud800", "../../../etc/passwd", "9" * 400, "nan", [], {}, [[]], [0] * 100, {"": {}}),
]
"""What may stand in a JSON file where something else was expected."""
_MAX_GROWTH = 4096


def mutate_bytes(rng: random.Random, data: bytes, other: bytes = b"") -> bytes:
    """`data` with one to four mutations, mostly one."""
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(_MUTATIONS)(rng, content, other)
    return bytes(content)


def _flip(rng: random.Random, data: bytearray, _: bytes) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _set_byte(rng: random.Random, data: bytearray, _: bytes) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.randrange(256)


def _set_integer(rng: random.Random, data: bytearray, _: bytes) -> None:
    code, size = rng.choice((("<H", 2), ("<I", 4), ("<I", 4), ("<Q", 8), (">I", 4)))
    if len(data) >= size:
        # Fields lie on multiples of their size as a rule, but not in every format.
        at = rng.randrange(len(data) - size + 1)
        at -= at % size if rng.random() < 0.7 else 0
        value = (
            rng.choice(INTEGERS) if rng.random() < 0.7 else struct.unpack_from(code, data, at)[0] + rng.choice((-1, 1))
        )
        struct.pack_into(code, data, at, value % (1 << 8 * size))


def _set_float(rng: random.Random, data: bytearray, _: bytes) -> None:
    code, size = rng.choice((("<f", 4), ("<d", 8)))
    if len(data) >= size:
        at = rng.randrange(len(data) - size + 1) // 4 * 4
        value = rng.choice(FLOATS)
        struct.pack_into(code, data, at, float("inf") if size == 4 and 4e38 < value < float("inf") else value)


def _cut(rng: random.Random, data: bytearray, _: bytes) -> None:
    del data[rng.randrange(len(data) + 1) :]


def _remove(rng: random.Random, data: bytearray, _: bytes) -> None:
    at = rng.randrange(len(data) + 1)
    del data[at : at + rng.randrange(1, 17)]


def _insert(rng: random.Random, data: bytearray, _: bytes) -> None:
    at = rng.randrange(len(data) + 1)
    data[at:at] = rng.randbytes(rng.randrange(1, 17))


def _extend(rng: random.Random, data: bytearray, _: bytes) -> None:
    data += rng.choice((bytes(rng.randrange(64)), rng.randbytes(rng.randrange(64)), b"\xff" * rng.randrange(64)))


def _repeat(rng: random.Random, data: bytearray, _: bytes) -> None:
    start = rng.randrange(len(data) + 1)
    part = data[start : start + rng.choice((1, 4, 16, 64, 256))]
    if part:
        data[start:start] = part * rng.randrange(1, max(2, min(256, _MAX_GROWTH // len(part))))


def _splice(rng: random.Random, data: bytearray, other: bytes) -> None:
    start = rng.randrange(len(other) + 1)
    part = other[start : start + rng.randrange(1, 257)]
    at = rng.randrange(len(data) + 1)
    data[at : at + (len(part) if rng.random() < 0.5 else 0)] = part


_MUTATIONS: list[Callable[[random.Random, bytearray, bytes], None]] = [
    *(_flip, _flip, _set_byte, _set_integer, _set_integer, _set_float),
    *(_cut, _remove, _insert, _extend, _repeat, _splice),
]


def mutate_text(rng: random.Random, data: bytes, words: list[bytes]) -> bytes:
    """Text with words of its language put in, taken out and repeated, or with damaged bytes."""
    if rng.random() < 0.3:
        return mutate_bytes(rng, data)
    parts = data.split(b" ")
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(parts))
        parts[at : at + rng.randrange(2)] = [rng.choice(words)] * rng.choice((0, 1, 1, 2, 50))
        parts = parts or [b""]
    return b" ".join(parts)


def mutate_json(rng: random.Random, data: bytes, odd: list[Any] = ODD_VALUES) -> bytes:
    """A JSON file with odd values in odd places, nested beyond reason, or damaged as text."""
    if rng.random() < 0.15:
        return mutate_bytes(rng, data)
    if rng.random() < 0.02:
        return rng.choice((b"[", b'{"a":')) * rng.choice((100, 5_000, 200_000))
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return mutate_bytes(rng, data)
    for _ in range(rng.randrange(1, 4)):
        value = mutate_value(rng, value, odd)
    try:
        return json.dumps(value).encode()
    except (ValueError, RecursionError):
        return mutate_bytes(rng, data)


def mutate_value(rng: random.Random, value: Any, odd: list[Any] = ODD_VALUES) -> Any:
    """A value as JSON knows them, with one entry somewhere replaced, removed, added or doubled."""
    if not isinstance(value, (dict, list)) or not value or rng.random() < 0.1:
        if isinstance(value, (int, float)) and rng.random() < 0.3:
            return rng.choice((-value, value + 1, value - 1, value * 2, [value], str(value)))
        return rng.choice(odd)
    keys = list(value) if isinstance(value, dict) else range(len(value))
    key = rng.choice(keys)
    result = value.copy()
    action = rng.random()
    if action < 0.75:
        result[key] = mutate_value(rng, value[key], odd)
    elif action < 0.85:
        del result[key]
    elif isinstance(result, list):
        result.insert(key, rng.choice((value[key], rng.choice(odd))))
    else:
        result[rng.choice(("", "extra", f"{key} "))] = rng.choice(odd)
    return result
