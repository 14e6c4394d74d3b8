"""What a process of its own needs: time until the first garments, and memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

from refu_core import RefuError
from refu_core.weights import shipped_weights
from refu_ros.benchmark._options import BenchmarkOptions

TWO = ("tshirt-male", "short-pant-male")
"""The garments that are loaded together."""


def start(options: BenchmarkOptions, *, mode: str, backbone: str, first_ever: bool = False) -> dict[str, float]:
    """Starts a process that loads two garments and dresses one person; its seconds and its megabytes.

    `first_ever` has it compile its kernels, as on a machine where nothing has run yet.

    Raises:
        RefuError: it failed.
    """
    command = [sys.executable, "-m", "refu_core.benchmark.start"]
    command += ["--garments", ",".join(TWO), "--sdf", mode, "--backbone", backbone]
    command += ["--weights", str(options.weights)] if options.weights is not None else []
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as empty:
        if first_ever:
            environment["WARP_CACHE_PATH"] = empty
        run = subprocess.run(
            [*command, "--started", repr(time.time())], env=environment, capture_output=True, text=True, check=False
        )
    if run.returncode:
        last = (run.stderr.strip().splitlines() or ["no word about it"])[-1]
        msg = f"a process that was to dress one person failed: {last}"
        raise RefuError(msg)
    found = json.loads(run.stdout.strip().splitlines()[-1])
    return {key: float(value) for key, value in found.items() if value is not None}


def weights_mb(options: BenchmarkOptions, garments: Sequence[str], backbone: str, mode: str) -> dict[str, float]:
    """Size on disk of each garment's basis and networks [MB], by name; of those that there are."""
    sizes = {}
    for garment in garments:
        folder = shipped_weights(garment) if options.weights is None else options.weights / garment
        files = [folder / f"{name}.safetensors" for name in ("basis", f"{backbone}-{mode}")]
        if all(file.is_file() for file in files):
            sizes[garment] = sum(file.stat().st_size for file in files) / 1e6
    return sizes
