"""The figures that the paper and its supplement print."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

_MAIN = ("mpve_mm", "vfcp_percent", "cfmp_percent")
_PRINTED = json.loads(Path(__file__).with_name("paper.json").read_text(encoding="utf-8"))
"""By table: the methods, and their values by garment (empty where the supplement doesn't say which) and metric."""

PAPER: Mapping[tuple[str, str, str, str], float] = {
    (table, garment, method, metric): value
    for table, printed in _PRINTED.items()
    for garment, metrics in printed["garments"].items()
    for metric, values in metrics.items()
    for method, value in zip(printed["methods"], values, strict=True)
}
"""(table, garment, method, metric) to what the paper prints."""


def paper_figure(table: str, garment: str, method: str, metric: str) -> float | None:
    """What the paper prints; None where it prints nothing.

    Where it doesn't name the garment, its figure stands beside that of any of ours. Its changes against the baseline
    ("Trend") are computed anew from its own figures: the printed ones of VFCP aren't (.60 to .24 is -60 %, not -97.5
    %).
    """
    if metric.endswith("_trend"):
        value, base = (paper_figure(table, garment, m, metric[: -len("_trend")]) for m in (method, "tailornet"))
        return None if value is None or not base else 100.0 * (value - base) / base
    return PAPER.get((table, garment, method, metric), PAPER.get((table, "", method, metric)))


def published_modes() -> dict[str, dict[str, float]]:
    """The paper's modes, all garments together: `ms` of a frame on a V100, and the errors."""
    found = {}
    for mode, sdf in (("approx", "sdf-approx"), ("hybrid", "sdf-approx"), ("accurate", "sdf-accurate")):
        ms = sum(PAPER["time", "all", component, "ms"] for component in ("backbone", sdf, "refu"))
        found[mode] = {"ms": ms} | {metric: PAPER["comparison", "all", f"refu-{mode}", metric] for metric in _MAIN}
    return found
