"""Bounded reading of `.npz` and `.npy` files: no pickles, no surprises in size."""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from tokenize import TokenError
from typing import IO, TYPE_CHECKING, Any

from numpy.lib import format as npy

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from refu_core.errors import RefuError

MAX_BYTES = 1 << 30
"""An archive that unpacks to more is refused before anything is unpacked."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""What numpy writes; other methods ask for gigabytes of their own."""
DAMAGE = (
    *(OSError, ValueError, TypeError, KeyError, RecursionError, MemoryError, OverflowError, EOFError, struct.error),
    *(TokenError, SyntaxError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError),
)
"""What zipfile and numpy raise on damaged files."""


def read_npz(path: Path, *, keys: Iterable[str], error: type[RefuError]) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` whose names are in `keys` (those that are there).

    Raises:
        error: the file can't be read, holds pickled objects under one of the keys, unpacks to more than 1 GiB, or to
            less than an array's header says.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > MAX_BYTES:
                msg = f"{path}: unpacks to {size >> 20} MiB, at most {MAX_BYTES >> 20} MiB are read"
                raise error(msg)
            entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            return {key: _read_entry(archive, entries[key]) for key in keys if key in entries}
    except DAMAGE as cause:
        if isinstance(cause, error):  # ours is a ValueError too
            raise
        msg = f"{path}: can't be read as .npz: {cause}"
        raise error(msg) from cause


def check_npy(file: IO[bytes], size: int) -> None:
    """Checks that a file of `size` bytes, read from its start on, holds the array that its header announces.

    Numpy makes room for what a header says before it looks for it, and lengthens a file that it maps to write.

    Raises `ValueError`, and what else numpy raises on damaged headers.
    """
    version = npy.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        msg = f"an array of the version {version}, which isn't read"
        raise ValueError(msg)
    shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    if dtype.hasobject:
        msg = "Object arrays cannot be loaded: they are pickles"
        raise ValueError(msg)
    wanted, there = dtype.itemsize * math.prod(shape), size - file.tell()
    if wanted != there or min(shape, default=0) < 0:
        msg = f"an array {shape} of {dtype} takes {wanted} bytes, the file has {there}"
        raise ValueError(msg)


def _read_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    if entry.compress_type not in _METHODS:
        msg = f"{entry.filename} is compressed by the method {entry.compress_type}, only deflate is read"
        raise ValueError(msg)
    with archive.open(entry) as file:
        check_npy(file, entry.file_size)
    with archive.open(entry) as file:
        array: NDArray[Any] = npy.read_array(file, allow_pickle=False)
    return array
