"""What `refu benchmark` measures, as rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from refu_lab.benchmark._measure import Timing


@dataclass(frozen=True, kw_only=True)
class BenchmarkRow:
    """How long one thing took."""

    stage: str
    """What was measured: `sdf`, `frame`, `frame.<stage>`, `persons`, `unchanged` or `start`."""
    mode: str
    """The pipeline's mode, or `plain`, `paper` or `other`."""
    garment: str
    ms_median: float
    """Median processor time; on a GPU, wall time [ms]."""
    ratio: float
    """Ratio of this time to that of the plain query (`PLAIN_QUERY`), measured in turn with it."""
    ms_q1: float | None = None
    ms_q3: float | None = None
    wall_ms_median: float | None = None
    samples: int = 1
    device: str = "cpu"
    method: str | None = None
    backbone: str | None = None
    persons: int | None = None
    vertices: int | None = None
    figures: Mapping[str, float] = field(default_factory=dict)
    """Further figures, by name with unit."""

    @classmethod
    def of(cls, timing: Timing, plain: Timing, **facts: Any) -> BenchmarkRow:
        """A row from a timing, and from that of the plain query measured in turn with it."""
        low, high = timing.quartiles
        return cls(
            ms_median=timing.median,
            ratio=timing.median / plain.median,
            ms_q1=low,
            ms_q3=high,
            wall_ms_median=timing.wall_median,
            samples=len(timing.ms),
            **facts,
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; what doesn't apply is left out."""
        values = {key: value for key, value in vars(self).items() if value is not None and key != "figures"}
        return {**values, **self.figures}


@dataclass(eq=False)
class BenchmarkResult:
    """Everything that the tables, the plot and the JSON file need."""

    command: str
    quick: bool
    machine: dict[str, Any] = field(default_factory=dict)
    rows: list[BenchmarkRow] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    """What wasn't measured, and what is needed to measure it."""

    def of(self, stage: str, **facts: Any) -> list[BenchmarkRow]:
        """The rows of a stage whose fields have the values in `facts`."""
        return [
            row
            for row in self.rows
            if row.stage == stage and all(getattr(row, key) == value for key, value in facts.items())
        ]

    def as_dict(self) -> dict[str, Any]:
        """The machine-readable result (`--json`)."""
        return {
            "command": self.command,
            "quick": self.quick,
            "machine": self.machine,
            "rows": [row.as_dict() for row in self.rows],
            "missing": self.missing,
        }
