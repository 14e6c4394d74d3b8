"""Results as tables of text, for a terminal and for a page, and as JSON."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from refu_core._files import write_file
from refu_core.errors import RefuError, printable

if TYPE_CHECKING:
    from refu_lab.replay import ReplayResult

RESULT_TABLES = (
    *("parts", "comparison", "ablation", "gcnn", "sequence", "alpha", "sdf", "time", "laplacian", "unseen", "energy"),
    *("postures", "motion"),
)
"""The tables of `refu evaluate`, in the order of its summary; here, so that the command line needs no torch."""


@dataclass(frozen=True)
class TextTable:
    """A table whose cells are text already."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    """What a reader has to know."""

    def text(self) -> str:
        return f"{self.title}\n{format_table(self.header, self.rows)}"

    def markdown(self) -> str:
        """The table for a page, without its title."""
        rule = ["---", *["---:"] * (len(self.header) - 1)]
        lines = [f"| {' | '.join(row)} |" for row in (self.header, rule, *self.rows)]
        return "\n".join([*([self.note, ""] if self.note else []), *lines])


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A plain table: the first column left-aligned, the others right-aligned."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = []
    for row in (header, tuple("-" * width for width in widths), *rows):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table whose cells are HTML already."""
    lines = [("th", header), *(("td", row) for row in rows)]
    body = "".join(f"<tr>{''.join(f'<{tag}>{cell}</{tag}>' for cell in cells)}</tr>" for tag, cells in lines)
    return f"<table>{body}</table>"


REPLAY_TITLE = "Replay of "
"""Start of the titles of replay pages, by which they are recognised."""


def html_page(title: str, body: str, *, style: str) -> str:
    """A page that refers to nothing outside its folder; `title` is text, the rest HTML and CSS."""
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    name = html.escape(title)
    return f"""<!doctype html>
<html lang="en"><head>{head}
<title>{name}</title><style>{style}</style></head><body>
<h1>{name}</h1>
{body}
</body></html>
"""


def picture_markdown(file: str, caption: str) -> str:
    return f"![{caption}]({file})\n\n*{caption}*"


def write_page(path: Path, parts: Sequence[str]) -> None:
    """Writes a page from its parts, in full or not at all. Raises `RefuError` if it can't be written."""
    write_file(path, ("\n\n".join(parts) + "\n").encode(), error=RefuError)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes plain values, in full or not at all. Raises `RefuError` if the file can't be written."""
    write_file(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode(), error=RefuError)


def replay_table(result: ReplayResult) -> str:
    header, rows = replay_columns(result.as_dict()["garments"])
    table = ["", format_table(header, rows), "", fill(meanings(header), 120), ""] if rows else []
    lines = [f"{result.options.input}: {result.source}", *table]
    lines += [] if rows else [f"{len(result.latencies_ms)} frames, not evaluated"]
    whole = result.latency_ms()
    lines.append(
        f"frame, bytes to bytes: p50 {whole['p50']:.1f} ms, p95 {whole['p95']:.1f} ms, p99 {whole['p99']:.1f} ms"
        f" ({result.options.backbone} backbone, {result.options.sdf} signed distance, {result.options.device})"
    )
    if result.options.collider:
        moved = "skin moved to be free of itself: {mean:.2f} mm on average, {largest:.1f} mm at most"
        lines.append(moved.format(**result.skin_shift_mm()))
    lines += [f"skipped {count} x {reason}" for reason, count in result.skips.most_common()]
    lines += [printable(f"warning: {text}") for text in result.warnings]
    if result.interrupted:
        lines.append("interrupted: the figures are those of the frames so far")
    if result.options.output is not None:
        lines.append(f"wrote {result.options.output}")
    return "\n".join(lines)


_HEADER = (
    *("garment", "frames", "p50 ms", "p95 ms", "p99 ms", "VFCP %", "CFMP %", "depth mm", "MPVE mm"),
    *("folds", "CFMP % on the skin"),
)
_MEANINGS = {
    "p50 ms": "p50: median time of a frame",
    "VFCP %": "VFCP: vertices inside the body, before → after collision handling",
    "CFMP %": "CFMP: frames free of collisions",
    "depth mm": "depth: of the deepest vertex",
    "MPVE mm": "MPVE: mean distance to the true garment",
    "folds": "folds: energy over the true garment's, from the finest to the widest",
    "CFMP % on the skin": "on the skin: against the body as posed, with its overlaps",
}
_FIGURES = (("vfcp_percent", 3), ("cfmp_percent", 1), ("max_depth_mm", 1), ("mpve_mm", 2))
_FOLDS = ("folds_1", "folds_4", "folds_16", "folds_64")


def meanings(header: Sequence[str]) -> str:
    return "; ".join(text for column, text in _MEANINGS.items() if column in header)


def replay_columns(garments: Mapping[str, Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """The header, and a row for each garment of a replay's JSON, without the columns that no row has a value for."""
    rows = _rows(garments)
    shown = [i for i, column in enumerate(zip(*rows, strict=True)) if set(column) != {"-"}]
    return [_HEADER[i] for i in shown], [[row[i] for i in shown] for row in rows]


def _rows(garments: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    rows = []
    for name, after in garments.items():
        row = [name, str(after["n_frames"]), *(f"{after['latency_ms'][p]:.2f}" for p in ("p50", "p95", "p99"))]
        for key, digits in _FIGURES:
            a, b = after["before"][key], after[key]
            row.append("-" if a is None or b is None else f"{a:.{digits}f} → {b:.{digits}f}")
        folds, on_skin = [after[key] for key in _FOLDS], after["skin_cfmp_percent"]
        row.append("-" if None in folds else " ".join(f"{one:.2f}" for one in folds))
        rows.append([*row, "-" if on_skin is None else f"{on_skin:.1f}"])
    return rows
