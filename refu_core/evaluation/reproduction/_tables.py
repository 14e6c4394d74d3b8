"""A table of the reproduction: rows of figures, each beside the paper's, as Markdown and JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from refu_core.evaluation.reproduction._paper import paper_figure

ALL = "all"
"""Stands for all garments, weighted by their numbers of test samples."""


class Metric(NamedTuple):
    """How a metric is written."""

    label: str
    digits: int
    higher_is_better: bool = False


METRICS: Mapping[str, Metric] = {
    "mpve_mm": Metric("MPVE [mm]", 2),
    "vfcp_percent": Metric("VFCP [%]", 3),
    "cfmp_percent": Metric("CFMP [%]", 2, higher_is_better=True),
    "avg_vf": Metric("Avg. VF", 2),
    "avg_ee": Metric("Avg. EE", 2),
    "laplacian_mm": Metric("local Laplacian error [mm]", 2),
    "max_depth_mm": Metric("deepest [mm]", 1),
    "mean_energy": Metric("mean energy [m²]", 6),
    "median_energy": Metric("median energy [m²]", 6),
    "low_energy_percent": Metric("energy below 2.5e-3 [%]", 1, higher_is_better=True),
    "zero_energy_percent": Metric("energy zero [%]", 1, higher_is_better=True),
    "mean_absolute_mm": Metric("mean absolute error [mm]", 2),
    "mean_relative_percent": Metric("mean relative error [%]", 2),
    "p99_mm": Metric("99th percentile [mm]", 2),
    "missed_percent": Metric("wrong by over 2 mm [%]", 3),
    "hidden_percent": Metric("over 2 mm inside, taken for outside [%]", 4),
    "ms": Metric("median time [ms]", 2),
    "times": Metric("times what the node does about collisions", 1, higher_is_better=True),
    "jitter_mm": Metric("jitter [mm/frame²]", 3),
    "mpve_mm_trend": Metric("MPVE, change [%]", 1),
    "vfcp_percent_trend": Metric("VFCP, change [%]", 1),
    "cfmp_percent_trend": Metric("CFMP, change [%]", 1, higher_is_better=True),
}
"""The metrics by the names they have in JSON. Those of a group that a table makes up (`error @ 1.5`) aren't here."""


class Row(NamedTuple):
    """One figure, and the paper's; its fields are the keys of a row in JSON."""

    table: str
    garment: str
    method: str
    metric: str
    value: float | None
    """None where nothing was measured: not trained, or no sample that the metric is about."""
    paper: float | None

    @classmethod
    def of(cls, table: str, garment: str, method: str, metric: str, value: float | None) -> Row:
        """A row with the paper's figure looked up."""
        return cls(table, garment, method, metric, value, paper_figure(table, garment, method, metric))


@dataclass(frozen=True)
class Missing:
    """Why a method has no figures for a garment, and what to do about that."""

    garment: str
    method: str
    reason: str
    command: str
    """The command that makes what is missing."""

    def as_dict(self) -> dict[str, str]:
        """The fields by name, ready for JSON."""
        return asdict(self)


