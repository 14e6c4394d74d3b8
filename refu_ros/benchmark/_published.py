"""What the paper prints of run time and error, on its own hardware, garments and data."""

from __future__ import annotations

from typing import NamedTuple

from refu_core.evaluation.reproduction import ALL, paper_figure


class Published(NamedTuple):
    """One mode, all garments together."""

    mode: str
    ms: float
    """Backbone, distances and ReFU, on the machine with a V100 (supplement, Tab. "time") [ms]."""
    mpve_mm: float | None
    vfcp_percent: float | None
    cfmp_percent: float | None


def published() -> list[Published]:
    """The paper's modes."""
    found = []
    for mode, sdf in (("approx", "sdf-approx"), ("hybrid", "sdf-approx"), ("accurate", "sdf-accurate")):
        parts = [paper_figure("time", ALL, component, "ms") for component in ("backbone", sdf, "refu")]
        errors = [
            paper_figure("comparison", ALL, f"refu-{mode}", m) for m in ("mpve_mm", "vfcp_percent", "cfmp_percent")
        ]
        found.append(Published(mode, sum(part for part in parts if part is not None), *errors))
    return found
