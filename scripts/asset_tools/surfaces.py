"""Small functions on triangle meshes given as vertices (V, 3) [m] and faces (F, 3)."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import trimesh
from numpy.typing import NDArray

from refu_core.mesh import Connectivity
from refu_core.metrics import SheetChecker

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]


def directed_edges(f: Faces) -> NDArray[np.int64]:
    """The three edges of every face in its direction, shape (3 F, 2)."""
    return f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def boundary_loops(f: Faces) -> list[NDArray[np.int64]]:
    """The closed boundaries, as vertices in the direction of their faces; the longest first."""
    edges = {(int(a), int(b)) for a, b in directed_edges(f)}
    after = {a: b for a, b in edges if (b, a) not in edges}
    loops = []
    while after:
        start, vertex = after.popitem()
        loop = [start]
        while vertex != start:
            loop.append(vertex)
            vertex = after.pop(vertex)
        loops.append(np.array(loop))
    return sorted(loops, key=lambda loop: (-len(loop), loop.min()))


def compact(f: Faces) -> tuple[NDArray[np.int64], Faces]:
    """The vertices that faces use, and the faces as indices into these."""
    used, local = np.unique(f, return_inverse=True)
    return used, local.reshape(-1, 3)


def smoothing_matrix(f: Faces, n: int) -> scipy.sparse.csr_matrix:
    """The matrix that takes the mean of the neighbours; on a boundary, of the two neighbours along it. Shape (n, n)."""
    mesh = Connectivity.of(f, n)
    border, edges = mesh.boundary, np.concatenate((mesh.edges, mesh.edges[:, ::-1]))
    inner = edges[~np.isin(edges[:, 0], border)]
    rows, columns = np.concatenate((inner, border, border[:, ::-1])).T
    matrix = scipy.sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    return scipy.sparse.csr_matrix(scipy.sparse.diags(1 / np.asarray(matrix.sum(1)).ravel()) @ matrix)


def attach(points: Vertices, v: Vertices, f: Faces) -> scipy.sparse.csr_matrix:
    """Barycentric weights of the mesh's closest points: a matrix (P, V) that takes vertex attributes to the points."""
    mesh = trimesh.Trimesh(v, f, process=False)
    closest, _, face = trimesh.proximity.closest_point(mesh, points)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], closest).clip(0, 1)
    weights /= weights.sum(1, keepdims=True)
    rows = np.repeat(np.arange(len(points)), 3)
    return scipy.sparse.csr_matrix((weights.ravel(), (rows, f[face].ravel())), shape=(len(points), len(v)))


def self_intersections(v: Vertices, f: Faces) -> NDArray[np.int32]:
    """Pairs of faces that share no vertex and cross, shape (pairs, 2)."""
    checker = SheetChecker(f)
    checker.update(v)
    pairs = checker.with_itself()
    return pairs[~(f[pairs[:, 0]][:, :, None] == f[pairs[:, 1]][:, None]).any((1, 2))]
