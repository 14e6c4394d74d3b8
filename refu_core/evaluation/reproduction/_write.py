"""Tables as files: a page and a JSON file each, and a page that sums all of them up."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from refu_core.errors import RefuError
from refu_core.evaluation.reproduction._build import COMPONENT_LABELS, LABELS, ORDERS
from refu_core.evaluation.reproduction._claims import count_held, is_as_good
from refu_core.evaluation.reproduction._motion import motion_labels
from refu_core.evaluation.reproduction._paper import paper_figure
from refu_core.evaluation.reproduction._sdf import LABELS as SDF_LABELS
from refu_core.evaluation.reproduction._tables import ALL, PAPER_NOTE, Row, Table, format_value, label_of

TABLES: tuple[str, ...] = (
    *("comparison", "ablation", "gcnn", "sequence", "alpha", "sdf", "time", "laplacian", "unseen", "energy", "motion"),
)
"""All tables, in the order of the summary."""


class Goal(NamedTuple):
    """What this project wants a figure to be."""

    table: str
    method: str
    metric: str
    bound: float | None
    """A number that the figure must be at least as good as."""
    than: str | None = None
    """Or a method of the same table whose figure it must be at least as good as."""


GOALS: tuple[Goal, ...] = (
    Goal("comparison", "tailornet", "mpve_mm", 10.0),
    *(
        goal
        for hybrid in ("refu-hybrid", "node-hybrid")
        for goal in (
            Goal("comparison", hybrid, "mpve_mm", None, than="tailornet"),
            Goal("comparison", hybrid, "vfcp_percent", 0.05),
            Goal("comparison", hybrid, "cfmp_percent", 95.0),
            *(
                Goal(table, hybrid, metric, None, than=than)
                for table, metric in (
                    ("comparison", "cfmp_percent"),
                    ("comparison", "mpve_mm"),
                    ("laplacian", "laplacian_mm"),
                )
                for than in ("optimisation-approx", "optimisation-on-hybrid", "optimisation-kept-on-hybrid")
            ),
        )
    ),
    *(Goal("comparison", approx, "cfmp_percent", 90.0) for approx in ("refu-approx", "node-approx")),
    *(
        goal
        for accurate in ("refu-accurate", "node-accurate")
        for goal in (
            Goal("comparison", accurate, "vfcp_percent", 0.0),
            Goal("comparison", accurate, "cfmp_percent", 99.0),
        )
    ),
    Goal("time", "optimisation", "times", 100.0),
)
"""What the tables must show, over all garments."""


def labels_of(table: str) -> Mapping[str, str]:
    """The names for people of a table's methods."""
    extra = {"time": COMPONENT_LABELS, "sdf": SDF_LABELS, "motion": motion_labels()}.get(table, {})
    return {**LABELS, **extra}


def write_table(table: Table, folder: Path, *, command: str, facts: Mapping[str, Any]) -> Path:
    """Writes `<table>.md` and `<table>.json`; returns the page.

    `command` makes the table again, `facts` are what its figures are of (data, samples).

    Raises:
        RefuError: the folder can't be written.
    """
    content = {**table.as_dict(), "about": table.about, "plots": table.plots, "command": command, "facts": {**facts}}
    content["facts"] |= {"machine": _machine(), "versions": {n: version(n) for n in ("refu-ros", "torch", "warp-lang")}}
    page = table.markdown(labels_of(table.name), source=_source(command, facts))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{table.name}.json").write_text(
            json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8"
        )
        path = folder / f"{table.name}.md"
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        msg = f"{folder}: the results can't be written: {error.strerror or error}"
        raise RefuError(msg) from error
    return path


def read_table(folder: Path, name: str) -> Table | None:
    """A table that `write_table` wrote; None where there is none.

    Raises:
        RefuError: a file that isn't such a table.
    """
    path = folder / f"{name}.json"
    if not path.exists():
        return None
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        plots = [(file, caption) for file, caption in data["plots"]]
        table = Table(data["table"], data["title"], data["about"], [Row(**row) for row in data["rows"]], plots=plots)
        table.findings = list(data["findings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        msg = f"{path}: not results of refu evaluate ({error!r}): remove it, or make it again"
        raise RefuError(msg) from error
    return table


def write_summary(folder: Path) -> Path:
    """Writes `README.md` about all tables that are in the folder; returns it. Raises `RefuError` as `read_table`."""
    tables = {name: table for name in TABLES if (table := read_table(folder, name)) is not None}
    parts = [
        "# Results",
        "Every table and figure of the paper, on this project's own simulated data, by `refu evaluate`. The pages and "
        "this summary are written by that command; nothing in them is typed by hand.",
        PAPER_NOTE,
        "## What the tables had to show",
        _goals(tables),
        "## Tables",
        _contents(tables),
    ]
    pictures = [plot for table in tables.values() for plot in table.plots if plot[0].endswith(".png")]
    parts += [f"![{caption}]({file})\n\n*{caption}*" for file, caption in pictures]
    path = folder / "README.md"
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return path


def _goals(tables: Mapping[str, Table]) -> str:
    lines = ["| garments | figure | goal | paper | here | |", "|---|---|---|---|---|---|"]
    for goal in GOALS:
        table = tables.get(goal.table)
        garment = _summed(table)
        value = None if table is None else table.value(garment, goal.method, goal.metric)
        bound = goal.bound
        if goal.than is not None:
            bound = None if table is None else table.value(garment, goal.than, goal.metric)
        name = f"{labels_of(goal.table)[goal.method].replace('*', '')}: {label_of(goal.metric)}"
        wanted = (
            f"as good as {LABELS[goal.than]}, {format_value(goal.metric, bound)}" if goal.than else f"{goal.bound:g}"
        )
        verdict = "not measured"
        if value is not None and bound is not None:
            verdict = "reached" if is_as_good(goal.metric, value, bound) else "**missed**"
        paper = format_value(goal.metric, paper_figure(goal.table, garment, goal.method, goal.metric))
        lines.append(f"| {garment} | {name} | {wanted} | *{paper}* | {format_value(goal.metric, value)} | {verdict} |")
    return "\n".join(lines)


def _summed(table: Table | None) -> str:
    """All garments together, or the only one."""
    garments = list(dict.fromkeys(row.garment for row in table.rows)) if table is not None else []
    return garments[0] if len(garments) == 1 else ALL


def _contents(tables: Mapping[str, Table]) -> str:
    lines = ["| table | | the paper's orders of methods that hold |", "|---|---|---|"]
    for name in TABLES:
        table = tables.get(name)
        if table is None:
            lines.append(f"| {name} | not made yet: `refu evaluate --table {name}` | |")
            continue
        held, tested = count_held(table, ORDERS.get(name, ()))
        lines.append(f"| [{name}]({name}.md) | {table.title} | {f'{held} of {tested}' if tested else ''} |")
    return "\n".join(lines)


def _source(command: str, facts: Mapping[str, Any]) -> str:
    samples: Mapping[str, int] = facts.get("samples", {})
    counted = ", ".join(f"{name} {count}" for name, count in samples.items())
    return f"*Made by `{command}`" + (f" over these numbers of test samples: {counted}" if counted else "") + ".*"


def _machine() -> str:
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
