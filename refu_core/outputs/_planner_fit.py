"""Makes a coarse sheet's vertices weighted means of a garment's, so that it is near the cloth in many shapes."""

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
"""A vertex with a smaller weight than this in a coarse one is left out."""
_OWN = 0.5
"""Share of the garment's own kept vertex in a coarse vertex before fitting. The rest comes from the fit of the rest
pose, which overshoots where cloth folds."""
_FIRM = 1e-3
"""How firmly that fit is held to the kept vertices where hardly any cloth determines it."""
_ROUNDS = 2
"""How often the shapes are fitted, and after them the weights to all shapes."""
_STEPS = 3
_TETHER = 0.1
"""How firmly each step keeps a shape's fit where it was, and in one piece."""
_RIDGE = 1e-3
"""How firmly weights are kept as they were [m²]: there are more of them than the shapes determine."""
_PER_EDGE = 3
"""Parts of an edge: each triangle of the sheet is sampled at the corners of nine smaller ones."""
_TOUCHING = 5e-4
"""Distances below this count as this [m]."""


def fitted_means(shapes: Points, mesh: Connectivity, kept: NDArray[np.intp], sheet: NDArray[np.int32]) -> csr_array:
    """The weights (K, V), whose rows sum to one, that take a garment to the sheet near it.

    In each of the shapes (P, V, 3) [m], the first of which is the rest pose, the sheet is drawn to the cloth by ICP in
    both directions, in which places that are farther off count more. Ridge regression then finds the weights that best
    do this for all shapes, within each coarse vertex's own neighbourhood.
    """
    take = _means(shapes[0], mesh, kept, sheet)
    if len(kept) == shapes.shape[1]:
        return take
    for _ in range(_ROUNDS):
        goals = np.stack([_drawn(take @ shape, sheet, shape, mesh.faces) for shape in shapes])
        _regress(take, shapes, goals)
    return take


def _means(rest: Points, mesh: Connectivity, kept: NDArray[np.intp], sheet: NDArray[np.int32]) -> csr_array:
    """Weights half-way between those of the kept vertices and the least-squares fit of the rest pose."""
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
    """The matrix that takes a surface's vertices to its places closest to points, shape (N, K)."""
    found = surface.closest(points)
    ends = 3 * np.arange(len(points) + 1)
    shape = len(points), len(surface.vertices)
    return csr_array((found.weight.ravel(), surface.faces[found.face].ravel(), ends), shape=shape)


def _samples(sheet: NDArray[np.int32], n: int) -> csr_array:
    """The matrix that takes the sheet's n vertices to places spread over its triangles."""
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
    """Lengths (N,) of vectors [m], at least `_TOUCHING`: the weights of differences."""
    length: Points = np.maximum(np.linalg.norm(way, axis=1), _TOUCHING)
    return length


def _regress(take: csr_array, shapes: Points, goals: Points) -> None:
    """Changes each coarse vertex's weights in its neighbourhood so that it comes close to its goals in all shapes."""
    for k in range(take.shape[0]):
        of = slice(take.indptr[k], take.indptr[k + 1])
        near = shapes[:, take.indices[of]]
        middle = near.mean(1)
        around = (near - middle[:, None]).transpose(0, 2, 1).reshape(-1, near.shape[1])
        missed = (goals[:, k] - middle).ravel() - around @ take.data[of]
        change = around.T @ np.linalg.solve(around @ around.T + _RIDGE * np.eye(len(around)), missed)
        take.data[of] += change - change.mean()
