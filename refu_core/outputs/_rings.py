"""A garment's boundary as rings, and what each of them is called."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from refu_core.body import ARMS, LEGS, joints_of
from refu_core.mesh import rim_of

if TYPE_CHECKING:
    from refu_core.garments import GarmentTemplate

NAMES = ("neck", "left_sleeve", "right_sleeve", "waist", "hem", "left_leg", "right_leg", "front")
"""What openings are called, in the order in which they are listed; others are `opening_0`, `opening_1`, …"""

LEAST_PERIMETER = 0.08
"""A shorter loop is a button hole or a flaw of the mesh [m]: no wrist goes through it."""
_LEAST_ARC = 0.15
"""A loop with at least this length of both an upper and a lower rim is cut into these [m]: it is the boundary of a coat
that is open in front."""
_WINDOW = 0.05
"""Length over which the direction of a rim is averaged [m]: boundaries of imported meshes may be stepped."""
_LOW = -0.5
"""A rim is a lower one if its direction out of the cloth has an upward part below this: 30 degrees downwards."""
_UPRIGHT = 0.8
"""A rim is the edge of a front if its own direction has a vertical part above this; a neckline is less steep."""
_TOP, _SIDE, _BOTTOM = 1, 0, -1
_UPPER = (*joints_of("head"), 9, 13, 14)
"""Joints of the body above the chest, without the arms."""


@dataclass(frozen=True, eq=False)
class Ring:
    """One opening's rim in the rest pose."""

    vertices: NDArray[np.intp]
    """In order, counter-clockwise as seen from outside, each once, shape (K,)."""
    inner: NDArray[np.intp]
    """The third vertex of the face at the edge from each vertex to the next, shape (K,). Where a chord closes the rim,
    it is that of the edge that was there before."""
    shares: NDArray[np.float64]
    """Each vertex's share of the rim's length, shape (K,)."""


def rings_of(garment: GarmentTemplate) -> dict[str, Ring]:
    """The openings of a garment in its rest pose by their names, in the order of `NAMES`; none for a closed one."""
    rest = garment.v_template.detach().cpu().double().numpy()
    weights = garment.weights.detach().cpu().double().numpy()
    found: list[tuple[str, float, Ring]] = []
    for loop, inner in _loops(garment.mesh.faces):
        for part, across, is_front in _parts(loop, inner, rest):
            length = _lengths(rest[part])
            share = 0.5 * (length + np.roll(length, 1))
            ring = Ring(part, across, share / share.sum())
            if length.sum() >= LEAST_PERIMETER:
                name = "front" if is_front else _called(ring, rest, weights)
                found.append((name, float(length.sum()), ring))
    found.sort(key=lambda one: -one[1])
    named: dict[str, Ring] = {}
    for name, _, ring in found:  # of two that would have the same name, the longer one gets it
        if not name or name in named:
            name = f"opening_{sum(known.startswith('opening') for known in named)}"
        named[name] = ring
    order = [*(name for name in NAMES if name in named), *sorted(name for name in named if name not in NAMES)]
    return {name: named[name] for name in order}


