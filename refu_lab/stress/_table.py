"""What `refu stress` prints."""

from __future__ import annotations

import math

from refu_lab.stress._rounds import StressResult
from refu_lab.stress._trial import Measurement
from refu_lab.tables import format_table


def stress_table(result: StressResult) -> str:
    """All rows, faults, and where the worst cases are."""
    lines = []
    if result.tallies:
        rows = []
        for tally in result.tallies:
            worst = tally.worst or Measurement()
            counts = (tally.runs, tally.failures, tally.nan, tally.refused)
            rows.append((tally.case, tally.mode, *map(str, counts), length(worst.deviation), length(worst.limit)))
        lines += [
            format_table(("case", "mode", "runs", "failures", "NaN", "refused", "deviation", "limit"), rows),
            "(deviation and limit are those of the worst trial; a few limits depend on the frame)",
            "",
        ]
    if result.soaks:
        header = ("soak", "frames", "NaN", "memory MB", "", "p99 ms", "", "wall p99 ms", "machine")
        soaks = [
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
            format_table(header, soaks),
            "(first tenth → last tenth; machine: of the processor time of a fixed piece of work)",
            "",
        ]
    lines += [f"{tally.case} ({tally.mode}): {fault}" for tally in result.tallies for fault in tally.faults]
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
