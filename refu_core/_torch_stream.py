"""What torch wrote before its files were archives, and what a pickle of tensors still holds: numbers after pickles."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, BinaryIO

from refu_core._pickle_machine import Machine, exactly

MAGIC = 0x1950A86A20F9469CFC6C
"""The pickle that such a stream begins with is of this number alone."""
_SIZE = struct.Struct("<q")


def read_stream(file: BinaryIO) -> tuple[Any, Callable[[str], bytes]]:
    """What a stream holds whose magic number has been read, and what gives a storage's bytes by its key.

    Raises `ValueError`, `LookupError` or `struct.error` where it is damaged.
    """
    for _ in ("version", "machine"):
        Machine(is_model=False).run(file)
    machine = Machine(is_model=False)
    root = machine.run(file)
    keys = exactly(list, Machine(is_model=False).run(file))
    parts: dict[str, bytes] = {}
    for key in keys:
        (count,) = _SIZE.unpack(file.read(_SIZE.size))
        size = count * int(machine.storages[key][1])
        part = file.read(size) if size >= 0 else b""
        if len(part) != size:
            msg = f"a tensor of {size} bytes that was cut short"
            raise ValueError(msg)
        parts[key] = part
    return root, parts.__getitem__
