"""The paper's plots: energy histograms, scale against distance ratio, collisions far from the training set."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core.evaluation.reproduction._build import ENERGY_ZOOM, LABELS, UNSEEN_GROUPS
from refu_core.evaluation.reproduction._runs import RATIO_EDGES, Run, Study

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

_COLOURS = ("#3b6ea5", "#e0a030", "#4a9a6a", "#b5493f", "#7a5fa0")


def plot_energy(study: Study, folder: Path) -> list[tuple[str, str]]:
    """`energy.svg` and `energy_zoom.svg`: samples by penetration energy, all garments together (supplement, Fig.
    "hist").

    Returns (file, caption) of what there was data for.
    """
    pairs = [_pooled(study, method) for method in ("tailornet", "refu-hybrid")]
    pooled = [runs for runs in pairs if runs]
    if len(pooled) < 2:
        return []
    energies = [np.array([s.energy for run in runs for s in run.samples]) for runs in pooled]
    labels = [_label(runs[0].method) for runs in pooled]
    top = max(float(energy.max()) for energy in energies)
    plots = []
    for file, end in (("energy.svg", max(top, ENERGY_ZOOM)), ("energy_zoom.svg", ENERGY_ZOOM)):
        figure, (ax,) = _figure(1)
        ax.hist(
            [e[e <= end] for e in energies], bins=np.linspace(0, end, 31).tolist(), label=labels, color=_COLOURS[:2]
        )
        ax.set(xlabel="penetration energy [m²]", ylabel="test samples", yscale="symlog")
        ax.legend(frameon=False)
        _save(figure, folder / file)
        plots.append((file, f"Test samples by penetration energy up to {end:.2g} m², all garments together"))
    return plots


def plot_scale(study: Study, folder: Path) -> list[tuple[str, str]]:
    """`scale.svg`: mean α by the ratio of approximate to accurate distance (supplement, Fig. "scale_analysis")."""
    shown = [runs for runs in (_pooled(study, m) for m in ("refu-approx", "refu-hybrid")) if runs]
    shown = [runs for runs in shown if sum(run.scales.count.sum() for run in runs)]
    if not shown:
        return []
    figure, (ax,) = _figure(1)
    places = np.arange(len(RATIO_EDGES) - 1)
    for k, runs in enumerate(shown):
        count = np.sum([run.scales.count for run in runs], axis=0)
        total = np.sum([run.scales.total for run in runs], axis=0)
        mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
        bars = ax.bar(places + 0.4 * k, mean, 0.38, color=_COLOURS[k], label=_label(runs[0].method), align="edge")
        ax.bar_label(bars, [f"{n:,}" if n else "" for n in count], fontsize=7, rotation=90, padding=3)
    names = [f"({low:g}, {high:g}]" for low, high in itertools.pairwise(RATIO_EDGES)]
    ax.set_xticks(places + 0.4, names, rotation=30, fontsize=8)
    ax.set(xlabel="approximate / accurate distance", ylabel="mean α")
    ax.margins(y=0.25)
    ax.legend(frameon=False)
    _save(figure, folder / "scale.svg")
    return [
        ("scale.svg", "Mean predicted scale of vertices inside the body, by how wrong their distance is; with counts")
    ]


def plot_unseen(study: Study, folder: Path) -> list[tuple[str, str]]:
    """`unseen.svg`: collision error against the distance to the training set (supplement, Fig. "unseen")."""
    methods = ("tailornet", "collision-loss-accurate", "collision-loss-approx", "refu-approx", "refu-hybrid")
    shown = [(method, study.garments, _pooled(study, method)) for method in methods]
    figure, (ax,) = _figure(1)
    drawn = 0
    for k, (method, _, runs) in enumerate(shown):
        distance = np.array([d for run in runs for d in run.unseen])
        error = np.array([s.collision_error_mm for run in runs for s in run.samples])
        if not len(distance) or not np.isfinite(distance).all():
            continue
        groups = np.array_split(np.argsort(distance, kind="stable"), min(UNSEEN_GROUPS, len(distance)))
        x = [distance[g].mean() for g in groups]
        ax.plot(x, [error[g].mean() for g in groups], "o-", color=_COLOURS[k], label=_label(method))
        drawn += 1
    if not drawn:
        return []
    ax.set(xlabel="distance to the nearest training sample", ylabel="mean collision error [mm]")
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False)
    _save(figure, folder / "unseen.svg")
    return [("unseen.svg", "Mean collision error Σ max(0, -f) against the distance to the training set, all garments")]


PLOTS = {"energy": plot_energy, "alpha": plot_scale, "unseen": plot_unseen}
"""What draws the plots of a table."""


def _pooled(study: Study, method: str) -> list[Run]:
    """The method's runs of all garments; none where one is missing, or the plot would compare other garments."""
    runs = [study.runs.get((garment, method)) for garment in study.garments]
    return [run for run in runs if run is not None] if None not in runs else []


def _label(method: str) -> str:
    return LABELS[method].replace("*", "")


def _figure(rows: int) -> tuple[Any, Sequence[Axes]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 3.6 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = list(np.atleast_1d(figure.subplots(rows, 1)))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.25)
    return figure, axes


def _save(figure: Any, path: Path) -> None:
    """As SVG that is the same for the same figures: no date, no random names."""
    import matplotlib as mpl

    with mpl.rc_context({"svg.hashsalt": path.name}):
        figure.savefig(path, metadata={"Date": None})
