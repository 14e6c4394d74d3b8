"""What is next to what in a triangle mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from refu_core._cache import remembered
from refu_core._numbers import NOT_NUMBERS, as_numbers, as_whole
from refu_core.errors import MeshError

_Float = TypeVar("_Float", np.float32, np.float64)


class Adjacency(NamedTuple):
    """What is around each vertex of a mesh of V vertices: around vertex v, `items[start[v]:start[v + 1]]`."""

    start: NDArray[np.int32]
    """Shape (V + 1,)."""
    items: NDArray[np.int32]
    """In ascending order around each vertex."""

    @property
    def owner(self) -> NDArray[np.int64]:
        """The vertex that each of `items` is around, of the same shape."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))


@dataclass(frozen=True, eq=False)
class Connectivity:
    """What is next to what in a triangle mesh of V vertices and F faces; each result is computed once, on request."""

    faces: NDArray[np.int32]
    """Vertices of each face, counter-clockwise seen from outside, shape (F, 3)."""
    n_vertices: int
    """V."""

    @classmethod
    def of(cls, faces: Any, n_vertices: int | None = None) -> Connectivity:
        """For `faces`, integers of shape (F, 3), and by default as many vertices as they name; raises `MeshError`."""
        checked = check_faces(faces, n_vertices=n_vertices)
        return _connectivity(checked, int(checked.max()) + 1 if n_vertices is None else int(n_vertices))

    @cached_property
    def _edges(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Each edge's lower end times V plus its upper end, the edge of each corner, each edge's number of faces."""
        start, end = self.faces.astype(np.int64), np.roll(self.faces, -1, axis=1).astype(np.int64)
        keys = np.minimum(start, end) * self.n_vertices + np.maximum(start, end)
        edges, of_corner, n_faces = np.unique(keys.ravel(), return_inverse=True, return_counts=True)
        return edges, of_corner.reshape(-1, 3), n_faces

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """Each edge once, lower vertex first, in ascending order, shape (E, 2)."""
        return np.stack(np.divmod(self._edges[0], self.n_vertices), axis=1).astype(np.int32)

    @property
    def edge_of_corner(self) -> NDArray[np.int64]:
        """The numbers of the edges (0, 1), (1, 2), (2, 0) of each face, shape (F, 3)."""
        return self._edges[1]

    @property
    def n_faces_of_edge(self) -> NDArray[np.int64]:
        """How many faces each edge has, shape (E,): in a manifold, one on the boundary and two elsewhere."""
        return self._edges[2]

    @property
    def boundary(self) -> NDArray[np.int32]:
        """The edges that have only one face, shape (B, 2)."""
        return np.compress(self.n_faces_of_edge == 1, self.edges, axis=0)

    @cached_property
    def ring(self) -> Adjacency:
        """The vertices that edges join to each vertex."""
        pairs = np.concatenate((self.edges[:, ::-1], self.edges))  # sorting is stable: lower numbers come first
        return _grouped(pairs[:, 0], pairs[:, 1], self.n_vertices)

    @cached_property
    def fan(self) -> Adjacency:
        """The faces around each vertex."""
        return _grouped(self.faces.ravel(), np.repeat(np.arange(len(self.faces)), 3), self.n_vertices)

    def require_closed(self) -> None:
        """Raises `MeshError` where the mesh isn't a closed, consistently oriented surface."""
        start, end = self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()
        n_faces = self.n_faces_of_edge
        n_open, n_crowded = int((n_faces == 1).sum()), int((n_faces > 2).sum())
        one_way = np.bincount(self.edge_of_corner.ravel(), weights=np.where(end > start, 1.0, -1.0)) != 0
        n_flipped = int(one_way[n_faces == 2].sum())
        if n_open or n_crowded or n_flipped:
            edges = f"{n_open} open edges, {n_crowded} edges of more than two faces and {n_flipped} edges whose two"
            fault = f"{edges} faces face opposite ways; close the mesh and orient its faces outward"
            raise MeshError(f"a signed distance needs a watertight body: {fault}")

    @cached_property
    def across(self) -> NDArray[np.int32]:
        """The face on the other side of the edges (0, 1), (1, 2), (2, 0) of each face of a closed mesh, shape (F, 3).

        Raises `MeshError` as `require_closed` does.
        """
        self.require_closed()
        # Every edge has exactly two corners: sorting by edge puts partners side by side.
        order = np.argsort(self.edge_of_corner.ravel(), kind="stable").reshape(-1, 2)
        across = np.empty(self.faces.size, np.int32)
        across[order[:, 0]], across[order[:, 1]] = order[:, 1] // 3, order[:, 0] // 3
        return across.reshape(-1, 3)

    def adjacency_matrix(self) -> sparse.csr_array:
        """1 for each pair of vertices that an edge joins, shape (V, V)."""
        shape = (self.n_vertices, self.n_vertices)
        return sparse.csr_array((np.ones(len(self.ring.items)), self.ring.items, self.ring.start), shape=shape)

    def uniform_laplacian(self) -> sparse.csr_array:
        """The matrix that subtracts from each vertex the mean of its neighbours, shape (V, V)."""
        adjacent = self.adjacency_matrix()
        degree = np.maximum(adjacent.sum(axis=1), 1.0)
        return sparse.csr_array(sparse.eye_array(self.n_vertices) - sparse.diags_array(1.0 / degree) @ adjacent)


@remembered(16)  # a person's body and clothes are asked about by every part of a pipeline
def _connectivity(faces: NDArray[np.int32], n_vertices: int) -> Connectivity:
    return Connectivity(faces.copy(), n_vertices)  # the caller's may change


def check_faces(faces: Any, *, n_vertices: int | None = None) -> NDArray[np.int32]:
    """`faces` (a tensor, too) as a contiguous int32 array of shape (F, 3).

    Raises `MeshError` unless they are integers of that shape below `n_vertices`, three different ones per face.
    """
    try:
        array = as_numbers(faces.detach().cpu() if hasattr(faces, "detach") else faces)
    except NOT_NUMBERS as error:
        raise MeshError(f"faces must be integers of shape (F, 3), got {type(faces).__name__}: {error}") from error
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0 or array.dtype.kind not in "iu":
        raise MeshError(f"faces must be integers of shape (F, 3), got {array.dtype} of shape {array.shape}")
    low, high = int(array.min()), int(array.max())
    limit = most = int(np.iinfo(np.int32).max)
    if n_vertices is not None:
        try:
            limit = as_whole(n_vertices)
        except NOT_NUMBERS:
            limit = -1
        if not 0 <= limit <= most:
            raise MeshError(f"wanted a number of vertices, 0 to {most}, got {n_vertices!r}")
    if low < 0 or high >= limit:
        raise MeshError(f"faces must index vertices 0 to {limit - 1}, got {low} to {high}")
    repeated = (array == np.roll(array, 1, axis=1)).any(axis=1)
    if repeated.any():
        bad = f"{repeated.sum()} of {len(array)} repeat one, number {int(repeated.argmax())} (from 0) first"
        raise MeshError(f"every face needs three different vertices; {bad}: leave such faces out")
    return np.ascontiguousarray(array, dtype=np.int32)


def linked(pairs: NDArray[np.integer], n: int) -> tuple[int, NDArray[np.int64]]:
    """How many groups the links (L, 2) join n things into, and the group of each, numbered from the first thing on."""
    graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    return int(count), label.astype(np.int64)


def rim_of(faces: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which edges (0, 1), (1, 2), (2, 0) of faces (F, 3) have no face that runs through them the other way, (F, 3)."""
    start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    n = int(faces.max(initial=0)) + 1
    return ~np.isin(start * n + end, end * n + start)


def as_points(
    name: str, values: Any, n: int | None = None, *, dtype: type[np.floating[Any]] = np.float64
) -> NDArray[Any]:
    """`values` (a tensor, too) as contiguous, finite points, shape (n, 3). Raises `MeshError` for anything else."""
    shape = f"the shape ({'N' if n is None else n}, 3)"
    try:
        given = as_numbers(values.detach().cpu() if hasattr(values, "detach") else values)
        points = np.ascontiguousarray(given, dtype=dtype)
    except NOT_NUMBERS as error:
        raise MeshError(f"{name} must be numbers of {shape}, got {type(values).__name__}: {error}") from error
    if points.ndim != 2 or points.shape[1] != 3 or (n is not None and len(points) != n):
        raise MeshError(f"{name} must have {shape}, got {points.shape}")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        raise MeshError(f"{name} must be finite, got {bad} of {len(points)} with NaN or infinite coordinates")
    # Torch warns about read-only arrays, and those of a pipeline are.
    return points if points.flags.writeable else points.copy()


def face_normals(v: NDArray[_Float], f: NDArray[np.integer[Any]]) -> NDArray[_Float]:
    """Normals of faces (F, 3) of vertices (V, 3), twice their area long, shape (F, 3)."""
    return np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])


def vertex_normals(vertices: NDArray[_Float], faces: NDArray[np.integer[Any]]) -> NDArray[_Float]:
    """Unit normals at vertices (V, 3) of faces (F, 3): the area-weighted mean of faces around each, shape (V, 3)."""
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, face_normals(vertices, faces)[:, None])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return normals


def vertex_areas(vertices: NDArray[np.floating[Any]], faces: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
    """A third of the area of the faces (F, 3) around each of the vertices (V, 3) [m²], shape (V,)."""
    third = np.linalg.norm(face_normals(vertices.astype(np.float64), faces), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(third, 3), len(vertices)).astype(np.float64)


def _grouped(owner: NDArray[Any], items: NDArray[Any], n: int) -> Adjacency:
    order = np.argsort(owner, kind="stable")
    start = np.concatenate(([0], np.cumsum(np.bincount(owner, minlength=n))))
    return Adjacency(start.astype(np.int32), items[order].astype(np.int32))


def grouped(places: NDArray[np.floating[Any]], width: int = 8) -> NDArray[np.int64]:
    """An order of places (N, 3) in which every eight (or `width`) in a row, every 64, and so on are close together."""
    n = len(places)
    sizes_of_groups = width ** np.arange(20, dtype=np.int64)
    order, bounds = np.arange(n), np.array([0, n])
    while (is_open := np.diff(bounds) > 1).any():
        starts, sizes = bounds[:-1], np.diff(bounds)
        here = places[order]
        low = np.minimum.reduceat(here, starts)
        extent = np.maximum.reduceat(here, starts) - low
        groups, axis = np.arange(len(starts)), extent.argmax(1)
        group = np.repeat(groups, sizes)
        along = here[np.arange(n), axis[group]] - low[groups, axis][group]
        # The integer part of a key keeps groups apart: one sort takes half the time of two.
        key = group + 0.5 * along / np.maximum(extent[groups, axis], np.finfo(np.float32).tiny)[group]
        order = order[np.argsort(key, kind="stable")]
        # Cuts into halves of whole groups of the next smaller size: only the very last group may have fewer.
        unit = sizes_of_groups[np.searchsorted(sizes_of_groups, sizes[is_open]) - 1]
        half = np.maximum(-(-sizes[is_open] // unit) // 2, 1) * unit
        bounds = np.union1d(bounds, starts[is_open] + half)
    return order


grouped_at_rest = remembered(16)(grouped)
"""`grouped`, for places that every pipeline asks about again."""


def symmetric_solver(matrix: sparse.sparray) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Solves for right sides (N, K) of a sparse matrix (N, N) that is symmetric and whose diagonal is positive.

    The factors aren't pivoted: that takes up to forty times as long, and makes them several times as large.
    """
    options = {"SymmetricMode": True}
    factors = splu(sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return factors.solve
