"""The benchmark from its options to its result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from refu_core.benchmark import load_average, machine_facts, measure_rates, one_core
from refu_ros.benchmark import _sections as sections
from refu_ros.benchmark._accuracy import accuracies, truth_bag
from refu_ros.benchmark._frames import load_pipelines
from refu_ros.benchmark._inputs import Window, moments, read_stretches
from refu_ros.benchmark._options import BenchmarkOptions
from refu_ros.benchmark._rows import BenchmarkResult, Row
from refu_ros.benchmark._skips import SKIPS
from refu_ros.benchmark._starts import TWO, start, weights_mb


def benchmark(options: BenchmarkOptions, *, progress: bool = False) -> BenchmarkResult:
    """Measures everything, pinned to one core.

    Raises:
        RefuError: no motion, a bag or weights that can't be read, or a process that couldn't be started.
    """
    sizes = options.sizes
    result = BenchmarkResult(options.command, options.quick, skips=SKIPS)
    stretches = read_stretches(options.motions, options.bags, count=sizes.windows, length=sizes.frames)
    with one_core() as core, _bar(progress) as advance:
        result.machine = {**machine_facts(options.devices[-1]), "core": core, "load_before": load_average()}
        result.rates = measure_rates(quick=options.quick)
        backbone = ""
        for garment in options.worn:
            pipelines, missing = load_pipelines(garment, options, modes=sizes.modes)
            result.missing.update(missing)
            first = next(iter(pipelines))
            backbone = backbone or first[0]
            windows = moments(stretches, pipelines[first])
            figures = _figures(options, garment, pipelines, result, advance)
            _measure(result, options, garment, pipelines, windows, figures, advance)
        _start_processes(options, result, backbone, advance)
        result.machine["load_after"] = load_average()
    return result


def _measure(
    result: BenchmarkResult,
    options: BenchmarkOptions,
    garment: str,
    pipelines: sections.Pipelines,
    windows: list[Window],
    figures: dict[tuple[str, str], dict[str, float]],
    advance: Callable[[], None],
) -> None:
    for device in options.devices:
        if device != "cpu":
            pipelines, _ = load_pipelines(garment, options, modes=options.sizes.modes, device=device)
        section = sections.Section(
            garment=garment, windows=windows, options=options, result=result, progress=advance, device=device
        )
        is_main = garment == options.worn[0]
        sections.measure_frames(section, pipelines, figures)
        sections.measure_sdfs(section, network=is_main and options.sizes.has_network)
        if is_main:
            sections.measure_persons(section, pipelines)
            sections.measure_still(section, pipelines)
            if result.skips:
                sections.measure_skips(section, pipelines)
            sections.measure_paper(section, pipelines)
        if is_main and device == "cpu":
            sections.measure_growth(section)
            sections.count_work(section, pipelines)


def _figures(
    options: BenchmarkOptions,
    garment: str,
    pipelines: sections.Pipelines,
    result: BenchmarkResult,
    advance: Callable[[], None],
) -> dict[tuple[str, str], dict[str, float]]:
    """How right each pipeline is, by (backbone, mode)."""
    bag = truth_bag(garment, options.bags)
    if bag is None:
        result.missing[f"{garment}: errors"] = f"the repository's evaluation bags in {options.bags.name}/"
        return {}
    count = options.sizes.test_frames
    return accuracies(pipelines, garment, bag, frames=count, progress=advance)


def _start_processes(
    options: BenchmarkOptions, result: BenchmarkResult, backbone: str, advance: Callable[[], None]
) -> None:
    """Processes with two garments, one after the other."""
    unit = result.of("sdf", mode="plain", device="cpu")[0].ms_median
    sizes = weights_mb(options, TWO, backbone, options.sizes.starts[0])
    if len(sizes) < len(TWO):
        backbone = "skinned"
    cases = [(mode, False) for mode in options.sizes.starts]
    cases += [] if options.quick else [(options.sizes.starts[0], True)]
    for mode, first_ever in cases:
        found = start(options, mode=mode, backbone=backbone, first_ever=first_ever)
        ms = 1e3 * found.pop("first_mesh_s")
        figures = {**found, **{f"weights_mb_{name}": size for name, size in sizes.items()}}
        result.rows.append(
            Row(
                stage="start",
                mode=mode,
                garment=",".join(TWO),
                ms_median=ms,
                ratio=ms / unit,
                method="first start ever" if first_ever else "again",
                backbone=backbone,
                figures=figures,
            )
        )
        advance()


@contextmanager
def _bar(progress: bool) -> Iterator[Callable[[], None]]:
    with tqdm(desc="benchmark", unit="step", disable=None if progress else True) as bar:

        def advance() -> None:
            bar.update()

        yield advance
