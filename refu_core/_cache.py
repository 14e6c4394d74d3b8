"""Keeps what takes seconds to compute in a folder of the user's; where that fails, it is computed again."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Callable, Collection, Mapping
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from refu_core._files import replacing
from refu_core._npz import read_npz
from refu_core.errors import RefuError

_P = ParamSpec("_P")
_T = TypeVar("_T")


def remembered(most: int) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Has a function of NumPy arrays remember its last `most` results, for arguments of the same content.

    Whoever gets a result shares it with others, and mustn't change it.
    """

    def wrap(of: Callable[_P, _T]) -> Callable[_P, _T]:
        known: dict[Any, _T] = {}

        @wraps(of)
        def call(*arguments: _P.args, **options: _P.kwargs) -> _T:
            key = _content([*arguments, *options.items()])
            found = known.pop(key, None)
            found = of(*arguments, **options) if found is None else found
            known[key] = found  # the newest is the last
            while len(known) > most:
                known.pop(next(iter(known)), None)
            return found

        return call

    return wrap


def _content(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, hashlib.blake2b(np.ascontiguousarray(value).data, digest_size=16).digest()
    return tuple(map(_content, value)) if isinstance(value, (list, tuple)) else value


def cache_folder() -> Path:
    """`REFU_CACHE`, or `refu` in the user's cache folder (`XDG_CACHE_HOME`, ~/.cache); it need not exist yet.

    A relative one is in the working directory of the first call, wherever the program goes afterwards.
    """
    own, shared = os.environ.get("REFU_CACHE"), os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        return _in_full((Path(own) if own else Path(shared, "refu")).expanduser())
    except (RuntimeError, OSError):  # a user without a home, a working directory that was removed
        return Path(tempfile.gettempdir()) / "refu"


@cache
def _in_full(folder: Path) -> Path:
    return folder.absolute()


def recall(name: str, *, keys: Collection[str]) -> dict[str, NDArray[Any]] | None:
    """The arrays that were kept as `name`; None if there are none, or not all of `keys`."""
    path = cache_folder() / f"{name}.npz"
    try:
        found = read_npz(path, keys=keys, error=RefuError, wanted="what was kept")
    except RefuError:  # none, out of reach, or cut short by a crash
        return None
    return found if set(found) == set(keys) else None


def keep(name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Keeps arrays as `name`, all of them or none; silent if they can't be written."""
    with contextlib.suppress(OSError):
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / f"{name}.npz") as file:
            np.savez(file, allow_pickle=False, **arrays)


@cache
def code_hash(*patterns: str) -> str:
    """Hash of the names and content of the project's matching files: other code or weights give other results."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted({file for pattern in patterns for file in root.glob(pattern) if file.is_file()}):
        digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()
