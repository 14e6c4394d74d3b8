"""Tables of the reproduction: our figures, each beside the paper's, as pages and JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

from refu_core._files import read_json
from refu_core._versions import versions
from refu_core.errors import RefuError
from refu_lab.reproduction._methods import METHODS
from refu_lab.tables import RESULT_TABLES, TextTable, picture_markdown, write_json, write_page

ALL = "all"
"""Stands for all garments, weighted by their numbers of test samples."""
_SUMMARY = "The paper's tables and figures, on simulated data of this project; `refu evaluate` writes these pages."
_PAPER_NOTE = (
    "*Figures of the paper, in italics, were measured on other data (TailorNet's, of which the authors selected "
    "samples) and other hardware (a server with V100 GPUs): compare orders and ratios, not absolute figures.*"
)


def _beside(name: str) -> str:
    """The text of a file in this folder."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


MAIN_METRICS = ("mpve_mm", "vfcp_percent", "cfmp_percent")
_TEXTS = [part.partition("\n") for part in _beside("tables.md").removeprefix("# ").split("\n# ")]
_ABOUT = {head.partition(": ")[0]: (head.partition(": ")[2], " ".join(text.split())) for head, _, text in _TEXTS}
"""Title of each table, and what was measured and how, as Markdown."""
_PRINTED = json.loads(_beside("paper.json"))
"""By table: the methods, and their values by garment (empty if the supplement doesn't name it) and metric."""

PAPER: Mapping[tuple[str, str, str, str], float] = {
    (table, garment, method, metric): value
    for table, printed in _PRINTED.items()
    for garment, metrics in printed["garments"].items()
    for metric, values in metrics.items()
    for method, value in zip(printed["methods"], values, strict=True)
}
"""The paper's figures by (table, garment, method, metric)."""


def paper_figure(table: str, garment: str, method: str, metric: str) -> float | None:
    """The figure that the paper prints; None if it prints none.

    If it doesn't name the garment, its figure stands beside each of ours. Its changes against the baseline ("Trend")
    are recomputed from its own figures, as the printed ones of VFCP don't follow from them (.60 to .24 is -60 %, not
    -97.5 %).
    """
    if metric.endswith("_trend"):
        value, base = (paper_figure(table, garment, m, metric[: -len("_trend")]) for m in (method, "tailornet"))
        return None if value is None or not base else 100.0 * (value - base) / base
    return PAPER.get((table, garment, method, metric), PAPER.get((table, "", method, metric)))


def published_modes() -> dict[str, dict[str, float]]:
    """The paper's figures of each mode, all garments together: `ms` a frame on a V100, and the errors."""
    found = {}
    for mode, sdf in (("approx", "sdf-approx"), ("hybrid", "sdf-approx"), ("accurate", "sdf-accurate")):
        ms = sum(PAPER["time", "all", component, "ms"] for component in ("backbone", sdf, "refu"))
        found[mode] = {"ms": ms} | {m: PAPER["comparison", "all", f"refu-{mode}", m] for m in MAIN_METRICS}
    return found


class Metric(NamedTuple):
    label: str
    digits: int
    higher_is_better: bool = False
    kind: str = ""
    """Metrics of one kind share a table."""


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
    "n_samples": Metric("samples", 0),
    "network_mpve_mm": Metric("backbone alone, MPVE [mm]", 2),
    "share_of_mean": Metric("MPVE by that of all", 2),
    "skin_cfmp_percent": Metric("CFMP on the skin [%]", 2, higher_is_better=True),
    "collider_cut_percent": Metric("collider cut [% of frames]", 2),
    "jump_20_percent": Metric("jumps > 20 mm [% of pairs]", 2, kind="cloth"),
    "jump_40_percent": Metric("> 40 mm [%]", 2, kind="cloth"),
    "jump_max_mm": Metric("largest [mm]", 1, kind="cloth"),
    "leap_20_percent": Metric("leaps > 20 mm [%]", 2, kind="cloth"),
    "stretched_percent": Metric("edges > 2 x rest [%]", 3, kind="cloth"),
    "self_crossings": Metric("crossings a frame", 1, kind="cloth"),
    "layers_cut_percent": Metric("layers cut [% of frames]", 2, kind="cloth"),
    "shift_mean_mm": Metric("mean [mm]", 3),
    "shift_p99_mm": Metric("99th percentile [mm]", 2),
    "shift_max_mm": Metric("largest [mm]", 1),
    "shift_moved_percent": Metric("moved by > 0.1 mm [%]", 2),
    "mpve_mm_trend": Metric("MPVE, change [%]", 1, kind="trend"),
    "vfcp_percent_trend": Metric("VFCP, change [%]", 1, kind="trend"),
    "cfmp_percent_trend": Metric("CFMP, change [%]", 1, higher_is_better=True, kind="trend"),
}
"""The metrics by their names in JSON, without those that a table makes up for its groups (`error [mm] at 1 to 1.5`)."""