def newell(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The vector area of a closed polygon of points (K, 3) [m²], shape (3,)."""
    middle = points - points.mean(0)
    area: NDArray[np.float64] = 0.5 * np.cross(middle, np.roll(middle, -1, axis=0)).sum(0)
    return area


def _loops(faces: NDArray[np.int32]) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Each boundary loop, against the direction of its faces, and the vertices across from its edges."""
    on_rim = rim_of(faces)
    onward: dict[int, list[tuple[int, int]]] = {}
    for a, b, c in zip(*(np.roll(faces, -k, axis=1)[on_rim].tolist() for k in range(3)), strict=True):
        onward.setdefault(b, []).append((a, c))
    while onward:
        first = vertex = next(iter(onward))
        loop, inner = [], []
        while vertex in onward:  # a vertex where rims meet is left along another rim each time
            following, beyond = onward[vertex].pop()
            if not onward[vertex]:
                del onward[vertex]
            loop.append(vertex)
            inner.append(beyond)
            vertex = following
            if vertex == first:
                break
        if len(loop) > 2:
            yield np.array(loop, np.intp), np.array(inner, np.intp)


def _lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Length of the edge from each point of a closed polygon (K, 3) [m] to the next, shape (K,)."""
    length: NDArray[np.float64] = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    return length


def _parts(
    loop: NDArray[np.intp], inner: NDArray[np.intp], rest: NDArray[np.float64]
) -> list[tuple[NDArray[np.intp], NDArray[np.intp], bool]]:
    """A loop as it is, or, if it is an upper and a lower rim in one, these two and what lies between them."""
    points, length = rest[loop], _lengths(rest[loop])
    after = np.roll(points, -1, axis=0)
    along = (after - points) / np.maximum(length, 1e-12)[:, None]
    out = 0.5 * (points + after) - rest[inner]
    out -= (out * along).sum(1, keepdims=True) * along
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
    place = np.cumsum(length) - 0.5 * length
    gap = np.abs(place[:, None] - place)
    near = np.minimum(gap, length.sum() - gap) <= 0.5 * _WINDOW
    mean = near * length / (near @ length)[:, None]
    up, upright = mean @ out[:, 1], mean @ np.abs(along[:, 1])
    kind = np.where(up < _LOW, _BOTTOM, np.where(upright > _UPRIGHT, _SIDE, _TOP))
    top, bottom = (_longest_run(kind == which, length) for which in (_TOP, _BOTTOM))
    if min(length[top].sum(), length[bottom].sum()) < _LEAST_ARC:
        return [(loop, inner, False)]
    sides = np.setdiff1d(np.arange(len(loop)), np.concatenate((top, bottom)))
    return [(loop[rows], inner[rows], is_front) for rows, is_front in ((top, False), (bottom, False), (sides, True))]


def _longest_run(mask: NDArray[np.bool_], length: NDArray[np.float64]) -> NDArray[np.intp]:
    """The edges of the longest run of a circular mask, in order."""
    if mask.all() or not mask.any():
        return np.flatnonzero(mask)
    turn = int(np.flatnonzero(~mask)[0])
    rows = np.roll(np.arange(len(mask)), -turn)
    starts = np.flatnonzero(np.diff(mask[rows].astype(np.int8), prepend=0) == 1)
    ends = np.flatnonzero(np.diff(mask[rows].astype(np.int8), append=0) == -1)
    runs: Sequence[NDArray[np.intp]] = [rows[a : b + 1] for a, b in zip(starts, ends, strict=True)]
    return max(runs, key=lambda run: float(length[run].sum()))


def _called(ring: Ring, rest: NDArray[np.float64], weights: NDArray[np.float64]) -> str:
    """The opening's name, by the joints that move the rim and the way it opens; empty if it isn't a known one."""
    area = newell(rest[ring.vertices])
    normal = area / max(float(np.linalg.norm(area)), 1e-12)
    of_joint = ring.shares @ weights[ring.vertices]
    for side, arm, collar, outward in (("left", ARMS[0], 13, 1.0), ("right", ARMS[1], 14, -1.0)):
        moved = of_joint[list(arm)].sum()
        sideways = outward * normal[0]
        if sideways > 0 and (moved > 0.5 or (sideways > 0.6 and moved + of_joint[collar] > 0.25)):
            return f"{side}_sleeve"
    left, right = (of_joint[list(leg)].sum() for leg in LEGS)
    if abs(left - right) > 0.3 and normal[1] < 0:
        return "left_leg" if left > right else "right_leg"
    if max(of_joint[list(arm)].sum() for arm in ARMS) > 0.5 or abs(left - right) > 0.3 or abs(normal[1]) < 0.3:
        return ""
    if normal[1] < 0:
        return "hem"
    return "neck" if of_joint[list(_UPPER)].sum() > 0.5 else "waist"
