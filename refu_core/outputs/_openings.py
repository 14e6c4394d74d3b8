"""A garment's openings as frames: where a sleeve ends, which way it faces, how wide it is, and what it is called."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.body import ARMS, LEGS, joints_of
from refu_core.garments import GarmentTemplate
from refu_core.mesh import as_points, rim_of
from refu_core.outputs._worn import require_garment

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
    runs = np.split(rows, np.flatnonzero(np.diff(mask[rows])) + 1)
    return max((run for run in runs if mask[run[0]]), key=lambda run: float(length[run].sum()))


def _called(ring: Ring, rest: NDArray[np.float64], weights: NDArray[np.float64]) -> str:
    """The opening's name, by the joints that move the rim and the way it opens; empty if it isn't a known one."""
    normal = _unit(newell(rest[ring.vertices]))
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


_FLAT = 0.1
"""A ring with less than this share of the area of a circle of the same length is drawn together. Its direction is then
taken more and more from the cloth beside it."""


@dataclass(frozen=True, eq=False)
class Opening:
    """One opening of a garment in one frame, in the axes of the vertices that were given."""

    name: str
    """`neck`, `left_sleeve`, `right_sleeve`, `waist`, `hem`, `left_leg`, `right_leg`, `front` (between the edges of a
    coat that is open), or `opening_0`, …"""
    centre: NDArray[np.float64]
    """Centre of the rim [m], shape (3,)."""
    rotation: NDArray[np.float64]
    """Columns are the frame's x, y and z, shape (3, 3): z points out of the garment, through the opening. In the rest
    pose x points to the wearer's left, or for a sleeve to the front; from there it moves with the cloth."""
    width: float
    """Extent of the rim along x [m]."""
    height: float
    """Extent of the rim along y [m]."""
    perimeter: float
    """Length of the rim [m]."""
    ring: NDArray[np.float64]
    """The rim's vertices in order, counter-clockwise as seen against z [m], shape (K, 3); the last is joined to the
    first."""


class Openings:
    """The openings of one garment, found once from its boundary; a frame then takes a fraction of a millisecond.

    Each is recognised by geometry and skinning weights, whatever the garment is called: a sleeve is moved by an arm and
    opens away from the trunk. The boundary of an open coat is one loop, which is cut into neck, hem and front.

    Centre and x are linear in the rim's vertices, with weights from the rest pose, so they are as steady as the cloth.
    """

    def __init__(self, garment: GarmentTemplate) -> None:
        """For any garment; one without a boundary has no openings. Raises `MeshError` for anything else."""
        require_garment(garment)
        rest = garment.v_template.detach().cpu().double().numpy()
        self._n_vertices = len(rest)
        rings = rings_of(garment)
        self.names: tuple[str, ...] = tuple(rings)
        """Names of the openings, in the order of `frames`."""
        self._rings = [(name, ring, _along(ring, rest)) for name, ring in rings.items()]

    def frames(self, vertices: Any) -> tuple[Opening, ...]:
        """The openings of a garment as it is worn, in the right-handed axes of its `vertices` (V, 3) [m].

        Raises `MeshError` for anything but finite numbers of that shape.
        """
        points = as_points("the garment's vertices", vertices, self._n_vertices)
        return tuple(_frame(name, ring, along, points) for name, ring, along in self._rings)


def _along(ring: Ring, rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (K,) with which the rim's vertices add up to the opening's x, in the rest pose and as the cloth moves."""
    points = rest[ring.vertices]
    normal = _unit(newell(points))
    wanted = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.7 else np.array([0, 0, 1.0])
    wanted -= (wanted @ normal) * normal
    middle = points - ring.shares @ points
    spread = (ring.shares[:, None] * middle).T @ middle
    weight: NDArray[np.float64] = ring.shares * (middle @ np.linalg.pinv(spread, rcond=1e-4) @ wanted)
    return weight


def _frame(name: str, ring: Ring, along: NDArray[np.float64], points: NDArray[np.float64]) -> Opening:
    rim = points[ring.vertices]
    after = np.roll(rim, -1, axis=0)
    centre = ring.shares @ rim
    away = rim - centre
    step = after - rim
    length = np.sqrt(np.einsum("ij,ij->i", step, step))
    perimeter = float(length.sum())
    area = 0.5 * np.cross(away, np.roll(away, -1, axis=0)).sum(0)
    roundness = 4 * math.pi * float(np.linalg.norm(area)) / max(perimeter, 1e-9) ** 2
    z = area
    if roundness < _FLAT:
        out = 0.5 * (rim + after) - points[ring.inner]
        out -= ((out * step).sum(1) / np.maximum(length, 1e-12) ** 2)[:, None] * step
        z = _unit(area) * roundness / _FLAT + _unit(out.sum(0)) * (1 - roundness / _FLAT)
    z = _unit(z)
    x = along @ away
    x = _unit(x - (x @ z) * z)
    y = np.cross(z, x)
    flat = away @ np.stack((x, y), axis=1)
    width, height = (flat.max(0) - flat.min(0)).tolist()
    return Opening(name, centre, np.stack((x, y, z), axis=1), width, height, perimeter, rim)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
