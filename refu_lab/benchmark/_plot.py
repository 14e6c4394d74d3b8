"""The time-against-error plot: every mode's place between what a frame costs and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from refu_lab.benchmark._rows import BenchmarkResult, BenchmarkRow
from refu_lab.plots import new_axes
from refu_lab.reproduction import published_modes

PLOT = "time-against-error.png"
_METRICS = (
    ("mpve_mm", "mean error MPVE [mm]"),
    ("vfcp_percent", "vertices inside the body VFCP [%]"),
    ("cfmp_percent", "collision-free frames CFMP [%]"),
)
_COLOURS = {"none": "#7a7a7a", "approx": "#e0a030", "hybrid": "#4a9a6a", "accurate": "#3b6ea5"}
_SIZES = {"none": 7, "approx": 12, "hybrid": 8.5, "accurate": 5}
"""Smaller ones are drawn later, so that places which are nearly the same can be told apart."""
_MARKERS = {"tailornet": "o", "skinned": "s"}


def plot_time_against_error(result: BenchmarkResult, folder: Path) -> Path | None:
    """Writes `time-against-error.png` of the main garment; None where no errors were measured."""
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
    folder.mkdir(parents=True, exist_ok=True)
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
    """Times that have no error of their own: the plain query's, and that of the untrained paper's structure."""
    main = result.rows[0].garment
    marks = [(row.ms_median, "plain query alone") for row in result.of("sdf", mode="plain", garment=main, device="cpu")]
    if not result.quick:
        same = result.of("frame", mode="paper", device="cpu")
        marks += [(row.ms_median, "the paper's structure on this core") for row in same]
    return marks
