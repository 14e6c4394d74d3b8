"""Distances that can't be true, because a neighbour's says so, and what the neighbour's makes of them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from refu_core.contact import DEFAULT_CONTACT
from refu_core.sdf import SdfSample
from slow_contact._limbs import SlowLimbs

_SETTINGS = DEFAULT_CONTACT


def mend(
    points: Tensor,
    sample: SdfSample,
    limbs: SlowLimbs,
    *,
    margin: float,
    look: Callable[[Tensor, Tensor], SdfSample] | None = None,
) -> SdfSample:
    """The distances of a garment's vertices, made consistent along its edges where these are at the skin.

    Distances of two points differ by no more than the points are apart. Where the ends of an edge contradict that,

    - an approximate distance has found another face than the closest for one of them, and never one that is nearer: the
      end farther from its face looks again, from the other end's face;
    - or, where that is of no avail, the skin that one end is near isn't the body's surface. Where a bent arm runs into
      itself, the upper arm's skin is within the forearm, and a vertex deep in there is said to be outside of it. The
      end inside is right; the other one gets its distance to the tangent plane of the skin that the one inside is at,
      and leaves the body with it. That is so within a limb only: between two limbs cloth may well be outside of one
      and within the other. What is said to be inside has a way out of its own, and keeps it: a plane that is carried on
      from vertex to vertex leads ever deeper, until no push is long enough.

    Args:
        points: Garment vertices [m], shape (N, 3).
        sample: Their distances, with faces.
        limbs: The garment's edges, which limb a vertex lies on, and which a face is of.
        margin: Distances above it are of no interest [m].
        look: The distance of points (R, 3) from faces near by (R,); None where it needs no such hints.
    """
    if sample.face is None:
        return sample
    for _ in range(_SETTINGS.looks if look is not None else 0):
        first, second = _contradictions(points, sample.distance, limbs.edges, margin)
        is_nearer = sample.distance[first].abs() < sample.distance[second].abs()
        trusted, other = torch.where(is_nearer, first, second), torch.where(is_nearer, second, first)
        if look is None or not len(other):
            break
        again = look(points[other], sample.face[trusted])
        sample, changed = _replaced(sample, other, again, again.distance.abs() < sample.distance[other].abs())
        if not changed:
            break
    for _ in range(_SETTINGS.cuts):
        first, second = _contradictions(points, sample.distance, limbs.edges, margin)
        is_lower = sample.distance[first] < sample.distance[second]
        low, high = torch.where(is_lower, first, second), torch.where(is_lower, second, first)
        within = sample.rows(low)
        if not len(high) or within.face is None:
            break
        to_plane = within.distance + ((points[high] - points[low]) * within.gradient).sum(-1)
        is_wrong = (
            limbs.is_sole(high, within.face)
            & (within.distance < 0)
            & (sample.distance[high] >= 0)
            & (to_plane < sample.distance[high] - _SETTINGS.contradiction)
        )
        sample, changed = _replaced(sample, high, within._replace(distance=to_plane), is_wrong)
        if not changed:
            break
    return sample


def turn_outward(
    points: Tensor, sample: SdfSample, outward: Tensor, query: Callable[[Tensor, Tensor], SdfSample]
) -> tuple[SdfSample, int]:
    """The distances of vertices (R, 3), with the way out turned to the cloth's own side where it leads to the other.

    In the middle of a thin limb the closest skin of one vertex is in front and that of the next one behind: they would
    be torn apart, and the cloth between them end within the limb. So what is deep, and would leave against the outward
    normal of the cloth (R, 3), goes along that normal instead; its distance is then how far that is. Where that is
    nearly too far it goes between the two, if the body ends there as soon.

    `query` gives the distances of points (R', 3), which are those number `at` (R',). Returns how often it was asked,
    too.
    """
    against = (sample.gradient * outward).sum(-1) < 0
    rows = torch.nonzero(against & (sample.distance < -_SETTINGS.deep))[:, 0]
    depth, here = -sample.distance[rows], points[rows]
    farthest = (_SETTINGS.detour * depth).clamp_max(_SETTINGS.farthest)
    way, found, looks = _way_out(here, outward[rows], depth, farthest, lambda x, at: query(x, rows[at]))
    rows, here, depth, farthest, way = rows[found], here[found], depth[found], farthest[found], way[found]
    heading = outward[rows]
    share = (_SETTINGS.detour - way / depth) / _SETTINGS.turning
    between = torch.nonzero(share < 1)[:, 0]
    side = share[between, None] * heading[between] + (1 - share[between, None]) * sample.gradient[rows[between]]
    side = torch.nn.functional.normalize(side, dim=-1)
    way_between, found, more = _way_out(
        here[between], side, depth[between], farthest[between], lambda x, at: query(x, rows[between[at]])
    )
    way[between[found]], heading[between[found]] = way_between[found], side[found]
    turned = sample._replace(
        distance=sample.distance.index_copy(0, rows, -way), gradient=sample.gradient.index_copy(0, rows, heading)
    )
    return turned, looks + more


def _way_out(
    points: Tensor, heading: Tensor, depth: Tensor, farthest: Tensor, query: Callable[[Tensor, Tensor], SdfSample]
) -> tuple[Tensor, Tensor, int]:
    """How far it is out of the body [m] from points (R, 3) of this `depth` (R,) along `heading` (R, 3).

    Also where a way was found that is shorter than the `farthest` (R,), and how often it was asked.
    """
    way, going, looks = depth.clone(), torch.arange(len(points), device=points.device), 0
    while len(going) and looks < _SETTINGS.turns:
        # No skin is nearer than |f|.
        height = query(points[going] + way[going, None] * heading[going], going).distance
        way[going] = way[going] - height + (height < 0) * _SETTINGS.step_on
        going = going[(height < 0) & (way[going] < farthest[going])]
        looks += 1
    found = torch.ones_like(way, dtype=torch.bool).index_fill(0, going, False) & (way > 0) & (way < farthest)
    return way, found, looks


def _contradictions(points: Tensor, distance: Tensor, edges: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """Ends of the edges whose distances differ by more than their length, and of which one is below `margin`."""
    ends = distance[edges]
    differs = (ends[:, 0] - ends[:, 1]).abs() > _SETTINGS.contradiction
    suspects = edges[torch.nonzero(differs & (ends.amin(1) < margin))[:, 0]]
    first, second = suspects.unbind(1)
    length = torch.linalg.vector_norm(points[first] - points[second], dim=-1)
    first, second = suspects[(distance[first] - distance[second]).abs() > length + _SETTINGS.contradiction].unbind(1)
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
