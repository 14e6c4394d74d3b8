"""Where a body folds at its joints: seams between what a joint moves and what it doesn't, and the skin beside them."""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from refu_core.body._model import SmplBody
from refu_core.mesh import Connectivity
from refu_core.skeleton import CARRIED, JOINT_NAMES, PARENTS

LEVELS = (0.25, 0.5, 0.75)
"""A joint has a seam where this share of the skinning weight belongs to the joint and all that hangs on it. With the
middle one alone skin folds beside it: then 84 % of recorded frames don't intersect themselves, instead of 90 %."""
_JOINTS = [joint for joint in range(1, len(PARENTS)) if JOINT_NAMES[joint].split("_")[-1] not in ("hand", "foot")]
"""Fingers and toes fold within a hand or foot, which no garment lies on; a third of all rows would be theirs."""
SPACING = 0.015
"""Stations along a seam are about this far apart [m]: as far as the vertices of a body."""
_WIDTH = 0.03
"""How far along a seam its stations are averaged for a vertex [m]: wider than a mesh's edges, narrower than a limb."""
_ASIDE = 0.03
"""Skin up to this far from a seam, on both sides, determines the direction in which the seam parts them [m]."""
_AHEAD = 0.2
"""Skin that is lower over a seam than this share of its distance lies along the seam, which doesn't part it from
anything. When such skin was held, single vertices moved by up to 3 mm where nothing overlaps."""
N_STATIONS = 6
"""Stations that a vertex is held by."""


class Creases(NamedTuple):
    """Half spaces that keep skin on its own side of a joint's seam, R in all, in the order of the vertices.

    A seam is a line on the skin, sampled at S stations. Where the joint bends, a plane through the posed seam keeps the
    skin of both sides apart; it turns with the joint by the seam's level.
    """

    station_start: NDArray[np.int64]
    """Station s is the weighted mean of rows `station_start[s]` to `station_start[s + 1]` of the next two arrays,
    shape (S + 1,)."""
    station_vertex: NDArray[np.int64]
    station_weight: NDArray[np.float64]
    vertex: NDArray[np.int64]
    """The vertex that is held, shape (R,)."""
    rotation: NDArray[np.int64]
    """The joint times the number of `LEVELS`, plus the index of the seam's level, shape (R,)."""
    normal: NDArray[np.float64]
    """Normal of the plane in the rest pose, towards the vertex's side, shape (R, 3)."""
    height: NDArray[np.float64]
    """Distance from the plane in the rest pose [m], positive, shape (R,)."""
    along: NDArray[np.float64]
    """Distance from the seam in the rest pose [m], shape (R,)."""
    stations: NDArray[np.int64]
    """The plane goes through the mean of these stations, shape (R, 6) …"""
    weights: NDArray[np.float64]
    """… with these weights, shape (R, 6)."""


