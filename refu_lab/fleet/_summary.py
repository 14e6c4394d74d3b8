"""Summary of a fleet's recordings: a table, JSON, and a page with links to each one's report."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import dataclass, field
from textwrap import fill
from typing import Any
from urllib.parse import quote

from refu_core.errors import printable
from refu_lab.tables import REPLAY_TITLE, format_table, html_page, html_table, meanings, replay_columns

_HEADER = ("recording", "frames", "skipped", "p50 ms", "p95 ms", "VFCP %", "free %", "depth mm", "")
_FIGURES = (("vfcp_percent", 3), ("free_percent", 1), ("max_depth_mm", 1))
_WORST_HEADER = ("recording", "frame", "time s", "inside", "pairs", "depth mm")
_SHOWN = 10
"""How many worst frames over all recordings, and how many warnings, are shown."""


@dataclass(eq=False)
class FleetResult:
    """The recordings' records, in the order of the command."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    """Each has `name` and `input`, and either the values of `ReplayResult.as_dict` or `error`."""
    n_left: int = 0
    """Number of recordings that weren't reached."""
    interrupted: bool = False
    is_kept: bool = False
    """Whether finished results are kept in a folder, so that the same command can resume from there."""

    @property
    def failed(self) -> list[dict[str, Any]]:
        return [row for row in self.rows if "error" in row]

    def worst(self) -> list[dict[str, Any]]:
        """The worst frames of all recordings, the worst first."""
        found = [{"name": row["name"], **frame} for row in self.rows for frame in row.get("worst", ())]
        return sorted(found, key=lambda frame: list(frame["badness"]), reverse=True)[:_SHOWN]

    def warnings(self) -> list[str]:
        """Warnings and the recordings they are about, the most frequent first."""
        of: dict[str, list[str]] = {}
        for row in self.rows:
            for warning in row.get("warnings", ()):
                of.setdefault(warning, []).append(row["name"])
        lines = []
        for warning, (first, *others) in sorted(of.items(), key=lambda item: -len(item[1])):
            beside = f" and {len(others)} other{'s' * (len(others) > 1)}" if others else ""
            lines.append(f"{warning} ({first}{beside})")
        more = len(lines) - _SHOWN
        return lines if more <= 0 else [*lines[:_SHOWN], f"{more} other warnings: --json names all"]

    def garments(self) -> dict[str, dict[str, Any]]:
        """Figures of each garment over all frames of all recordings, in the form of a replay's JSON."""
        parts: dict[str, list[Mapping[str, Any]]] = {}
        for name, figures in (one for row in self.rows for one in row.get("garments", {}).items()):
            parts.setdefault(name, []).append(figures)
        return {name: _merged(of_name) for name, of_name in parts.items()}

    def as_dict(self) -> dict[str, Any]:
        return {
            "recordings": len(self.rows) + self.n_left,
            "failed": len(self.failed),
            "left": self.n_left,
            "interrupted": self.interrupted,
            "frames": sum(row.get("frames", 0) for row in self.rows),
            "garments": self.garments(),
            "worst": self.worst(),
            "rows": self.rows,
        }

    def page(self) -> str:
        """The page about all recordings, `index.html` in the folder of the reports."""
        from refu_lab.report import STYLE

        header, rows = replay_columns(self.garments())
        garments = html_table(header, [[html.escape(cell) for cell in row] for row in rows])
        recordings = [[self._link(row), *(html.escape(cell) for cell in _cells(row)[1:])] for row in self.rows]
        worst = [[self._link(one), *(html.escape(cell) for cell in _worst_cells(one)[1:])] for one in self.worst()]
        frames = sum(row.get("frames", 0) for row in self.rows)
        left = f"; {self.n_left} not come to" if self.n_left else ""
        warned = "".join(f'<p class="warn">{html.escape(warning)}</p>' for warning in self.warnings())
        body = f"""<p class="note">{frames} frames; {len(self.failed)} recordings couldn't be replayed{left}.</p>
{warned}
<h2>Garments, over all frames</h2>{garments}<p class="note">{meanings(header)}.</p>
<h2>Recordings</h2>{html_table(_HEADER, recordings)}
<p class="note">Free: frames in which no garment has a vertex inside the body or a triangle that cuts it.</p>
<h2>Worst frames of all</h2>{html_table(_WORST_HEADER, worst)}"""
        return html_page(f"{REPLAY_TITLE}{len(self.rows)} recordings", body, style=STYLE)

    def _link(self, row: Mapping[str, Any]) -> str:
        text, place = html.escape(row["name"]), quote(row["name"], errors="surrogateescape")  # a name may be no text
        return text if "error" in row else f'<a href="{place}/index.html">{text}</a>'


def fleet_table(result: FleetResult) -> str:
    lines = [format_table(_HEADER, [_cells(row) for row in result.rows])] if result.rows else []
    if garments := result.garments():
        header, rows = replay_columns(garments)
        said = f"{meanings(header)}; free: frames in which no garment collides"
        lines += ["", format_table(header, rows), "", fill(said, 120)]
    if worst := [_worst_cells(frame) for frame in result.worst() if frame["n_inside"] or frame["n_pairs"]]:
        lines += ["", "worst frames", format_table(_WORST_HEADER, worst)]
    done, kept = len(result.rows) - len(result.failed), sum(bool(row.get("kept")) for row in result.rows)
    lines += ["", f"{done} of {len(result.rows) + result.n_left} recordings replayed, {kept} of them before"]
    lines += [f"{printable(row['name'])}: {row['error']}" for row in result.failed]
    lines += [printable(f"warning: {warning}") for warning in result.warnings()]
    if result.interrupted:
        goes_on = "give the same command again to go on" if result.is_kept else "nothing is kept without --output"
        lines.append(f"interrupted: {goes_on}")
    return "\n".join(lines)


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    if "error" in row:
        return (printable(row["name"]), *["-"] * (len(_HEADER) - 2), "failed")
    latency = [f"{row['latency_ms'][p]:.1f}" for p in ("p50", "p95")]
    figures = ["-" if row.get(name) is None else f"{row[name]:.{digits}f}" for name, digits in _FIGURES]
    counts = (str(row["frames"]), str(sum(row["skipped"].values())))
    return (printable(row["name"]), *counts, *latency, *figures, "before" if row.get("kept") else "done")


def _worst_cells(frame: Mapping[str, Any]) -> tuple[str, ...]:
    counts = (str(frame["frame"]), f"{frame['time_s']:.2f}", str(frame["n_inside"]), str(frame["n_pairs"]))
    return (printable(frame["name"]), *counts, f"{frame['max_depth_mm']:.1f}")


def _merged(parts: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures over all frames: means weighted by frames; of depths and latency percentiles, the largest."""
    merged: dict[str, Any] = {"n_frames": sum(part["n_frames"] for part in parts)}
    for name in parts[0]:
        if name == "latency_ms":
            merged[name] = {p: max(part[name][p] for part in parts) for p in parts[0][name]}
        elif name == "before":
            merged[name] = _merged([part[name] for part in parts])
        elif name != "n_frames":
            values = [(part[name], part["n_frames"]) for part in parts if part[name] is not None and part["n_frames"]]
            total = sum(n for _, n in values)
            if not values:
                merged[name] = None
            elif name == "max_depth_mm":
                merged[name] = max(value for value, _ in values)
            else:
                merged[name] = sum(value * n for value, n in values) / total
    return merged
