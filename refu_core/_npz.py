"""Bounded reading of `.npz` files: no pickles, no surprises in size."""

from __future__ import annotations

import zipfile
import zlib
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from refu_core.errors import RefuError

MAX_BYTES = 1 << 30
"""An archive that unpacks to more is refused before anything is unpacked."""


def read_npz(path: Path, *, keys: Iterable[str], error: type[RefuError]) -> dict[str, NDArray[Any]]:
    """The arrays of an `.npz` whose names are in `keys` (those that are there).

    Raises:
        error: the file can't be read, holds pickled objects under one of the keys, or unpacks to more than 1 GiB.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            msg = f"{path}: unpacks to {size >> 20} MiB, at most {MAX_BYTES >> 20} MiB are read"
            raise error(msg)
        with np.load(path, allow_pickle=False) as arrays:
            return {key: arrays[key] for key in keys if key in arrays.files}
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error, EOFError, KeyError, NotImplementedError) as cause:
        if isinstance(cause, error):  # ours is a ValueError too
            raise
        msg = f"{path}: can't be read as .npz: {cause}"
        raise error(msg) from cause