@dataclass(eq=False)
class Table:
    """One table: what it says, what it lacks, what it is about."""

    name: str
    title: str
    about: str
    """What was measured and how, as Markdown."""
    rows: list[Row] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    """What agrees with the paper and what doesn't, a sentence each, as Markdown."""
    plots: list[tuple[str, str]] = field(default_factory=list)
    """(file name, caption)."""

    def value(self, garment: str, method: str, metric: str) -> float | None:
        """The figure measured; None where there is none."""
        for row in self.rows:
            if (row.garment, row.method, row.metric) == (garment, method, metric):
                return row.value
        return None

    def as_dict(self) -> dict[str, Any]:
        """The table, ready for JSON."""
        return {
            "table": self.name,
            "title": self.title,
            "rows": [row._asdict() for row in self.rows],
            "missing": [missing.as_dict() for missing in self.missing],
            "findings": self.findings,
        }

    def markdown(self, labels: Mapping[str, str], *, source: str) -> str:
        """The table as a page; `labels` are the methods' names for people, `source` says how to make it again."""
        note = f"{PAPER_NOTE} " if any(row.paper is not None for row in self.rows) else ""
        parts = [f"# {self.title}", self.about, note + source]
        for garment in _unique(row.garment for row in self.rows):
            parts.append(f"## {garment}")
            rows = [row for row in self.rows if row.garment == garment]
            kinds = _unique(_kind(row.metric) for row in rows)
            parts += [self._grid([row for row in rows if _kind(row.metric) == kind], labels) for kind in kinds]
        if self.missing:
            parts += ["## Not measured", "\n".join(self._reasons(labels))]
        if self.findings:
            parts += ["## What agrees with the paper, and what doesn't", "\n".join(f"- {f}" for f in self.findings)]
        parts += [f"![{caption}]({file})\n\n*{caption}*" for file, caption in self.plots]
        return "\n\n".join(parts) + "\n"

    def _reasons(self, labels: Mapping[str, str]) -> list[str]:
        """What is missing, why, and how to make it; methods that lack the same thing in one line."""
        lacking: dict[tuple[str, str], list[str]] = {}
        for m in self.missing:
            name = labels.get(m.method, m.method).replace("*", "")
            lacking.setdefault((f"{m.garment}, {m.reason}", m.command), []).append(name)
        return [
            f"- {reason}: {'; '.join(names)}." + (f" `{command}`" if command else "")
            for (reason, command), names in lacking.items()
        ]

    def _grid(self, rows: Sequence[Row], labels: Mapping[str, str]) -> str:
        metrics = _unique(row.metric for row in rows)
        in_paper = {metric: any(row.paper is not None for row in rows if row.metric == metric) for metric in metrics}
        head, cells_of = ["method"], {}
        for metric in metrics:
            head += [label_of(metric)] + (["*paper*"] if in_paper[metric] else [])
        found = {(row.method, row.metric): row for row in rows}
        for method in _unique(row.method for row in rows):
            cells = []
            for metric in metrics:
                row = found.get((method, metric))
                cells.append(format_value(metric, row.value if row else None))
                if in_paper[metric]:
                    cells.append(f"*{format_value(metric, row.paper if row else None)}*")
            cells_of[method] = cells
        absent = {m.method for m in self.missing if m.garment in (rows[0].garment, ALL)}
        lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        for method, cells in cells_of.items():
            note = " (not measured)" if method in absent and all(_is_empty(c) for c in cells) else ""
            lines.append("| " + " | ".join([labels.get(method, method) + note, *cells]) + " |")
        return "\n".join(lines)


PAPER_NOTE = (
    "*Figures of the paper, in italics, were measured on other data (TailorNet's, of which the authors selected "
    "samples) and other hardware (a server with V100 GPUs): compare orders and ratios, not absolute figures.*"
)


def _kind(metric: str) -> str:
    """Metrics of one kind stand side by side."""
    if metric.endswith("_trend"):
        return "trend"
    return "" if metric in METRICS else metric.split(" at ")[0]


def label_of(metric: str) -> str:
    """A metric's name for people."""
    return METRICS[metric].label if metric in METRICS else metric


def format_value(metric: str, value: float | None) -> str:
    """A figure for people; a dash where there is none."""
    if value is None:
        return "–"
    signed = "+" if metric.endswith("_trend") else ""
    return f"{value:{signed}.{METRICS[metric].digits if metric in METRICS else 3}f}"


def weighted(values: Iterable[tuple[float | None, int]]) -> float | None:
    """Mean of (value, number of samples), weighted by the numbers ("All Garments" of the paper).

    None if one is missing: a mean over the others would be of other garments than the rows beside it.
    """
    pairs = list(values)
    total = sum(count for _, count in pairs)
    if not total:
        return None
    result = 0.0
    for value, count in pairs:
        if value is None:
            return None
        result += value * count / total
    return result


def _unique(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _is_empty(cell: str) -> bool:
    return cell == "–" or cell.startswith("*")
