"""Output of a benchmark: its rows as tables (for a terminal and for a page), JSON and a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from refu_lab.benchmark._measure import BenchmarkResult, BenchmarkRow
from refu_lab.benchmark._sections import MAIN_MODES
from refu_lab.plots import new_axes
from refu_lab.reproduction import published_modes
from refu_lab.tables import TextTable, picture_markdown, write_json, write_page

STAGES = ("decode", "body", "collider", "backbone", "sdf", "refu", "encode")


def tables(result: BenchmarkResult) -> list[TextTable]:
    made = (frames, stages, sdfs, persons, unchanged, paper, starts)
    return [table for table in (make(result) for make in made) if table.rows]


def frames(result: BenchmarkResult) -> TextTable:
    rows: list[tuple[str, ...]] = []
    for row in result.of("frame"):
        if row.mode != "paper":
            per_thousand = f"{1e3 * row.ms_median / row.vertices:.2f}" if row.vertices else "-"
            errors = (_figure(row, "mpve_mm", 2), _figure(row, "vfcp_percent", 3), _figure(row, "cfmp_percent", 1))
            name = ", ".join(filter(None, (row.garment, row.backbone, row.mode, row.method)))
            rows.append(_line(row, name, per_thousand, *errors))
    header = ("frame, bytes to bytes", *_TIMES, "ms / 1,000 vertices", "MPVE mm", "VFCP %", "CFMP %")
    note = (
        "Errors are those of the frames with ground truth in bags/eval_*: bodies and motion that were not trained on."
    )
    return TextTable("Every mode: run time and error", header, rows, note)


def stages(result: BenchmarkResult) -> TextTable:
    main = result.rows[0].garment
    found = {
        (row.stage, row.mode): f"{row.ms_median:.2f}"
        for row in result.rows
        if row.stage.startswith("frame.") and (row.garment, row.device) == (main, "cpu")
    }
    rows = [(stage, *(found.get((f"frame.{stage}", mode), "-") for mode in MAIN_MODES)) for stage in STAGES]
    note = f"Of a {main}. sdf is taking over the pose, refu the distances and the pushes."
    return TextTable("Stages of a frame", ("stage", *(f"{mode} ms" for mode in MAIN_MODES)), rows, note)


def sdfs(result: BenchmarkResult) -> TextTable:
    rows = [_line(row, f"{row.garment}: {row.method}") for row in result.of("sdf")]
    note = "Of all vertices of a body's new pose, preparation included. The plain query is the unit of all ratios."
    return TextTable("Every signed distance, of the same vertices", ("signed distance", *_TIMES), rows, note)


def persons(result: BenchmarkResult) -> TextTable:
    ratio = "ratio_to_one_person"
    rows = [_line(row, f"{row.mode}, {row.persons}", _figure(row, ratio, 2)) for row in result.of("persons")]
    return TextTable("Persons", ("mode, persons", *_TIMES, "to one person"), rows)


def unchanged(result: BenchmarkResult) -> TextTable:
    keys = ("share_of_frame", "share_of_pipeline")
    shares = [(row, [f"{100 * row.figures[key]:.1f}" for key in keys]) for row in result.of("unchanged")]
    rows = [_line(row, row.mode, *of_row) for row, of_row in shares]
    header = ("mode", *_TIMES, "% of a frame", "% of the pipeline")
    note = "Bytes to bytes; the pipeline alone is without decoding and encoding."
    return TextTable("Unchanged pose", header, rows, note)


def paper(result: BenchmarkResult) -> TextTable:
    rows: list[tuple[str, ...]] = []
    for row in result.of("frame", mode="paper"):
        times = (_figure(row, "times_hybrid", 0), _figure(row, "times_accurate", 0))
        rows.append(_line(row, f"here: {row.backbone}, whole frame", *times))
        own = (one for one in result.rows if one.stage.startswith("frame.") and one.mode == "paper")
        same = (one for one in own if (one.backbone, one.device) == (row.backbone, row.device))
        rows += [_line(one, f"- {one.stage.partition('.')[2]}", "", "") for one in same]
    if rows:
        for mode, one in published_modes().items():
            rows.append((f"published, all garments: {mode}, on a V100", f"{one['ms']:.1f}", *[""] * 5))
    header = ("the paper's structure", *_TIMES, "x hybrid", "x accurate")
    note = (
        "Untrained networks of the paper's sizes; their time doesn't depend on their weights. Published times are "
        "of a server with NVIDIA V100s: other hardware, not to be compared with this machine's."
    )
    return TextTable("The paper's structure on the same core", header, rows, note)


def starts(result: BenchmarkResult) -> TextTable:
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
    return TextTable("Start and memory", header, rows, note)


_TIMES = ("ms", "quartiles", "wall ms", "ratio")
_START_FIGURES = (("import_s", 2), ("load_s", 2), ("resident_mb", 0), ("peak_mb", 0))


def _line(row: BenchmarkRow, name: str, *figures: str) -> tuple[str, ...]:
    """A row's name, times (`_TIMES`) and figures."""
    place = name if row.device == "cpu" else f"{name} [{row.device}]"
    spread = "" if row.ms_q1 is None else f"{_ms(row.ms_q1)} … {_ms(row.ms_q3 or 0.0)}"
    wall = "" if row.wall_ms_median is None else _ms(row.wall_ms_median)
    return place, _ms(row.ms_median), spread, wall, _ms(row.ratio), *figures


def _ms(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:,.0f}"


def _figure(row: BenchmarkRow, name: str, digits: int) -> str:
    value = row.figures.get(name)
    return "-" if value is None else f"{value:,.{digits}f}"


