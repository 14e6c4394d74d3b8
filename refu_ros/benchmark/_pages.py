"""What a benchmark leaves behind: a page, JSON, a plot, and the text for the terminal."""

from __future__ import annotations

import json
from pathlib import Path

from refu_ros.benchmark._plot import PLOT, plot_time_against_error
from refu_ros.benchmark._rows import BenchmarkResult
from refu_ros.benchmark._tables import Table, markdown, tables
from refu_ros.tables import format_table

PAGE, DATA = "performance.md", "performance.json"
_WIDE = ("what is counted", "what is skipped")
"""Columns that a page has room for and a terminal hasn't."""


def write_results(result: BenchmarkResult, folder: Path) -> list[Path]:
    """Writes `performance.md`, `performance.json` and, where errors were measured, the plot; gives their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    plot = plot_time_against_error(result, folder)
    parts = ["# Run time", f"Measured by `{result.command}`. {conditions(result)}"]
    if plot is not None:
        parts.append(f"![Milliseconds a frame against error, every mode]({PLOT})")
    parts += [f"## {table.title}\n\n{markdown(table)}" for table in tables(result)]
    if result.missing:
        parts += ["## Not measured", "\n".join(f"- {name}: `{need}`" for name, need in result.missing.items())]
    (folder / PAGE).write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    (folder / DATA).write_text(json.dumps(result.as_dict(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return [folder / PAGE, folder / DATA, *([plot] if plot is not None else [])]


def conditions(result: BenchmarkResult) -> str:
    """The machine, and what else it was doing."""
    machine = result.machine
    pinned = "" if machine.get("core") is None else f", pinned to core {machine['core']}"
    text = f"{machine['processor']}, {machine['cores']} cores, one thread{pinned}; torch {machine['torch']}"
    if "gpu" in machine:
        text += f"; {machine['gpu']}"
    if result.rates is not None:
        text += (
            f"; copies {result.rates.copy_gb_s:.1f} GB/s, multiplies {result.rates.gemm_gflop_s:.0f} GFLOP/s (float32)"
        )
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
    parts += [f"{table.title}\n{format_table(*_narrow(table))}" for table in tables(result)]
    parts += [f"not measured: {name}: {need}" for name, need in result.missing.items()]
    return "\n\n".join(parts)


def _narrow(table: Table) -> tuple[list[str], list[list[str]]]:
    kept = [i for i, name in enumerate(table.header) if name not in _WIDE]
    return [table.header[i] for i in kept], [[row[i] for i in kept] for row in table.rows]
