"""What `refu stress` does: numbers, guarantees, invariance and endurance of the pipeline, as a table and JSON."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from refu_core import stress
from refu_core._device import one_thread
from refu_core.garments import BUILTIN_GARMENTS
from refu_ros.tables import format_table

MODES: tuple[tuple[str, str], ...] = (("skinned", "accurate"), ("tailornet", "hybrid"))
"""Backbone and signed distance of the modes that are tried if none is named."""
_ROUNDS = 3
_QUICK_ROUNDS = 1
_FRAMES = 3_000
_QUICK_FRAMES = 200
_SOAK_SHARE = 0.3
"""Of the time of a long run."""
_MOST_FRAMES = 10_000_000


@dataclass(frozen=True, kw_only=True)
class StressOptions:
    """What to try; the fields are options of `refu stress`."""

    parts: tuple[str, ...] = stress.PARTS
    garments: tuple[str, ...] = BUILTIN_GARMENTS
    backbone: str | None = None
    sdf: str | None = None
    weights: Path | None = None
    frames: int | None = None
    persons: int = 1
    rounds: int | None = None
    hours: float | None = None
    quick: bool = False
    seed: int = 0
    output: Path | None = None

    def __post_init__(self) -> None:
        unknown = [part for part in self.parts if part not in stress.PARTS]
        if unknown:
            msg = f"no part {unknown[0]!r}: wanted {', '.join(stress.PARTS)}"
            raise stress.StressError(msg)
        if self.hours is not None and not 0 < self.hours < math.inf:
            msg = f"hours must be above zero, got {self.hours:g}"
            raise stress.StressError(msg)

    @property
    def modes(self) -> list[tuple[str, str]]:
        """Backbone and signed distance of each mode."""
        if self.backbone is None and self.sdf is None:
            return list(MODES)
        backbone = self.backbone or "skinned"
        return [(backbone, self.sdf or ("accurate" if backbone == "skinned" else "hybrid"))]

    @property
    def n_rounds(self) -> int:
        """How often each check has its turn, at least."""
        return self.rounds or (_QUICK_ROUNDS if self.quick or self.hours is not None else _ROUNDS)

    @property
    def n_frames(self) -> int:
        """Of each soak, at most."""
        default = _MOST_FRAMES if self.hours is not None else _QUICK_FRAMES if self.quick else _FRAMES
        return self.frames or default


@dataclass(frozen=True, kw_only=True)
class StressResult:
    """What came of it."""

    tallies: list[stress.Tally] = field(default_factory=list)
    soaks: list[stress.SoakResult] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    """What could not be tried, and why."""
    files: list[Path] = field(default_factory=list)
    """The worst cases."""

    @property
    def failures(self) -> int:
        """Trials, and tenths of soaks, that were beyond their limits."""
        return sum(tally.failures for tally in self.tallies) + sum(soak.failures for soak in self.soaks)

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        return {
            "rows": [*(tally.as_dict() for tally in self.tallies), *(soak.as_dict() for soak in self.soaks)],
            "left_out": self.left_out,
            "failures": self.failures,
        }


def run_stress(
    options: StressOptions, *, progress: bool, report: Callable[[StressResult], object] = id
) -> StressResult:
    """Tries all that was asked for; `report` gets what there is so far, every minute of a soak.

    Raises:
        StressError: there is nothing to try: no such part, or no weights of any garment.
        RefuError: as `GarmentPipeline.load`.
    """
    wardrobes, left_out = _wardrobes(options)
    result = StressResult(left_out=left_out)
    seconds = 0.0 if options.hours is None else 3600 * options.hours
    checks = tuple(check for check in stress.all_checks() if check.part in options.parts)
    soaks = "soak" in options.parts
    with one_thread():
        if checks:
            plan = stress.Plan(
                checks=checks,
                wardrobes=tuple(wardrobes),
                weights=options.weights,
                rounds=options.n_rounds,
                seconds=seconds * (1 - _SOAK_SHARE * soaks),
                seed=options.seed,
            )
            total = plan.rounds * len(plan.pairs()) if options.hours is None else None
            with tqdm(total=total, unit="check", disable=not progress, leave=False) as bar:
                result.tallies.extend(stress.run_checks(plan, tick=lambda _: bar.update()))
        for wardrobe in wardrobes if soaks else ():
            share = _SOAK_SHARE if checks else 1.0
            limit = share * seconds / len(wardrobes) if options.hours is not None else math.inf
            subject = stress.Subject(wardrobe, weights=options.weights)
            with tqdm(total=options.n_frames, unit="frame", disable=not progress, leave=False, mininterval=1) as bar:
                done = stress.soak(
                    subject.pipeline,
                    mode=f"{wardrobe.mode} {', '.join(wardrobe.garments)}",
                    frames=options.n_frames,
                    persons=options.persons,
                    seconds=limit,
                    seed=options.seed,
                    tick=bar.update,
                    report=_after(result, report),
                )
            result.soaks.append(done)
    if options.output is not None:
        result.files.extend(stress.save_worst(result.tallies, options.output))
    return result


def _after(done: StressResult, report: Callable[[StressResult], object]) -> Callable[[stress.SoakResult], object]:
    """Reports a soak together with what was done before it."""
    return lambda soak: report(replace(done, soaks=[*done.soaks, soak]))


def _wardrobes(options: StressOptions) -> tuple[list[stress.Wardrobe], list[str]]:
    """What is worn in all modes; and what isn't, for want of weights."""
    wardrobes, left_out = [], []
    for backbone, sdf in options.modes:
        found, missing = stress.wardrobes(options.garments, backbone=backbone, sdf=sdf, weights=options.weights)
        wardrobes += found
        left_out += [f"{name}: no weights of {backbone} {sdf}" for name in missing]
    if not wardrobes:
        msg = f"nothing to try: {'; '.join(left_out) or 'no garment was named'}"
        raise stress.StressError(msg)
    return wardrobes, left_out


