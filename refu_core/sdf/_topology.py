"""Neighbours of the faces of a closed triangle mesh, and the check that it is closed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import MeshError


@dataclass(frozen=True, eq=False)
class Topology:
    """What a signed distance must know of a watertight mesh beyond its vertices."""

    faces: NDArray[np.int32]
    """Vertices of each face, counter-clockwise seen from outside, shape (F, 3)."""
    across: NDArray[np.int32]
    """Face on the other side of the edges (0, 1), (1, 2), (2, 0) of each face, shape (F, 3)."""
    fan_start: NDArray[np.int32]
    """The faces around vertex v are `fan_face[fan_start[v]:fan_start[v + 1]]`; shape (n_vertices + 1,)."""
    fan_face: NDArray[np.int32]
    """Faces in the order of their vertices, shape (3 F,)."""

    @property
    def n_vertices(self) -> int:
        """The fewest vertices the faces can index."""
        return len(self.fan_start) - 1

    @staticmethod
    def of_closed_mesh(faces: Any) -> Topology:
        """The topology of `faces`, integers of shape (F, 3).

        Raises `MeshError` when `faces` isn't such an array, or isn't a closed, consistently oriented surface.
        """
        checked = check_faces(faces)
        return Topology(checked, _faces_across(checked), *_fans(checked))


def check_faces(faces: Any, *, n_vertices: int | None = None) -> NDArray[np.int32]:
    """`faces` as a contiguous int32 array of shape (F, 3), each of three different vertices below `n_vertices`."""
    array = np.asarray(faces)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0 or array.dtype.kind not in "iu":
        msg = f"faces must be integers of shape (F, 3), got {array.dtype} of shape {array.shape}"
        raise MeshError(msg)
    low, high = int(array.min()), int(array.max())
    limit = n_vertices if n_vertices is not None else np.iinfo(np.int32).max
    if low < 0 or high >= limit:
        msg = f"faces must index vertices 0 to {limit - 1}, got {low} to {high}"
        raise MeshError(msg)
    repeated = (array == np.roll(array, 1, axis=1)).any(axis=1)
    if repeated.any():
        msg = f"every face needs three different vertices; {repeated.sum()} of {len(array)} repeat one"
        raise MeshError(msg)
    return np.ascontiguousarray(array, dtype=np.int32)


def _faces_across(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    n = int(faces.max()) + 1
    _, undirected, n_faces = np.unique(
        np.minimum(start, end) * n + np.maximum(start, end), return_inverse=True, return_counts=True
    )
    n_open, n_crowded = int((n_faces == 1).sum()), int((n_faces > 2).sum())
    n_flipped = int(
        (n_faces == 2).sum() - (np.bincount(undirected, weights=np.sign(end - start)) == 0)[n_faces == 2].sum()
    )
    if n_open or n_crowded or n_flipped:
        msg = (
            f"a signed distance needs a watertight body: {n_open} open edges, {n_crowded} edges of more than two faces "
            f"and {n_flipped} edges whose two faces face opposite ways; close the mesh and orient its faces outward"
        )
        raise MeshError(msg)
    # Every edge now has exactly two half-edges: sorting by edge puts partners side by side.
    order = np.argsort(undirected, kind="stable").reshape(-1, 2)
    across = np.empty(len(start), np.int32)
    across[order[:, 0]], across[order[:, 1]] = order[:, 1] // 3, order[:, 0] // 3
    return across.reshape(-1, 3)


def _fans(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    flat = faces.ravel()
    start = np.concatenate(([0], np.cumsum(np.bincount(flat)))).astype(np.int32)
    return start, (np.argsort(flat, kind="stable") // 3).astype(np.int32)
