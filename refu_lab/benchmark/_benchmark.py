"""The benchmark from its options to its result."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from refu_core import GarmentPipeline, RefuError, WeightsError
from refu_core.modes import DEFAULT_GARMENTS
from refu_core.weights import load_weights, weights_folder
from refu_lab.benchmark import _sections as sections
from refu_lab.benchmark._measure import BenchmarkResult, BenchmarkRow, one_core
from refu_lab.benchmark._sdfs import moments, read_stretches
from refu_lab.commands.benchmark import BenchmarkOptions
from refu_lab.commands.replay import ReplayOptions
from refu_lab.replay import replay
from refu_lab.sources import open_source

FIGURES = ("mpve_mm", "vfcp_percent", "cfmp_percent", "max_depth_mm")
Key = tuple[str, str]


def benchmark(options: BenchmarkOptions, *, progress: bool = False) -> BenchmarkResult:
    """Measures everything, pinned to one core.

    Raises `RefuError`: no motion, a bag or weights that can't be read, or a process that couldn't be started.
    """
    result = BenchmarkResult(options.command, options.quick)
    with one_core() as core, tqdm(desc="benchmark", unit="step", disable=None if progress else True) as bar:
        result.machine = {**machine_facts(options.devices[-1]), "core": core, "load_before": os.getloadavg()[0]}
        _measure(options, result, bar.update)
        result.machine["load_after"] = os.getloadavg()[0]
    return result


def _measure(options: BenchmarkOptions, result: BenchmarkResult, progress: Callable[[], object]) -> None:
    sizes = options.sizes
    stretches = read_stretches(options.motions, options.bags, count=sizes.windows, length=sizes.frames)
    for garment in options.worn:
        is_main = garment == options.worn[0]
        pipelines, missing = sections.load_pipelines(garment, options)
        result.missing.update(missing)
        windows = moments(stretches, next(iter(pipelines.values())))
        figures = accuracies(pipelines, garment, options.bags, frames=sizes.test_frames)
        if not figures:
            result.missing[f"{garment}: errors"] = f"the repository's evaluation bags in {options.bags.name}/"
        for device in options.devices:
            if device != "cpu":
                pipelines, _ = sections.load_pipelines(garment, options, device=device)
            section = sections.Section(
                garment=garment, windows=windows, options=options, result=result, progress=progress, device=device
            )
            sections.measure_frames(section, pipelines, figures)
            sections.measure_sdfs(section, network=is_main and sizes.has_network)
            if is_main:
                sections.measure_persons(section, pipelines)
                sections.measure_still(section, pipelines)
                sections.measure_paper(section, pipelines)
    unit_ms = result.of("sdf", mode="plain", device="cpu")[0].ms_median
    backbone = result.of("frame")[0].backbone or "skinned"
    starts = [(mode, False) for mode in sizes.starts] + ([] if options.quick else [(sizes.starts[0], True)])
    for mode, first_ever in starts:
        row = start_row(options, mode=mode, backbone=backbone, unit_ms=unit_ms, first_ever=first_ever)
        result.rows.append(row)
        progress()


def machine_facts(device: str) -> dict[str, Any]:
    """Processor, cores, device and versions as plain values, ready for JSON."""
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    named = (line.partition(":")[2].strip() for line in cpuinfo if line.startswith("model name"))
    facts: dict[str, Any] = {
        "processor": next(named, platform.machine()),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    if torch.device(device).type == "cuda":
        facts["gpu"] = torch.cuda.get_device_name(device)
    return facts


def accuracies(
    pipelines: Mapping[Key, GarmentPipeline], garment: str, bags: Path, *, frames: int | None
) -> dict[Key, dict[str, float]]:
    """MPVE [mm], VFCP and CFMP [%] and the largest depth [mm] of each pipeline over up to `frames` frames.

    The frames are those of `eval_<garment>`, a bag of unseen bodies with the true garment; empty without such a bag.
    Raises `RefuError` if it can't be read.
    """
    bag = bags / f"eval_{garment.replace('-', '_')}"
    if not bag.is_dir():
        return {}
    options = ReplayOptions(input=bag, garments=(garment,), max_frames=frames)
    found = {}
    for key, pipeline in pipelines.items():
        figures = replay(options, source=open_source(options, pipeline)).after[garment].as_dict()
        found[key] = {name: float(figures[name]) for name in FIGURES if figures[name] is not None}
    return found


def start_row(options: BenchmarkOptions, *, mode: str, backbone: str, unit_ms: float, first_ever: bool) -> BenchmarkRow:
    """Seconds and megabytes of a process that loads two garments and dresses one person.

    `first_ever` makes it compile its kernels, as on a machine where nothing has run yet. `unit_ms` is the time of the
    plain query. Unless both garments have weights, the skinned template is worn. Raises `RefuError`: the process
    failed.
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
        raise RefuError(f"a process that was to dress one person failed: {last}")
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