@lru_cache(maxsize=3)  # every pipeline and every checker of a body asks for the same ones
def find_creases(body: SmplBody, reach: float) -> Creases:
    """The creases of a body. Skin farther than `reach` [m] from a seam isn't held by it."""
    rest, weights = (one.double().cpu().numpy() for one in (body.v_template, body.weights))
    edges = Connectivity.of(body.faces.cpu(), len(rest)).edges
    first, second = np.ascontiguousarray(edges.T)
    moved_by = weights @ CARRIED  # the share of each vertex that a joint moves, with all that hangs on it
    tree = cKDTree(rest)
    station_rows: list[tuple[NDArray[Any], ...]] = []
    n_stations = 0
    rows: list[list[NDArray[Any]]] = []
    for joint, (i, level) in itertools.product(_JOINTS, enumerate(LEVELS)):
        moved = moved_by[:, joint]
        is_moved = moved > level
        start, end = edges[is_moved[first] != is_moved[second]].T
        if not len(start):
            continue
        share = (level - moved[start]) / (moved[end] - moved[start])
        seam = rest[start] * (1 - share)[:, None] + rest[end] * share[:, None]
        picked = _spread_out(seam)
        near = _falloff(cdist(seam[picked], seam), SPACING)
        one, on = np.nonzero(near)
        ends = np.concatenate([near[one, on] * (1 - share[on]), near[one, on] * share[on]])
        keys = np.tile(one, 2) * len(rest) + np.concatenate([start[on], end[on]])
        keys, inverse = np.unique(keys, return_inverse=True)
        station, vertices = np.divmod(keys, len(rest))
        means = np.bincount(inverse, ends)
        station_rows.append((np.bincount(station), vertices, means))
        cuts = np.cumsum(np.bincount(station))[:-1]
        places = np.stack([w @ rest[v] for v, w in zip(np.split(vertices, cuts), np.split(means, cuts), strict=True)])
        normals = _parting(places, rest, is_moved, tree)
        # What is near the seam, on either side of it
        vertex = np.flatnonzero(((rest >= seam.min(0) - reach) & (rest <= seam.max(0) + reach)).all(1))
        along = np.asarray(cKDTree(seam).query(rest[vertex], distance_upper_bound=reach)[0])
        vertex, along = vertex[np.isfinite(along)], along[np.isfinite(along)]
        distance = cdist(rest[vertex], places)
        chosen = np.argsort(distance, axis=1, kind="stable")[:, :N_STATIONS]
        chosen = np.pad(chosen, ((0, 0), (0, N_STATIONS - chosen.shape[1])), mode="edge")
        weight = _falloff(np.take_along_axis(distance, chosen, axis=1), _WIDTH)
        normal = _unit(np.einsum("rk,rkc->rc", weight, normals[chosen]))
        normal *= np.where(is_moved[vertex], 1.0, -1.0)[:, None]
        through = np.einsum("rk,rkc->rc", weight, places[chosen])
        height = np.einsum("rc,rc->r", rest[vertex] - through, normal)
        ahead = height > _AHEAD * along
        rotation = np.full(len(vertex), joint * len(LEVELS) + i)
        fields = vertex, rotation, normal, height, along, chosen + n_stations, weight
        rows.append([field[ahead] for field in fields])
        n_stations += len(places)
    order = np.argsort(np.concatenate([row[0] for row in rows]), kind="stable")
    counts, station_vertex, station_weight = (np.concatenate(field) for field in zip(*station_rows, strict=True))
    return Creases(
        np.cumsum([0, *counts]),
        station_vertex,
        station_weight,
        *(np.concatenate(field)[order] for field in zip(*rows, strict=True)),
    )


def _spread_out(points: NDArray[np.float64]) -> list[int]:
    """Indices of some of the points, `SPACING` apart: the farthest from those picked, again and again."""
    picked = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while distance.max() > SPACING:
        picked.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[picked[-1]], axis=1))
    return picked


def _falloff(distance: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Weights of rows of distances [m], which fall off over `width` [m] beyond the least one; each row sums to one."""
    beyond = distance**2 - distance.min(axis=1, keepdims=True) ** 2
    weight: NDArray[np.float64] = np.exp(-beyond / (2 * width**2))
    weight[weight < 1e-3] = 0.0
    weight /= weight.sum(axis=1, keepdims=True)
    return weight


def _parting(
    places: NDArray[np.float64], rest: NDArray[np.float64], is_moved: NDArray[np.bool_], tree: cKDTree
) -> NDArray[np.float64]:
    """Unit vectors at places on a seam (S, 3), from the nearby skin that isn't moved to the skin that is."""
    balls: Any = tree.query_ball_point(places, _ASIDE)
    counts = [len(ball) for ball in balls]
    near, station = np.concatenate(balls).astype(np.int64), np.repeat(np.arange(len(places)), counts)
    weight = np.maximum(_ASIDE - np.linalg.norm(rest[near] - places[station], axis=1), 1e-9)
    # Of each station's skin: what isn't moved, and what is. A station that has no skin of one kind parts nothing.
    side = 2 * station + is_moved[near]
    n_sides = 2 * len(places)
    by_side = np.split(weight[np.argsort(side, kind="stable")], np.cumsum(np.bincount(side, minlength=n_sides))[:-1])
    total = np.array([one.sum() for one in by_side])
    sums = np.stack([np.bincount(side, weight * column, n_sides) for column in rest[near].T], 1)
    still, moved = (sums / np.maximum(total, 1e-300)[:, None]).reshape(-1, 2, 3).swapaxes(0, 1)
    normals = np.where(total.reshape(-1, 2).min(1, keepdims=True) > 0, moved - still, 0.0)
    return _unit(normals)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return unit
