"""Every tuned number for fitting garments to what a camera sees."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ObservationSettings:
    """How far points may move a garment, and how long that is remembered.

    Tuned on half of the style-shape pairs of the evaluation bags; `benchmarks/outputs.py` measures on the other half.
    """

    modes: int = 192
    """Most smooth fields that make up the displacement along the normal."""
    finest: float = 55.0
    """Their largest wave number [rad/m]: waves of 11 cm. A small garment has fewer fields."""
    amplitude: float = 0.009
    """Standard deviation of that displacement [m]: the networks' errors along the normal."""
    wave: float = 30.0
    """Wave number up to which fields are about as large as the widest [rad/m]: waves of 20 cm. Beyond, their size falls
    with its square."""
    bound: float = 3.0
    """Each number stays within this many of its standard deviations, whatever is measured."""
    noise: float = 0.003
    """Standard deviation of a cell's point along the normal, and of what the fields can't follow [m]."""
    enough: float = 2.0
    """A cell of space with this many points counts half as much as one with very many: what the fields can't follow is
    alike in neighbouring points, so more of them don't average it out."""
    cell: float = 0.035
    """Edge of a cell, whose points are replaced by their mean [m]."""
    reach: float = 0.04
    """Points farther from the cloth than this aren't matched to it [m]."""
    slack: float = 0.01
    """A point may be this much nearer to the skin than to the cloth and still be the cloth's [m]."""
    robust: float = 0.015
    """Height off the cloth above which a point counts less and less [m] (Cauchy)."""
    first_rounds: int = 2
    """How often the first points are matched; later ones once, since the last ones brought the cloth near."""
    most_points: int = 6000
    """More points than this are thinned out evenly."""
    remembered: float = 0.5
    """Time after which a displacement has faded to a third [s]: folds change with the pose."""
    step: float = 1 / 30
    """Time between frames that have no stamps [s]."""


DEFAULT_OBSERVATION = ObservationSettings()
