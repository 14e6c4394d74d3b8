"""Starts processes and measures what they need."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from refu_core import RefuError, WeightsError
from refu_core.modes import DEFAULT_GARMENTS
from refu_core.weights import load_weights, weights_folder
from refu_lab.benchmark._rows import BenchmarkRow
from refu_lab.commands.benchmark import BenchmarkOptions


def start_row(
    options: BenchmarkOptions, *, mode: str, backbone: str, unit_ms: float, first_ever: bool = False
) -> BenchmarkRow:
    """Seconds and megabytes of a process that loads two garments and dresses one person.

    `first_ever` makes it compile its kernels, as on a machine where nothing has run yet. `unit_ms` is the time of the
    plain query. Unless both garments have weights, the skinned template is worn.

    Raises:
        RefuError: the process failed.
    """
    sizes = _weights_mb(options, backbone, mode)
    backbone = backbone if len(sizes) == len(DEFAULT_GARMENTS) else "skinned"
    asked = {
        "garments": DEFAULT_GARMENTS,
        "sdf": mode,
        "backbone": backbone,
        "body": options.body,
        "collider": options.collider,
        "weights": None if options.weights is None else str(options.weights),
    }
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as empty:
        if first_ever:
            environment["WARP_CACHE_PATH"] = empty
        command = [sys.executable, str(Path(__file__).with_name("start.py")), repr(time.time()), json.dumps(asked)]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if run.returncode:
        last = (run.stderr.strip().splitlines() or ["no word about it"])[-1]
        msg = f"a process that was to dress one person failed: {last}"
        raise RefuError(msg)
    found: dict[str, float] = json.loads(run.stdout.strip().splitlines()[-1])
    ms = 1e3 * found.pop("first_mesh_cpu_s")
    return BenchmarkRow(
        stage="start",
        mode=mode,
        garment=",".join(DEFAULT_GARMENTS),
        ms_median=ms,
        ratio=ms / unit_ms,
        wall_ms_median=1e3 * found.pop("first_mesh_s"),
        method="first start ever" if first_ever else "again",
        backbone=backbone,
        figures={**found, **{f"weights_mb_{name}": size for name, size in sizes.items()}},
    )


def _weights_mb(options: BenchmarkOptions, backbone: str, mode: str) -> dict[str, float]:
    """Size on disk of each garment's basis and networks [MB], by name, of the garments that have them."""
    sizes = {}
    for garment in DEFAULT_GARMENTS:
        folder = weights_folder(garment, options.weights)
        with suppress(WeightsError):
            files = [*load_weights(folder / f"{backbone}-{mode}").files, *load_weights(folder / "basis").files]
            sizes[garment] = sum(file.stat().st_size for file in files) / 1e6
    return sizes
