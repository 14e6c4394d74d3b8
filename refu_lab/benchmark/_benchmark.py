"""The benchmark from its options to its result."""

from __future__ import annotations

import itertools
import os
import platform
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch
from tqdm import tqdm

import msg_adapters as adapters
from refu_core import GarmentPipeline
from refu_core.metrics import CollisionChecker, GarmentMetrics
from refu_lab.benchmark import _sections as sections
from refu_lab.benchmark._frames import load_pipelines
from refu_lab.benchmark._inputs import moments, read_stretches
from refu_lab.benchmark._measure import one_core
from refu_lab.benchmark._rows import BenchmarkResult
from refu_lab.benchmark._starts import start_row
from refu_lab.commands.benchmark import BenchmarkOptions
from refu_lab.truth import GroundTruth


def benchmark(options: BenchmarkOptions, *, progress: bool = False) -> BenchmarkResult:
    """Measures everything, pinned to one core; an interrupt (Ctrl-C) ends it early with what there is.

    Raises:
        RefuError: no motion, a bag or weights that can't be read, or a process that couldn't be started.
    """
    result = BenchmarkResult(options.command, options.quick)
    with one_core() as core, tqdm(desc="benchmark", unit="step", disable=None if progress else True) as bar:
        result.machine = {**machine_facts(options.devices[-1]), "core": core, "load_before": load_average()}
        try:
            _measure(options, result, bar)
        except KeyboardInterrupt:
            if not result.rows:
                raise
            result.interrupted = True
        result.machine["load_after"] = load_average()
    return result


def _measure(options: BenchmarkOptions, result: BenchmarkResult, bar: tqdm[NoReturn]) -> None:
    sizes = options.sizes
    stretches = read_stretches(options.motions, options.bags, count=sizes.windows, length=sizes.frames)
    for garment in options.worn:
        is_main = garment == options.worn[0]
        bar.set_description(f"{garment}: errors")
        pipelines, missing = load_pipelines(garment, options)
        result.missing.update(missing)
        windows = moments(stretches, next(iter(pipelines.values())))
        figures = accuracies(pipelines, garment, options.bags, frames=sizes.test_frames, progress=bar.update)
        if not figures:
            result.missing[f"{garment}: errors"] = f"the repository's evaluation bags in {options.bags.name}/"
        for device in options.devices:
            if device != "cpu":
                pipelines, _ = load_pipelines(garment, options, device=device)
            section = sections.Section(
                garment=garment, windows=windows, options=options, result=result, progress=bar.update, device=device
            )
            parts = {
                "frames": partial(sections.measure_frames, section, pipelines, figures),
                "distances": partial(sections.measure_sdfs, section, network=is_main and sizes.has_network),
            }
            of_main = sections.OF_MAIN_GARMENT.items() if is_main else ()
            for name, part in [*parts.items(), *((name, partial(of, section, pipelines)) for name, of in of_main)]:
                bar.set_description(f"{garment}, {device}: {name}")
                part()
    bar.set_description("starts")
    unit_ms = result.of("sdf", mode="plain", device="cpu")[0].ms_median
    backbone = result.of("frame")[0].backbone or "skinned"
    starts = [(mode, False) for mode in sizes.starts] + ([] if options.quick else [(sizes.starts[0], True)])
    for mode, first_ever in starts:
        row = start_row(options, mode=mode, backbone=backbone, unit_ms=unit_ms, first_ever=first_ever)
        result.rows.append(row)
        bar.update()


def load_average() -> float | None:
    """Processes that wanted a core in the last minute; None where the system doesn't say."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def machine_facts(device: str) -> dict[str, Any]:
    """Processor, cores, device and versions: plain values, ready for JSON."""
    facts: dict[str, Any] = {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    if torch.device(device).type == "cuda":
        facts["gpu"] = torch.cuda.get_device_name(device)
    return facts


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


FIGURES = ("mpve_mm", "vfcp_percent", "cfmp_percent", "max_depth_mm")
Key = TypeVar("Key")


def accuracies(
    pipelines: Mapping[Key, GarmentPipeline],
    garment: str,
    bags: Path,
    *,
    frames: int | None,
    progress: Callable[[], object],
) -> dict[Key, dict[str, float]]:
    """MPVE [mm], VFCP and CFMP [%] and the greatest depth [mm] of each pipeline in up to `frames` frames.

    They are those of the bag of unseen bodies with the true garment, `eval_<garment>`; empty where there is none.

    Raises:
        RefuError: the bag can't be read.
    """
    bag = bags / f"eval_{garment.replace('-', '_')}"
    if not bag.is_dir():
        return {}
    one = next(iter(pipelines.values()))
    faces = one.garments[garment].faces.cpu().numpy()
    checker = CollisionChecker(one.body.faces.cpu().numpy())
    truth = GroundTruth.of_bag(bag, {garment: faces})
    metrics = {key: GarmentMetrics(faces) for key in pipelines}
    with adapters.open_smpl_bag(bag) as source:
        for record in itertools.islice(source, frames):
            if record.frame is None:
                continue
            for i, (key, pipeline) in enumerate(pipelines.items()):
                output = pipeline(record.frame)
                if i == 0:  # they all dress the same body
                    checker.update(output.body)
                vertices = output[garment].local
                found = checker.check(vertices, faces)
                metrics[key].add(vertices, found, truth=truth.of(garment, record.frame))
                progress()
    summaries = {key: one.summary().as_dict() for key, one in metrics.items()}
    return {key: {name: float(s[name]) for name in FIGURES if s[name] is not None} for key, s in summaries.items()}
