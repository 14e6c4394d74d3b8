"""The benchmark from its options to its result."""

from __future__ import annotations

from functools import partial
from typing import NoReturn

from tqdm import tqdm

from refu_lab.benchmark import _sections as sections
from refu_lab.benchmark._accuracy import accuracies
from refu_lab.benchmark._frames import load_pipelines
from refu_lab.benchmark._inputs import moments, read_stretches
from refu_lab.benchmark._machine import load_average, machine_facts
from refu_lab.benchmark._measure import one_core
from refu_lab.benchmark._options import BenchmarkOptions
from refu_lab.benchmark._rows import BenchmarkResult
from refu_lab.benchmark._starts import start_row


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
