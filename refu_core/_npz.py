"""Bounded reading of `.npz` and `.npy` files: no pickles, no surprises in size."""

from __future__ import annotations

import io
import lzma
import math
import pickle
import struct
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from refu_core._files import open_file
from refu_core.errors import RefuError

MAX_BYTES = 256 << 20
"""The most that all arrays taken from a file may need together, as float64: a body of 45,000 vertices, an hour of
motion at 120 Hz (half an hour with the hands of SMPL-X). Anything larger is refused before any of it is unpacked."""
_MAX_FILE_BYTES = 1 << 32
"""Only the directory and the wanted arrays of such a file are read."""
_MAX_READ = 1 << 20
"""A larger directory is cut off there, and so refused; the arrays are read in smaller steps."""
MAX_TEXT_BYTES = 1 << 15
"""The names of a skeleton's joints take a quarter of this."""
_MAX_AXES = 32
_MAX_HEADER_BYTES = 1 << 14
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""The compression methods that numpy writes; others may allocate gigabytes themselves."""
DAMAGE = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, RecursionError, MemoryError, OverflowError),
    *(EOFError, struct.error, TokenError, SyntaxError, NotImplementedError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, pickle.UnpicklingError),
)
"""What readers of archives, arrays and pickles raise on damaged files."""


def told(cause: BaseException) -> str:
    """What an error says about the damage."""
    return str(cause) or ("it is cut short" if isinstance(cause, EOFError) else type(cause).__name__)


class ArrayBudget:
    """How many numbers may still be taken from a file."""

    def __init__(self) -> None:
        self._left = MAX_BYTES // 8

    def take(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        """Raises `ValueError` if an array is too large, has too many axes, or isn't of plain numbers or text."""
        if len(shape) > _MAX_AXES:
            raise ValueError(f"an array of {len(shape)} axes")
        # An axis of length 0 doesn't make an array small: code loops over the other axes.
        count = math.prod(max(n, 1) for n in shape)
        is_text = dtype.kind in "US"
        if is_text and count * max(dtype.itemsize, 1) > MAX_TEXT_BYTES:
            raise ValueError(f"an array {shape} of {dtype}, at most {MAX_TEXT_BYTES} bytes of text are read")
        if not is_text and (dtype.kind not in "biuf" or dtype.itemsize > 8):
            raise ValueError(f"an array of {dtype}, wanted plain numbers of at most 64 bits")
        self._left -= count
        if self._left < 0:
            raise ValueError(f"an array {shape} takes {count >> 17} MiB as float64, at most {MAX_BYTES >> 20} are read")


def read_npz(path: Path, *, keys: Collection[str], error: type[RefuError], wanted: str) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` that are named in `keys`, as far as it has them: numbers or text.

    Raises `error`: the file can't be read, holds anything else under one of the keys, or holds more than `MAX_BYTES`.
    """
    with open_archive(path, error, wanted) as archive:
        names = {entry: entry.filename.removesuffix(".npy") for entry in archive.infolist()}
        entries = {name: entry for entry, name in names.items() if name in keys}
        if len(entries) < sum(name in keys for name in names.values()):
            raise ValueError("it has two arrays of one name")
        size = sum(entry.file_size for entry in entries.values())
        if size > MAX_BYTES:
            raise ValueError(f"unpacks to {size >> 20} MiB, at most {MAX_BYTES >> 20} MiB are read")
        budget = ArrayBudget()
        for entry in entries.values():
            _check_entry(archive, entry, budget)
        found: dict[str, NDArray[Any]] = {}
        for key, entry in entries.items():
            with archive.open(entry) as member:
                found[key] = npy.read_array(member, allow_pickle=False)
        return found


def npz_names(path: Path, *, error: type[RefuError], wanted: str) -> list[str]:
    """The names of the arrays in an archive. Raises `error` as `read_npz` does."""
    with open_archive(path, error, wanted) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


@contextmanager
def open_archive(path: Path, error: type[RefuError], wanted: str) -> Iterator[zipfile.ZipFile]:
    """An archive of arrays. Raises `error` if it can't be read, and for any damage that shows while it is open."""
    with open_file(path, most=_MAX_FILE_BYTES, error=error, wanted=wanted) as file:
        file.step = _MAX_READ
        try:
            with zipfile.ZipFile(file) as archive:
                yield archive
        except DAMAGE as cause:
            raise error(f"{path}: can't be read as .npz: {told(cause)}; wanted {wanted}") from cause


def check_npy(file: IO[bytes], size: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """The shape and type of the array in a file of `size` bytes, if the file holds what its header announces.

    Numpy allocates what a header announces before it looks for it, and lengthens a file that it maps for writing.
    Raises `ValueError`, and whatever else numpy raises on damaged headers.
    """
    head = io.BytesIO(file.read(_MAX_HEADER_BYTES))
    version = npy.read_magic(head)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"an array of the version {version}, which isn't read")
    shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(head)
    if dtype.hasobject:
        hint = "save plain numbers, of a sparse matrix what its toarray() gives"
        raise ValueError(f"an array of objects, which would be a pickle, and isn't read: {hint}")
    wanted, there = dtype.itemsize * math.prod(shape), size - head.tell()
    if wanted != there or min(shape, default=0) < 0:
        raise ValueError(f"an array {shape} of {dtype} takes {wanted} bytes, the file has {there}")
    return shape, dtype


def _check_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, budget: ArrayBudget) -> None:
    if entry.compress_type not in METHODS:
        raise ValueError(f"{entry.filename} is compressed by the method {entry.compress_type}, only deflate is read")
    if entry.compress_size > entry.file_size + (entry.file_size >> 8) + 1024:
        raise ValueError(f"{entry.filename} takes {entry.compress_size} bytes packed, and {entry.file_size} unpacked")
    try:
        with archive.open(entry) as file:
            budget.take(*check_npy(file, entry.file_size))
    except ValueError as cause:
        raise ValueError(f"{entry.filename.removesuffix('.npy')}: {cause}") from cause
