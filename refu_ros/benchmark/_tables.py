"""The rows of a benchmark as tables, for a terminal and for a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from refu_ros.benchmark._goals import goals
from refu_ros.benchmark._published import published
from refu_ros.benchmark._rows import BenchmarkResult, Row

STAGES = ("decode", "body", "backbone", "sdf", "refu", "encode")
_MODES = ("hybrid", "accurate")


class Table(NamedTuple):
    """A table and what must be known to read it."""

    name: str
    title: str
    note: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def tables(result: BenchmarkResult) -> list[Table]:
    """All tables there are rows for."""
    made = (aims, frames, stages, sdfs, persons, growth, unchanged, skips, paper, starts)
    return [table for table in (make(result) for make in made) if table.rows]


def aims(result: BenchmarkResult) -> Table:
    """What is to be reached, and what was."""
    rows: list[tuple[str, ...]] = [
        (g.name, f"{g.value:.3g}", f"{'≥' if g.is_least else '≤'} {g.bound:g}", "yes" if g.is_reached else "no")
        for g in goals(result)
    ]
    return Table("goals", "Goals", "", ("goal", "measured", "bound", "reached"), rows)


def frames(result: BenchmarkResult) -> Table:
    """Run time and error of every mode."""
    rows: list[tuple[str, ...]] = []
    for row in result.of("frame"):
        if row.mode != "paper":
            per_thousand = f"{1e3 * row.ms_median / row.vertices:.2f}" if row.vertices else "-"
            errors = (_figure(row, "mpve_mm", 2), _figure(row, "vfcp_percent", 3), _figure(row, "cfmp_percent", 1))
            name = ", ".join(filter(None, (row.garment, row.backbone, row.mode, row.method)))
            rows.append((_where(row, name), *_times(row), per_thousand, *errors))
    header = ("frame, bytes to bytes", *_TIMES, "ms / 1,000 vertices", "MPVE mm", "VFCP %", "CFMP %")
    note = (
        "Errors are those of the frames with ground truth in bags/eval_*: bodies and motion that were not trained on."
    )
    return Table("frame", "Every mode: run time and error", note, header, rows)


def stages(result: BenchmarkResult) -> Table:
    """Where the time goes, and how far from the machine's limits it is."""
    work = {one.stage: one for one in result.work}
    columns = {mode: {row.stage.partition(".")[2]: row for row in _own_stages(result, mode)} for mode in _MODES}
    rows = []
    for stage in STAGES:
        found = [columns[mode].get(stage) for mode in _MODES]
        if stage not in work or result.rates is None or None in found:
            continue
        limit = result.rates.limit_ms(work[stage].n_bytes, work[stage].flops)
        ms = [row.ms_median for row in found if row is not None]
        amounts = (f"{work[stage].n_bytes / 1e6:.3f}", f"{work[stage].flops / 1e6:.2f}", f"{limit:.3f}")
        away = f"{ms[0] / limit:.0f} / {ms[1] / limit:.0f}"
        rows.append((stage, *(f"{value:.2f}" for value in ms), *amounts, away, work[stage].counted))
    header = ("stage", "hybrid ms", "accurate ms", "MB", "MFLOP", "limit ms", "times the limit", "what is counted")
    note = (
        "MB and MFLOP are the least that a stage must move and compute; the limit is the longer of the two at this "
        "machine's measured rates. sdf is taking over the pose, refu the distances and the pushes."
    )
    return Table("stages", "Stages of a frame, and the machine's limits", note, header, rows)


def sdfs(result: BenchmarkResult) -> Table:
    """Every way to the distances."""
    rows = [(_where(row, f"{row.garment}: {row.method}"), *_times(row)) for row in result.of("sdf")]
    note = "Of all vertices of a body's new pose, preparation included. The plain query is the unit of all ratios."
    return Table("sdf", "Every signed distance, of the same vertices", note, ("signed distance", *_TIMES), rows)


def persons(result: BenchmarkResult) -> Table:
    """Growth with persons."""
    rows = [
        (_where(row, f"{row.mode}, {row.persons}"), *_times(row), _figure(row, "ratio_to_one_person", 2))
        for row in result.of("persons")
    ]
    return Table("persons", "Persons", "", ("mode, persons", *_TIMES, "to one person"), rows)


def growth(result: BenchmarkResult) -> Table:
    """Growth with vertices."""
    rows = [
        (f"{row.method}: {row.vertices:,}", *_times(row), f"{1e3 * row.ms_median / row.vertices:.2f}")
        for row in result.of("growth")
        if row.vertices
    ]
    note = "The upper part of the garment, the garment, and the garment with every triangle cut into four, on the skin."
    header = ("signed distance: vertices", *_TIMES, "ms / 1,000 vertices")
    return Table("growth", "Growth with vertices", note, header, rows)


