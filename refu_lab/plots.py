"""Plots in one style, made without a display."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#3b6ea5", "#e0a030", "#4a9a6a", "#b5493f", "#7a5fa0")


def new_axes(
    rows: int = 1, columns: int = 1, *, size: tuple[float, float], **options: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of the given size [inches] and its axes, row by row; `options` are those of `Figure.subplots`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes: list[Axes] = list(np.ravel(figure.subplots(rows, columns, **options)))
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(alpha=0.25)
    return figure, axes


def save_svg(figure: Figure, path: Path) -> None:
    """Writes a figure; equal figures give equal files, without date or random names."""
    import matplotlib as mpl

    with mpl.rc_context({"svg.hashsalt": path.name}):
        figure.savefig(path, metadata={"Date": None})
