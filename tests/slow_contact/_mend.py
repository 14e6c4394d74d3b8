"""Distances that can't be true, because a neighbour's says so, asked again from the neighbour's face."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from refu_core.contact import DEFAULT_CONTACT
from refu_core.sdf import SdfSample

_SETTINGS = DEFAULT_CONTACT


def mend(
    points: Tensor, sample: SdfSample, edges: Tensor, *, margin: float, look: Callable[[Tensor, Tensor], SdfSample]
) -> SdfSample:
    """The distances of a garment's vertices, made consistent along its edges where these are at the skin.

    Distances of two points differ by no more than the points are apart. Where the ends of an edge contradict that, an
    approximate distance has found another face than the closest for one of them, and never one that is nearer: the end
    farther from its face looks again, from the other end's face.

    Args:
        points: Garment vertices [m], shape (N, 3).
        sample: Their distances, with faces.
        edges: Pairs of vertices, shape (E, 2).
        margin: Distances above it are of no interest [m].
        look: The distance of points (R, 3) from faces near by (R,).
    """
    assert sample.face is not None  # the caller has seen to it
    for _ in range(_SETTINGS.max_pushes):
        first, second = _contradictions(points, sample.distance, edges, margin)
        is_nearer = sample.distance[first].abs() < sample.distance[second].abs()
        trusted, other = torch.where(is_nearer, first, second), torch.where(is_nearer, second, first)
        if not len(other) or sample.face is None:
            break
        again = look(points[other], sample.face[trusted])
        sample, changed = _replaced(sample, other, again, again.distance.abs() < sample.distance[other].abs())
        if not changed:
            break
    return sample


def _contradictions(points: Tensor, distance: Tensor, edges: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """Ends of the edges whose distances differ by more than their length, and of which one is below `margin`."""
    ends = distance[edges]
    differs = (ends[:, 0] - ends[:, 1]).abs() > _SETTINGS.tolerance
    suspects = edges[torch.nonzero(differs & (ends.amin(1) < margin))[:, 0]]
    first, second = suspects.unbind(1)
    length = torch.linalg.vector_norm(points[first] - points[second], dim=-1)
    first, second = suspects[(distance[first] - distance[second]).abs() > length + _SETTINGS.tolerance].unbind(1)
    return first, second


def _replaced(sample: SdfSample, rows: Tensor, by: SdfSample, which: Tensor) -> tuple[SdfSample, bool]:
    """The sample with those of `rows` replaced that `which` says; of several for one row, the nearest one."""
    rows, by = rows[which], by.rows(which)
    if not len(rows) or sample.face is None or by.face is None:
        return sample, False
    size = by.distance.abs()
    nearest = torch.full_like(sample.distance, torch.inf).scatter_reduce(0, rows, size, "amin")
    wins = size == nearest[rows]
    rows, by = rows[wins], by.rows(wins)
    assert by.face is not None
    replaced = SdfSample(
        sample.distance.index_copy(0, rows, by.distance),
        sample.gradient.index_copy(0, rows, by.gradient),
        sample.face.index_copy(0, rows, by.face.to(sample.face)),
    )
    return replaced, True