class ResultRow(NamedTuple):
    """One of our figures and the paper's; its fields are the keys of a row in JSON."""

    table: str
    garment: str
    method: str
    metric: str
    value: float | None
    """None if nothing was measured: networks not trained, or no samples for this metric."""
    paper: float | None


@dataclass(frozen=True)
class Missing:
    """Why a method has no figures for a garment, and how to get them."""

    garment: str
    method: str
    reason: str
    command: str


@dataclass(eq=False)
class ResultTable:
    """One table: its figures, what is missing from it, and what it is about."""

    name: str
    title: str
    about: str
    """What was measured and how, as Markdown."""
    rows: list[ResultRow] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)
    plots: list[tuple[str, str]] = field(default_factory=list)
    """(file name, caption)."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Readable names of rows that aren't methods."""

    @classmethod
    def of(cls, name: str, *, labels: Mapping[str, str] | None = None, **numbers: float) -> ResultTable:
        """An empty table with its texts of `tables.md`; `numbers` are those that they name."""
        title, about = _ABOUT[name]
        return cls(name, title, about.format(**numbers), labels=labels or {})

    def add(self, garment: str, method: str, values: Mapping[str, float | None]) -> None:
        """Adds rows: a method's values by metric, each beside the paper's."""
        for metric, value in values.items():
            paper = paper_figure(self.name, garment, method, metric)
            self.rows.append(ResultRow(self.name, garment, method, metric, value, paper))

    def value(self, garment: str, method: str, metric: str) -> float | None:
        return next((row.value for row in self.rows if row[1:4] == (garment, method, metric)), None)

    def label(self, method: str) -> str:
        return self.labels.get(method) or (METHODS[method].label if method in METHODS else method)

    def markdown(self, *, source: str) -> list[str]:
        """The parts of a page; `source` says how to make the table again."""
        has_paper = any(row.paper is not None for row in self.rows)
        parts = [f"# {self.title}", self.about, f"{_PAPER_NOTE} {source}" if has_paper else source]
        for garment in _unique(row.garment for row in self.rows):
            parts += [f"## {garment}", *(grid.markdown() for grid in self.of_garment(garment))]
        if self.missing:
            parts += ["## Not measured", "\n".join(self._reasons())]
        return parts + [picture_markdown(*plot) for plot in self.plots]

    def in_short(self) -> list[TextTable]:
        """The figures over all garments or clips together; those of each if there are none over all."""
        garments = _unique(row.garment for row in self.rows)
        summed = [garment for garment in garments if garment == ALL or garment.endswith("all clips")]
        return [grid for garment in summed or garments for grid in self.of_garment(garment)]

    def of_garment(self, garment: str) -> list[TextTable]:
        """A garment's figures: a table for each kind of metric."""
        rows = [row for row in self.rows if row.garment == garment]
        kinds = _unique(_metric(row.metric).kind for row in rows)
        return [self._grid(garment, [row for row in rows if _metric(row.metric).kind == kind]) for kind in kinds]

    def _grid(self, garment: str, rows: Sequence[ResultRow]) -> TextTable:
        """A table of methods by metrics, with a column of the paper's beside each metric that it has any of."""
        metrics = _unique(row.metric for row in rows)
        in_paper = {row.metric for row in rows if row.paper is not None}
        found = {(row.method, row.metric): row for row in rows}
        absent = {m.method for m in self.missing if m.garment in (garment, ALL)}
        header = ["method"]
        for metric in metrics:
            header += [_metric(metric).label, *(["*paper*"] if metric in in_paper else [])]
        lines = []
        for method in _unique(row.method for row in rows):
            of_method = [found.get((method, metric)) for metric in metrics]
            is_empty = all(row is None or row.value is None for row in of_method)
            cells = [self.label(method) + (" (not measured)" if method in absent and is_empty else "")]
            for metric, row in zip(metrics, of_method, strict=True):
                cells.append(_text(metric, row.value if row else None))
                cells += [f"*{_text(metric, row.paper if row else None)}*"] if metric in in_paper else []
            lines.append(cells)
        return TextTable(f"{self.title}, {garment}", header, lines)

    def _reasons(self) -> list[str]:
        """Lines on what is missing, why, and how to make it; methods that lack the same thing share a line."""
        lacking: dict[tuple[str, str], list[str]] = {}
        for m in self.missing:
            lacking.setdefault((f"{m.garment}, {m.reason}", m.command), []).append(self.label(m.method))
        return [
            f"- {reason}: {'; '.join(names)}." + (f" `{command}`" if command else "")
            for (reason, command), names in lacking.items()
        ]

    def write(self, folder: Path, *, command: str, n_samples: Mapping[str, int]) -> Path:
        """Writes `<name>.md` and `<name>.json`; returns the page.

        `command` makes the table again; `n_samples` are the numbers of test samples that it is based on. Raises
        `RefuError`: the folder can't be written.
        """
        counted = ", ".join(f"{name} {count}" for name, count in n_samples.items())
        of_samples = f" over these numbers of test samples: {counted}" if counted else ""
        machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
        content = {
            "table": self.name,
            "title": self.title,
            "rows": [row._asdict() for row in self.rows],
            "missing": [asdict(missing) for missing in self.missing],
            "about": self.about,
            "plots": self.plots,
            "command": command,
            "facts": {"samples": dict(n_samples), "machine": machine, "versions": versions("torch", "warp-lang")},
        }
        path = folder / f"{self.name}.md"
        write_page(path, self.markdown(source=f"*Made by `{command}`{of_samples}.*"))
        write_json(path.with_suffix(".json"), content)
        return path


