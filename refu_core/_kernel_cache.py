"""Warp's cache of compiled kernels, checked before it is used: what a crash has cut short is built again.

Warp loads whatever lies in its cache. An object that a power cut, a full disk or a copy has damaged fails at every
start, or ends the process. So checksums are kept beside the files of each module, written once it has been loaded;
files that don't match them are thrown away unread.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp
from filelock import FileLock

from refu_core._device import is_device_loss
from refu_core.errors import RefuError

_SUMS = "refu-checksums.json"
_PATIENCE = 600.0
"""How long to wait for another process that is compiling [s]; the very first start takes ten."""
_lock = threading.RLock()
_loaded: set[tuple[str, str, int | None]] = set()


def no_cache(reason: OSError) -> RefuError:
    """The error to raise where compiled kernels can't be kept."""
    folder = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH") or "Warp's cache"
    hint = "make room there and make it writable, or set WARP_CACHE_PATH to a folder that is"
    return RefuError(f"compiled kernels can't be kept in {folder}: {reason}; {hint}")


def guard() -> None:
    """Makes Warp load this project's kernels through `_load` from now on; other kernels are loaded as before."""
    module = type(wp.get_module(__name__))
    plain = module.load

    @functools.wraps(plain)
    def load(self: Any, device: Any, block_dim: int | None = None, *args: Any, **kwargs: Any) -> Any:
        key = (self.name, str(device), block_dim)
        if key in _loaded or not self.name.startswith("refu_core."):
            return plain(self, device, block_dim, *args, **kwargs)
        with _lock:  # of two threads loading a module, one would unload the other's
            loaded = _load(self, block_dim, lambda: plain(self, device, block_dim, *args, **kwargs))
            _loaded.add(key)
        return loaded

    module.load = load


def _load(module: Any, block_dim: int | None, plain: Callable[[], Any]) -> Any:
    """Loads a module from its compiled files if they are intact, or else builds them anew.

    Raises `RefuError`: there is no place for the files, or new ones can't be loaded either.
    """
    cache = Path(wp.config.kernel_cache_dir)
    folder = cache / f"wp_{module.name}_{module.get_module_hash(block_dim).hex()[:7]}"
    has_failed = False
    if _is_whole(folder):
        try:
            return plain()
        except Exception as error:  # Warp raises bare ones
            if is_device_loss(error):
                raise
            has_failed = True
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with FileLock(cache / "refu.lock", timeout=_PATIENCE):
            # Another process may have built it while this one waited.
            if folder.exists() and (has_failed or not _is_whole(folder)):
                shutil.rmtree(folder)
            return _build(module, folder, plain)
    except OSError as error:
        raise no_cache(error) from error


def _build(module: Any, folder: Path, plain: Callable[[], Any]) -> Any:
    module.mark_modified()  # makes Warp forget that it has failed
    try:
        loaded = plain()
    except Exception as error:
        if isinstance(error, OSError) or is_device_loss(error):
            raise
        raise RefuError(f"the kernels of {module.name} can't be built ({error}): delete {folder}, try again") from error
    with contextlib.suppress(OSError):  # the kernels are loaded; without checksums the next start builds them again
        part = folder / f"{_SUMS}.part"
        part.write_text(json.dumps(_sums(folder)))
        part.replace(folder / _SUMS)
    return loaded


def _is_whole(folder: Path) -> bool:
    try:
        known = json.loads((folder / _SUMS).read_bytes())
        return bool(known) and known == _sums(folder)
    except (OSError, ValueError):
        return False


def _sums(folder: Path) -> dict[str, str]:
    """SHA-256 of each file, by name."""
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith(_SUMS))
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
