"""Warp's cache of compiled kernels: damage heals by itself, and what can't be written is said in one line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

_LOAD = """
import sys
from refu_core.errors import RefuError
try:
    import warp as wp
    import refu_core.sdf._crossing_kernels
    wp.load_module("refu_core.sdf._crossing_kernels", device="cpu")
except RefuError as error:
    sys.exit(f"RefuError: {error}")
"""

_DAMAGE = """
import random, resource
from pathlib import Path
from refu_core import _kernel_cache

def load_again():
    wp.get_module("refu_core.sdf._crossing_kernels").unload()
    _kernel_cache._loaded.clear()
    wp.load_module("refu_core.sdf._crossing_kernels", device="cpu")

def flipped(data):
    data = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        data[rng.randrange(len(data))] ^= rng.randint(1, 255)
    return bytes(data)

input()  # until the other process is done
(folder,) = Path(wp.config.kernel_cache_dir).glob("wp_refu_core.sdf._crossing_kernels_*")
(built,), (meta,), sums = folder.glob("*.o"), folder.glob("*.meta"), folder / "refu-checksums.json"
rng, n_tried = random.Random(1), 0
for path in (built, meta, sums):
    whole = path.read_bytes()
    cuts = [whole[: rng.randrange(len(whole))] for _ in range(40)]
    holes = [whole[:i] + bytes(len(whole) - i) for i in (0, len(whole) // 2)]
    for bad in [b"", whole[:-1], *cuts, *holes, *(flipped(whole) for _ in range(40))]:
        path.write_bytes(bad)
        assert bad == whole or not _kernel_cache._is_whole(folder), (path.name, len(bad))
        n_tried += 1
    path.write_bytes(whole)
    assert _kernel_cache._is_whole(folder)

whole = built.read_bytes()
half = len(whole) // 2
damages = ((built, whole[:half]), (built, bytes(2 * half)), (built, flipped(whole)), (built, None), (meta, None))
for path, bad in damages:
    path.unlink() if bad is None else path.write_bytes(bad)
    load_again()
    assert _kernel_cache._is_whole(folder)
    assert len(built.read_bytes()) == len(whole)
print(n_tried + len(damages))

built.unlink()
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))  # a disk without room
try:
    load_again()
except RefuError as error:
    sys.exit(f"RefuError: {error}")
"""


def _start(cache: Path, program: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", program],
        env={**os.environ, "WARP_CACHE_PATH": str(cache)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _is_told_in_one_line(error: str, cache: Path) -> bool:
    last = error.splitlines()[-1]
    return (
        "Traceback" not in error
        and last.startswith(f"RefuError: compiled kernels can't be kept in {cache}")
        and "WARP_CACHE_PATH" in last
    )


def test_two_first_starts_at_once_then_every_damage_then_a_full_disk(tmp_path: Path) -> None:
    first, second = _start(tmp_path, _LOAD), _start(tmp_path, _LOAD + _DAMAGE)
    _, error = first.communicate(timeout=600)
    assert first.returncode == 0, error
    out, error = second.communicate(input="\n", timeout=600)
    assert int(out.splitlines()[-1]) > 200, error
    assert second.returncode == 1
    assert _is_told_in_one_line(error, tmp_path), error


def test_a_cache_that_cannot_be_made_is_told_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "cache"
    file.write_text("where a folder is wanted")
    process = _start(file, _LOAD)
    _, error = process.communicate(timeout=600)
    assert process.returncode == 1
    assert _is_told_in_one_line(error, file), error
