"""What the project holds itself to in run time, and whether a run reached it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from refu_ros.benchmark._rows import BenchmarkResult, Row


class Goal(NamedTuple):
    """One figure and its bound."""

    name: str
    value: float
    bound: float
    is_least: bool = False
    """Whether the figure is to be at least its bound, not at most."""

    @property
    def is_reached(self) -> bool:
        """Whether this run's figure keeps to the bound."""
        return self.value >= self.bound if self.is_least else self.value <= self.bound


def goals(result: BenchmarkResult) -> list[Goal]:
    """Of what was measured on the CPU, of the main garment; a trial run's networks are too small to say anything."""
    return [] if result.quick else list(_goals(result))


def _goals(result: BenchmarkResult) -> Iterator[Goal]:
    main = result.rows[0].garment

    def rows(stage: str, mode: str) -> list[Row]:
        return [row for row in result.of(stage, mode=mode, device="cpu") if row.garment in (main, "")]

    for mode, distance, frame in (("accurate", 1 / 4, 1.0), ("hybrid", 1 / 8, 0.7)):
        for row in rows("sdf", mode)[:1]:
            yield Goal(f"{mode}: signed distance, ratio to the plain query", row.ratio, distance)
        for row in rows("frame", mode)[:1]:
            yield Goal(f"{mode}: whole frame, ratio to the plain query alone", row.ratio, frame)
        for row in rows("frame", "paper")[:1]:
            yield Goal(
                f"{mode}: times as fast as the paper's structure", row.figures[f"times_{mode}"], 100, is_least=True
            )
        for row in rows("unchanged", mode):
            yield Goal(f"{mode}: unchanged pose, % of the pipeline's time", 100 * row.figures["share_of_pipeline"], 5)
        for row in rows("persons", mode):
            if row.persons == 4:
                yield Goal(f"{mode}: four persons, ratio to one", row.figures["ratio_to_one_person"], 3.2)
    for row in result.of("start", method="again"):
        yield Goal(f"{row.mode}: first mesh of two garments, s of the processor", row.ms_median / 1e3, 5)
        if "resident_mb" in row.figures:
            yield Goal(f"{row.mode}: two garments, resident MB", row.figures["resident_mb"], 700)
        for name, size in row.figures.items():
            if name.startswith("weights_mb_") and row.mode == "hybrid":
                yield Goal(f"weights of {name.removeprefix('weights_mb_')}, MB", size, 12)