def stress_table(result: StressResult) -> str:
    """What `refu stress` prints."""
    lines = []
    if result.tallies:
        header = ("case", "mode", "runs", "failures", "NaN", "refused", "deviation", "limit")
        rows = [
            (
                tally.case,
                tally.mode,
                str(tally.runs),
                str(tally.failures),
                str(tally.nan),
                str(tally.refused),
                length(tally.deviation),
                length(tally.limit),
            )
            for tally in result.tallies
        ]
        lines += [
            format_table(header, rows),
            "(deviation and limit are those of the worst trial; a few limits depend on the frame)",
            "",
        ]
    if result.soaks:
        soak_header = ("soak", "frames", "NaN", "memory MB", "", "p99 ms", "", "wall p99 ms", "machine")
        soak_rows = [
            (
                soak.mode,
                f"{soak.frames} by {soak.persons}",
                str(soak.nan),
                _first_last("{:.0f}", soak.tenths_mb),
                f"{100 * soak.growth:+.1f} %",
                _first_last("{:.1f}", soak.tenths_ms),
                f"{100 * soak.slowdown:+.1f} %",
                _first_last("{:.1f}", soak.tenths_wall_ms),
                f"{100 * soak.machine_slowdown:+.1f} %",
            )
            for soak in result.soaks
        ]
        lines += [
            format_table(soak_header, soak_rows),
            "(first tenth → last tenth; machine: of the processor time of a fixed piece of work)",
            "",
        ]
    for tally in result.tallies:
        lines += [f"{tally.case} ({tally.mode}): {fault}" for fault in tally.faults]
    lines += [f"left out: {text}" for text in result.left_out]
    if result.files:
        lines.append(f"worst cases: {result.files[0].parent}/*.npz, to be tried again with refu stress --replay FILE")
    lines.append("nothing failed" if not result.failures else f"{result.failures} FAILED")
    return "\n".join(lines)


def _first_last(form: str, tenths: tuple[float, ...]) -> str:
    return f"{form.format(tenths[0])} → {form.format(tenths[-1])}"


def length(metres: float) -> str:
    """A length with the unit that suits it."""
    if not math.isfinite(metres):
        return "-"
    for scale, unit in ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm")):
        if metres >= scale:
            return f"{metres / scale:.3g} {unit}"
    return "0" if metres < 1e-12 else f"{metres / 1e-12:.3g} pm"


def replay_worst(path: Path, options: StressOptions) -> StressResult:
    """Tries a saved trial again, with the options' weights; raises `StressError` for a file that isn't one."""
    with one_thread():
        tally = stress.replay_trial(path, weights=options.weights)
    return StressResult(tallies=[tally])
