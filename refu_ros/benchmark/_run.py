"""The benchmark from its options to its result."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from tqdm import tqdm

from refu_core.benchmark import load_average, machine_facts, measure_rates, one_core
from refu_core.realtime import SKIPS
from refu_ros.benchmark import _sections as sections
from refu_ros.benchmark._accuracy import accuracies, truth_bag
from refu_ros.benchmark._frames import load_pipelines
from refu_ros.benchmark._inputs import Window, moments, read_stretches
from refu_ros.benchmark._options import BenchmarkOptions
from refu_ros.benchmark._rows import BenchmarkResult, Row
from refu_ros.benchmark._starts import TWO, start, weights_mb


def benchmark(options: BenchmarkOptions, *, progress: bool = False) -> BenchmarkResult:
    """Measures everything, pinned to one core; an interrupt (Ctrl-C) ends it early with what there is.

    Raises:
        RefuError: no motion, a bag or weights that can't be read, or a process that couldn't be started.
    """
    result = BenchmarkResult(options.command, options.quick, skips=SKIPS)
    with one_core() as core, _Bar(shown=progress) as bar:
        result.machine = {**machine_facts(options.devices[-1]), "core": core, "load_before": load_average()}
        try:
            _Run(options, result, bar).everything()
        except KeyboardInterrupt:
            if not result.rows:
                raise
            result.interrupted = True
        result.machine["load_after"] = load_average()
    return result


class _Run:
    """One run's parts, in their order."""

    def __init__(self, options: BenchmarkOptions, result: BenchmarkResult, bar: _Bar) -> None:
        self._options, self._sizes = options, options.sizes
        self._result = result
        self._bar = bar

    def everything(self) -> None:
        stretches = read_stretches(
            self._options.motions, self._options.bags, count=self._sizes.windows, length=self._sizes.frames
        )
        self._result.rates = measure_rates(quick=self._options.quick)
        for garment in self._options.worn:
            self._bar.announce(f"{garment}: errors")
            pipelines, missing = load_pipelines(garment, self._options, modes=self._sizes.modes)
            self._result.missing.update(missing)
            windows = moments(stretches, next(iter(pipelines.values())))
            self._times(garment, pipelines, windows, self._errors(garment, pipelines))
        self._bar.announce("starts")
        self._starts()

    def _errors(self, garment: str, pipelines: sections.Pipelines) -> dict[tuple[str, str], dict[str, float]]:
        """How right each pipeline is, by (backbone, mode)."""
        bag = truth_bag(garment, self._options.bags)
        if bag is None:
            self._result.missing[f"{garment}: errors"] = (
                f"the repository's evaluation bags in {self._options.bags.name}/"
            )
            return {}
        return accuracies(pipelines, garment, bag, frames=self._sizes.test_frames, progress=self._bar.step)

    def _times(
        self,
        garment: str,
        pipelines: sections.Pipelines,
        windows: list[Window],
        figures: dict[tuple[str, str], dict[str, float]],
    ) -> None:
        is_main = garment == self._options.worn[0]
        for device in self._options.devices:
            if device != "cpu":
                pipelines, _ = load_pipelines(garment, self._options, modes=self._sizes.modes, device=device)
            section = sections.Section(
                garment=garment,
                windows=windows,
                options=self._options,
                result=self._result,
                progress=self._bar.step,
                device=device,
            )
            network = is_main and self._sizes.has_network
            parts: dict[str, Callable[[], None]] = {
                "frames": partial(sections.measure_frames, section, pipelines, figures),
                "distances": partial(sections.measure_sdfs, section, network=network),
            }
            if is_main:
                of_main = sections.OF_MAIN_GARMENT.items()
                parts |= {name: partial(measure, section, pipelines) for name, measure in of_main}
            if is_main and device == "cpu":
                parts["growth"] = partial(sections.measure_growth, section)
                parts["limits"] = partial(sections.count_work, section, pipelines)
            for name, part in parts.items():
                self._bar.announce(f"{garment}, {device}: {name}")
                part()

    def _starts(self) -> None:
        """Processes with two garments, one after the other."""
        unit = self._result.of("sdf", mode="plain", device="cpu")[0].ms_median
        modes = self._sizes.starts
        backbone = self._result.of("frame")[0].backbone or "skinned"
        sizes = weights_mb(self._options, TWO, backbone, modes[0])
        if len(sizes) < len(TWO):
            backbone = "skinned"
        for mode, first_ever in [
            *((mode, False) for mode in modes),
            *([] if self._options.quick else [(modes[0], True)]),
        ]:
            found = start(self._options, mode=mode, backbone=backbone, first_ever=first_ever)
            ms = 1e3 * found.pop("first_mesh_cpu_s")
            self._result.rows.append(
                Row(
                    stage="start",
                    mode=mode,
                    garment=",".join(TWO),
                    ms_median=ms,
                    ratio=ms / unit,
                    wall_ms_median=1e3 * found.pop("first_mesh_s"),
                    method="first start ever" if first_ever else "again",
                    backbone=backbone,
                    figures={**found, **{f"weights_mb_{name}": size for name, size in sizes.items()}},
                )
            )
            self._bar.step()


class _Bar:
    """How far it is, and with what."""

    def __init__(self, *, shown: bool) -> None:
        self._bar = tqdm(desc="benchmark", unit="step", disable=None if shown else True)

    def announce(self, part: str) -> None:
        """Names what comes next."""
        self._bar.set_description(part)

    def step(self) -> None:
        """One step more is done."""
        self._bar.update()

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