def read_table(folder: Path, name: str) -> ResultTable | None:
    """Reads a table that was written; None if there is none. Raises `RefuError`: a file that isn't such a table."""
    path = folder / f"{name}.json"
    if not path.exists():
        return None
    try:
        data = read_json(path, error=RefuError, wanted="results of refu evaluate")
        rows = [ResultRow(**row) for row in data["rows"]]
        plots = [(file, caption) for file, caption in data["plots"]]
        missing = [Missing(**one) for one in data["missing"]]
        return ResultTable(data["table"], data["title"], data["about"], rows, missing, plots)
    except (ValueError, KeyError, TypeError) as error:
        raise RefuError(f"{path}: not results of refu evaluate ({error!r}): remove it, or make it again") from error


def is_summary(page: Path) -> bool:
    """Whether a page was written by `write_summary`. Raises `RefuError` if it can't be read."""
    try:
        return _SUMMARY in page.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise RefuError(f"{page}: can't be read: {error.strerror}") from error


def write_summary(folder: Path) -> Path:
    """Writes `README.md`: links to all tables in the folder, the main one's figures, and the pictures.

    A text about the folder as a whole is taken from its `about.txt`. Raises `RefuError`: a file that isn't a table, or
    a folder that can't be written.
    """
    tables = {name: read_table(folder, name) for name in RESULT_TABLES}
    links = [
        f"- not made yet: `refu evaluate --table {name}`" if table is None else f"- [{table.title}]({name}.md)"
        for name, table in tables.items()
    ]
    others = {
        "performance.md": "Run time: `refu benchmark`",
        "collider.md": "The collider: what each number does",
        "contact.md": "Collision handling: what each number does",
        "keypoints.md": "Keypoints: what each number does",
    }
    links += [f"- [{title}]({file})" for file, title in others.items() if (folder / file).exists()]
    about = folder / "about.txt"
    parts = ["# Results", _SUMMARY, *([about.read_text(encoding="utf-8").strip()] if about.exists() else [])]
    parts += ["\n".join(links), _PAPER_NOTE]
    if (main := tables["comparison"]) is not None:
        grids = main.in_short()
        parts += [f"## {grids[0].title}", *(grid.markdown() for grid in grids)]
    pictures = [plot for table in tables.values() if table is not None for plot in table.plots]
    parts += [picture_markdown(*plot) for plot in pictures if plot[0].endswith(".png")]
    write_page(folder / "README.md", parts)
    return folder / "README.md"


def _metric(name: str) -> Metric:
    """How a metric is written; those that a table makes up for its groups have one table a kind of group."""
    return METRICS.get(name) or Metric(name, 3, kind=name.split(" at ")[0])


def _text(metric: str, value: float | None) -> str:
    signed = "+" if metric.endswith("_trend") else ""
    return "–" if value is None else f"{value:{signed}.{_metric(metric).digits}f}"


def weighted(values: Iterable[tuple[float | None, int]]) -> float | None:
    """Mean of (value, number of samples) pairs, weighted by the numbers ("All Garments" in the paper).

    None if a value is missing: a mean over the others would be over other garments than the rows beside it.
    """
    pairs = list(values)
    total = sum(count for _, count in pairs)
    known = [(value, count) for value, count in pairs if value is not None]
    return sum(value * count / total for value, count in known) if total and len(known) == len(pairs) else None


def _unique(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))
