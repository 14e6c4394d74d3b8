"""What a benchmark leaves behind: a page, JSON, a plot, and the text for the terminal."""

from __future__ import annotations

from pathlib import Path

from refu_lab.benchmark._plot import PLOT, plot_time_against_error
from refu_lab.benchmark._rows import BenchmarkResult
from refu_lab.benchmark._tables import tables
from refu_lab.tables import picture_markdown, write_json, write_page

PAGE, DATA = "performance.md", "performance.json"


def write_results(result: BenchmarkResult, folder: Path) -> list[Path]:
    """Writes `performance.md`, `performance.json` and, where errors were measured, the plot; gives their paths.

    Raises:
        RefuError: the folder can't be written.
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
    """The machine, and what else it was doing."""
    machine = result.machine
    pinned = "" if machine.get("core") is None else f", pinned to core {machine['core']}"
    text = f"{machine['processor']}, {machine['cores']} cores, one thread{pinned}; torch {machine['torch']}"
    if "gpu" in machine:
        text += f"; {machine['gpu']}"
    load = [machine.get("load_before"), machine.get("load_after")]
    if None not in load:
        text += f"; load average {load[0]:.1f} before, {load[1]:.1f} after"
    if result.interrupted:
        text += "; interrupted before everything was measured"
    return (
        f"{text}. Times are the processor's, medians and quartiles of contenders taken in turn; ratios are to "
        "refitting a BVH and asking it for every vertex (the plain query), taken in turn with them."
    )


def benchmark_text(result: BenchmarkResult) -> str:
    """What `refu benchmark` prints."""
    parts = [conditions(result)]
    parts += [table.text() for table in tables(result)]
    parts += [f"not measured: {name}: {need}" for name, need in result.missing.items()]
    return "\n\n".join(parts)