def unchanged(result: BenchmarkResult) -> Table:
    """The same pose again."""
    rows = [
        (
            _where(row, row.mode),
            *_times(row),
            f"{100 * row.figures['share_of_frame']:.1f}",
            f"{100 * row.figures['share_of_pipeline']:.1f}",
        )
        for row in result.of("unchanged")
    ]
    header = ("mode", *_TIMES, "% of a frame", "% of the pipeline")
    note = "Bytes to bytes; the pipeline alone is without decoding and encoding."
    return Table("unchanged", "Unchanged pose", note, header, rows)


def skips(result: BenchmarkResult) -> Table:
    """What each skip is worth."""
    rows: list[tuple[str, ...]] = [
        (
            _where(row, f"{row.mode} without {row.skip}"),
            *_times(row),
            _figure(row, "worth_moving", 2),
            _figure(row, "worth_still", 2),
            result.skips.get(row.skip or "", ""),
        )
        for row in result.of("skip")
    ]
    header = ("pipeline", *_TIMES, "x, moving", "x, still", "what is skipped")
    note = (
        "How many times as long the pipeline takes without it (`--no-skip NAME`), of a body that moves or stands still."
    )
    return Table("skips", "What each skip is worth", note, header, rows)


def paper(result: BenchmarkResult) -> Table:
    """The paper's structure on the same core, and the paper's own figures."""
    rows: list[tuple[str, ...]] = []
    for row in result.of("frame", mode="paper"):
        times = (_figure(row, "times_hybrid", 0), _figure(row, "times_accurate", 0))
        rows.append((_where(row, f"here: {row.backbone}, whole frame"), *_times(row), *times))
        own = (one for one in result.rows if one.stage.startswith("frame.") and one.mode == "paper")
        same = (one for one in own if (one.backbone, one.device) == (row.backbone, row.device))
        rows += [(_where(one, f"- {one.stage.partition('.')[2]}"), *_times(one), "", "") for one in same]
    if rows:
        rows += [(f"published, all garments: {one.mode}, on a V100", f"{one.ms:.1f}", *[""] * 5) for one in published()]
    header = ("the paper's structure", *_TIMES, "x hybrid", "x accurate")
    note = (
        "Untrained networks of the paper's sizes; their time doesn't depend on their weights. Published times are "
        "of a server with NVIDIA V100s: other hardware, not to be compared with this machine's."
    )
    return Table("paper", "The paper's structure on the same core", note, header, rows)


def starts(result: BenchmarkResult) -> Table:
    """Load time and memory."""
    rows = []
    for row in result.of("start"):
        sizes = [value for key, value in row.figures.items() if key.startswith("weights_mb_")]
        figures = [_figure(row, key, digits) for key, digits in _START_FIGURES]
        weights = f"{max(sizes):.1f}" if sizes else "-"
        first = (f"{row.ms_median / 1e3:.2f}", f"{(row.wall_ms_median or 0) / 1e3:.2f}")
        rows.append((f"{row.backbone}, {row.mode}, {row.method}", *first, *figures, weights))
    header = ("process", "first mesh s", "wall s", "imports s", "loading s", "resident MB", "peak MB", "weights MB")
    note = (
        "A process of its own with two garments (T-shirt and shorts), from its start to the first mesh by the "
        "processor's and by the wall's clock, parts of it by the wall's; memory after 30 frames more; the larger "
        "garment's weights."
    )
    return Table("start", "Start and memory", note, header, rows)


_TIMES = ("ms", "quartiles", "wall ms", "ratio")
_START_FIGURES = (("import_s", 2), ("load_s", 2), ("resident_mb", 0), ("peak_mb", 0))


def _own_stages(result: BenchmarkResult, mode: str) -> Iterator[Row]:
    main = result.rows[0].garment
    return (
        row
        for row in result.rows
        if row.stage.startswith("frame.") and (row.mode, row.garment, row.device) == (mode, main, "cpu")
    )


def _times(row: Row) -> tuple[str, str, str, str]:
    spread = "" if row.ms_q1 is None else f"{_ms(row.ms_q1)} … {_ms(row.ms_q3 or 0.0)}"
    wall = "" if row.wall_ms_median is None else _ms(row.wall_ms_median)
    return _ms(row.ms_median), spread, wall, f"{row.ratio:.2f}" if row.ratio < 100 else f"{row.ratio:,.0f}"


def _ms(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:,.0f}"


def _figure(row: Row, name: str, digits: int) -> str:
    value = row.figures.get(name)
    return "-" if value is None else f"{value:,.{digits}f}"


def _where(row: Row, name: str) -> str:
    return name if row.device == "cpu" else f"{name} [{row.device}]"


def markdown(table: Table) -> str:
    """The table as a page has it, without its title."""
    lines = [_line(table.header), _line(["---", *["---:"] * (len(table.header) - 1)]), *map(_line, table.rows)]
    return "\n".join([*([table.note, ""] if table.note else []), *lines])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.strip() for cell in cells)} |"