PAGE, DATA = "performance.md", "performance.json"


def write_results(result: BenchmarkResult, folder: Path) -> list[Path]:
    """Writes `performance.md`, `performance.json` and, if errors were measured, the plot; returns their paths.

    Raises `RefuError`: the folder can't be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plot = plot_time_against_error(result, folder)
    parts = ["# Run time", f"Measured by `{result.command}`. {conditions(result)}"]
    if plot is not None:
        parts.append(picture_markdown(PLOT, "Milliseconds a frame against error, every mode"))
    parts += [f"## {table.title}\n\n{table.markdown()}" for table in tables(result)]
    if result.missing:
        parts += ["## Not measured", "\n".join(f"- {name}: `{need}`" for name, need in result.missing.items())]
    write_page(folder / PAGE, parts)
    write_json(folder / DATA, result.as_dict())
    return [folder / PAGE, folder / DATA, *([plot] if plot is not None else [])]


def conditions(result: BenchmarkResult) -> str:
    """The machine, its load, and how times were measured."""
    machine = result.machine
    text = f"{machine['processor']}, {machine['cores']} cores, one thread, pinned to core {machine['core']}; "
    text += f"torch {machine['torch']}"
    if "gpu" in machine:
        text += f"; {machine['gpu']}"
    text += f"; load average {machine['load_before']:.1f} before, {machine['load_after']:.1f} after"
    return (
        f"{text}. Times are the processor's, medians and quartiles of contenders taken in turn; ratios are to "
        "refitting a BVH and asking it for every vertex (the plain query), taken in turn with them."
    )


def benchmark_text(result: BenchmarkResult) -> str:
    parts = [conditions(result)]
    parts += [table.text() for table in tables(result)]
    parts += [f"not measured: {name}: {need}" for name, need in result.missing.items()]
    return "\n\n".join(parts)


PLOT = "time-against-error.png"
_METRICS = (
    ("mpve_mm", "mean error MPVE [mm]"),
    ("vfcp_percent", "vertices inside the body VFCP [%]"),
    ("cfmp_percent", "collision-free frames CFMP [%]"),
)
_COLOURS = {"none": "#7a7a7a", "approx": "#e0a030", "hybrid": "#4a9a6a", "accurate": "#3b6ea5"}
_SIZES = {"none": 7, "approx": 12, "hybrid": 8.5, "accurate": 5}
"""Marker sizes. Smaller ones are drawn later, so that points at nearly the same place can be told apart."""
_MARKERS = {"tailornet": "o", "skinned": "s"}


def plot_time_against_error(result: BenchmarkResult, folder: Path) -> Path | None:
    """Writes `time-against-error.png` for the main garment; returns None if no errors were measured."""
    shown = [row for row in result.of("frame") if row.mode != "paper" and row.garment == result.rows[0].garment]
    shown = [row for row in shown if all(name in row.figures for name, _ in _METRICS)]
    if not shown:
        return None
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    figure, axes = new_axes(1, len(_METRICS), size=(12.6, 4.6))
    for ax, (name, label) in zip(axes, _METRICS, strict=True):
        for row in shown:
            low, high = row.ms_q1 or row.ms_median, row.ms_q3 or row.ms_median
            spread = [[row.ms_median - low], [high - row.ms_median]]
            ax.errorbar(row.ms_median, row.figures[name], xerr=spread, **_style(row))
        for mode, one in published_modes().items():
            label_of = f"paper, {mode}, on a V100*"
            ax.plot(one["ms"], one[name], "D", mfc="none", mec=_COLOURS[mode], ms=6, label=label_of)
        for time, text in _marks(result):
            ax.axvline(time, color="#b5493f", lw=1, ls=":")
            place = ax.get_xaxis_transform()
            ax.text(time, 0.5, text, transform=place, rotation=90, va="center", ha="right", fontsize=7)
        ax.set(xscale="log", xlabel="a frame [ms]", ylabel=label)
        if name == "vfcp_percent":
            ax.set_yscale("symlog", linthresh=1e-3)
            ax.set_ylim(bottom=-2e-4, top=2 * ax.get_ylim()[1])
        ax.xaxis.set_major_locator(LogLocator())
        ax.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        ax.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    garment, core = shown[0].garment, result.machine.get("processor", "")
    figure.suptitle(f"{garment}, bytes to bytes on one core ({core}); * other hardware, garments and data", fontsize=9)
    figure.savefig(folder / PLOT, dpi=130, metadata={"Software": None})
    return folder / PLOT


def _style(row: BenchmarkRow) -> dict[str, Any]:
    where = "" if row.device == "cpu" else f", {row.device}"
    return {
        "fmt": _MARKERS.get(row.backbone or "", "^"),
        "color": _COLOURS.get(row.mode, "#7a5fa0"),
        "fillstyle": "full" if row.device == "cpu" else "left",
        "label": f"{row.backbone}, {row.mode}{where}",
        "ms": _SIZES.get(row.mode, 6),
        "lw": 1,
    }


def _marks(result: BenchmarkResult) -> list[tuple[float, str]]:
    """Times without an error of their own: that of the plain query, and that of the paper's structure, untrained."""
    main = result.rows[0].garment
    marks = [(row.ms_median, "plain query alone") for row in result.of("sdf", mode="plain", garment=main, device="cpu")]
    if not result.quick:
        same = result.of("frame", mode="paper", device="cpu")
        marks += [(row.ms_median, "the paper's structure on this core") for row in same]
    return marks
