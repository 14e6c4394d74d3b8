"""Where the vertices of a coarse sheet go, as means of a garment's, so that it is near the cloth in many shapes."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import splu

from refu_core.body import Surface
from refu_core.mesh import Connectivity, vertex_areas

Points = NDArray[np.float64]
_LEAST_WEIGHT = 0.01
"""A vertex counts less than this for a coarse one: it is left out."""
_OWN = 0.5
"""How much of a coarse vertex is the garment's own before it is fitted, the rest being the fit of the rest pose, which
overshoots where cloth folds."""
_FIRM = 1e-3
"""How much that fit is held together where hardly any cloth tells of it."""
_ROUNDS = 2
"""How often shapes are fitted, and then the weights to all of them."""
_STEPS = 3
_TETHER = 0.1
"""How much a shape's fit stays where it was, and in one piece, in each of the steps."""
_RIDGE = 1e-3
"""How much weights stay what they were [m²]: there are more of them than shapes say."""
_PER_EDGE = 3
"""A triangle of the sheet is asked about at the corners of nine smaller ones."""
_TOUCHING = 5e-4
"""Distances below it count alike [m]."""


def fitted_means(shapes: Points, mesh: Connectivity, kept: NDArray[np.intp], sheet: NDArray[np.int32]) -> csr_array:
    """The weights (K, V), rows of which sum to one, that take a garment to the sheet near it.

    In each shape (P, V, 3) [m], the first of which is the rest pose, the sheet is drawn to the cloth and to where the
    cloth is far from it (ICP in both directions, farther places counting more). The weights are then those that do so
    for all of them, by ridge regression among a coarse vertex's own neighbourhood.
    """
    take = _means(shapes[0], mesh, kept, sheet)
    if len(kept) == shapes.shape[1]:
        return take
    for _ in range(_ROUNDS):
        goals = np.stack([_drawn(take @ shape, sheet, shape, mesh.faces) for shape in shapes])
        _regress(take, shapes, goals)
    return take


def _means(rest: Points, mesh: Connectivity, kept: NDArray[np.intp], sheet: NDArray[np.int32]) -> csr_array:
    """Half-way between the kept vertices and the least squares of the rest pose."""
    own = csr_array((np.ones(len(kept)), (np.arange(len(kept)), kept)), shape=(len(kept), len(rest)))
    if len(kept) == len(rest):
        return own
    place = _placed(Surface(rest[kept], sheet), rest)
    weighed = (place.T * vertex_areas(rest, mesh.faces)).toarray()
    normal = np.asarray(weighed @ place)
    firm = _FIRM * float(np.trace(normal)) / len(kept)
    dense = cho_solve(cho_factor(normal + firm * np.eye(len(kept))), weighed + firm * own.toarray())
    dense[np.abs(dense) < _LEAST_WEIGHT] = 0
    dense /= dense.sum(1, keepdims=True)
    return csr_array((1 - _OWN) * dense + _OWN * own.toarray())


def _placed(surface: Surface, points: Points) -> csr_array:
    """What takes the surface's vertices to the places closest to points, shape (N, K)."""
    found = surface.closest(points)
    ends = 3 * np.arange(len(points) + 1)
    shape = len(points), len(surface.vertices)
    return csr_array((found.weight.ravel(), surface.faces[found.face].ravel(), ends), shape=shape)


def _samples(sheet: NDArray[np.int32], n: int) -> csr_array:
    """What takes the sheet's n vertices to places spread over its triangles."""
    steps = range(_PER_EDGE + 1)
    inner = [(i, j, _PER_EDGE - i - j) for i, j in product(steps, steps) if i + j <= _PER_EDGE]
    weights = np.tile(np.array(inner) / _PER_EDGE, (len(sheet), 1))
    corners = np.repeat(sheet, len(inner), axis=0)
    return csr_array((weights.ravel(), corners.ravel(), 3 * np.arange(len(weights) + 1)), shape=(len(weights), n))


def _drawn(sheet_points: Points, sheet: NDArray[np.int32], cloth: Points, faces: NDArray[np.int32]) -> Points:
    """The sheet's vertices (K, 3), drawn to a cloth (V, 3) [m]."""
    n, points = len(sheet_points), sheet_points
    samples, surface = _samples(sheet, n), Surface(cloth, faces)
    beside = Connectivity.of(sheet, n).adjacency_matrix()
    firm = 0.2 * (diags_array(beside.sum(axis=1)) - beside) + 0.1 * eye_array(n)
    for _ in range(_STEPS):
        place, asked = _placed(Surface(points, sheet), cloth), samples @ points
        goal = surface.at(surface.closest(asked))
        by_cloth = place.T * (_distance(place @ points - cloth) / (2 * len(cloth)))
        by_sheet = samples.T * (_distance(asked - goal) / len(asked))
        normal = by_cloth @ place + by_sheet @ samples
        tether = (_TETHER * normal.diagonal().mean()) * firm
        points = splu(csc_array(normal + tether)).solve(by_cloth @ cloth + by_sheet @ goal + tether @ points)
    return points


def _distance(way: Points) -> Points:
    """Lengths (N,) of vectors [m], which differences are weighted with."""
    length: Points = np.maximum(np.linalg.norm(way, axis=1), _TOUCHING)
    return length


def _regress(take: csr_array, shapes: Points, goals: Points) -> None:
    """Changes the weights that a coarse vertex has of its neighbourhood so that it goes where it is wanted."""
    for k in range(take.shape[0]):
        of = slice(take.indptr[k], take.indptr[k + 1])
        near = shapes[:, take.indices[of]]
        middle = near.mean(1)
        around = (near - middle[:, None]).transpose(0, 2, 1).reshape(-1, near.shape[1])
        missed = (goals[:, k] - middle).ravel() - around @ take.data[of]
        change = around.T @ np.linalg.solve(around @ around.T + _RIDGE * np.eye(len(around)), missed)
        take.data[of] += change - change.mean()
