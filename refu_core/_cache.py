"""What takes seconds to compute is kept in a folder of the user's, and computed again wherever it can't be."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._files import replacing
from refu_core._npz import read_npz
from refu_core.errors import RefuError


def cache_folder() -> Path:
    """`REFU_CACHE`, or `refu` in the user's folder for such files (`XDG_CACHE_HOME`, ~/.cache); it needs not exist."""
    chosen = os.environ.get("REFU_CACHE")
    if chosen:
        return Path(chosen)
    home = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(home) if home else Path.home() / ".cache") / "refu"
    except RuntimeError:  # a user without a home
        return Path(tempfile.gettempdir()) / "refu"


def recall(name: str, *, keys: Collection[str]) -> dict[str, NDArray[Any]] | None:
    """The arrays that were kept as `name`; None where there are none, or not all of `keys`."""
    path = cache_folder() / f"{name}.npz"
    try:
        found = read_npz(path, keys=keys, error=RefuError, wanted="what was kept")
    except RefuError:  # none, out of reach, or cut short by a crash
        return None
    return found if set(found) == set(keys) else None


def keep(name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Keeps arrays as `name`, whole or not at all; nothing is said where there is no room for them."""
    with contextlib.suppress(OSError):
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / f"{name}.npz") as file:
            np.savez(file, allow_pickle=False, **arrays)


@cache
def code_hash(*patterns: str) -> str:
    """Of the names and content of the project's files that match: other code or weights would make something else."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted({file for pattern in patterns for file in root.glob(pattern) if file.is_file()}):
        digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()
