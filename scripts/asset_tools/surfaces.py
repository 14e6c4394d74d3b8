"""Small questions about triangle meshes given as vertices (V, 3) [m] and faces (F, 3)."""

from __future__ import annotations

import numpy as np
import scipy.sparse
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]


def vertex_areas(v: Vertices, f: Faces) -> NDArray[np.float64]:
    """A third of the area of a vertex's faces [m²], shape (V,)."""
    area = np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1) / 2
    return np.bincount(f.ravel(), np.repeat(area / 3, 3), len(v))


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
    """The vertices that faces use, and the faces in their numbering."""
    used, local = np.unique(f, return_inverse=True)
    return used, local.reshape(-1, 3)


def corner_angles(v: Vertices, f: Faces) -> NDArray[np.float64]:
    """Angles of the faces at their corners [degrees], shape (F, 3)."""
    angles = np.empty(f.shape)
    for k in range(3):
        a, b = v[f[:, (k + 1) % 3]] - v[f[:, k]], v[f[:, (k + 2) % 3]] - v[f[:, k]]
        angles[:, k] = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("fk,fk->f", a, b))
    return np.degrees(angles)


def edge_lengths(v: Vertices, f: Faces) -> NDArray[np.float64]:
    """Length of every edge, once [m]."""
    edges = np.unique(np.sort(directed_edges(f), 1), axis=0)
    return np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1)


def vertex_normals(v: Vertices, f: Faces) -> Vertices:
    """Area-weighted unit normals, shape (V, 3)."""
    area = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    total = np.stack([np.bincount(f.ravel(), np.repeat(area[:, k], 3), len(v)) for k in range(3)], 1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def smoothing_matrix(f: Faces, n: int) -> scipy.sparse.csr_matrix:
    """Mean of the neighbours; on a boundary, of the two neighbours along it. Shape (n, n)."""
    edges = {(int(a), int(b)) for a, b in directed_edges(f)}
    border = {(a, b) for a, b in edges if (b, a) not in edges}
    on_border = {a for a, _ in border}
    both = {(a, b) for a, b in edges if a not in on_border} | {(b, a) for a, b in edges if b not in on_border}
    both |= border | {(b, a) for a, b in border}
    pairs = np.array(sorted(both))
    matrix = scipy.sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return scipy.sparse.csr_matrix(scipy.sparse.diags(1 / np.asarray(matrix.sum(1)).ravel()) @ matrix)


def attach(points: Vertices, v: Vertices, f: Faces) -> scipy.sparse.csr_matrix:
    """Barycentrics of the mesh's closest points: a matrix (P, V) that takes any vertex attribute to the points."""
    mesh = trimesh.Trimesh(v, f, process=False)
    closest, _, face = trimesh.proximity.closest_point(mesh, points)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], closest).clip(0, 1)
    weights /= weights.sum(1, keepdims=True)
    rows = np.repeat(np.arange(len(points)), 3)
    return scipy.sparse.csr_matrix((weights.ravel(), (rows, f[face].ravel())), shape=(len(points), len(v)))


def self_intersections(v: Vertices, f: Faces) -> NDArray[np.int64]:
    """Pairs of faces that share no vertex and cross, shape (pairs, 2)."""
    corners = v[f]
    centre = corners.mean(1)
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max(1)
    # Few large faces would make every search wide: size classes keep the candidates few.
    order = np.argsort(reach)
    found = []
    for part in np.array_split(order, 8):
        tree = cKDTree(centre[part])
        smaller = np.flatnonzero(reach <= reach[part].max())
        for i, close in zip(
            smaller, tree.query_ball_point(centre[smaller], reach[smaller] + reach[part].max()), strict=True
        ):
            if close:
                others = part[close]
                found.append(np.stack([np.full(len(others), i), others], 1))
    pairs = np.unique(np.sort(np.concatenate(found), 1), axis=0)
    pairs = pairs[np.linalg.norm(centre[pairs[:, 0]] - centre[pairs[:, 1]], axis=1) <= reach[pairs].sum(1)]
    pairs = pairs[~(f[pairs[:, 0]][:, :, None] == f[pairs[:, 1]][:, None, :]).any((1, 2))]
    a, b = corners[pairs[:, 0]], corners[pairs[:, 1]]
    apart = ((a.min(1) > b.max(1)) | (b.min(1) > a.max(1))).any(1)
    pairs, a, b = pairs[~apart], a[~apart], b[~apart]
    crossing = np.zeros(len(pairs), bool)
    for k in range(3):
        crossing |= _segment_hits(a[:, k], a[:, (k + 1) % 3], b) | _segment_hits(b[:, k], b[:, (k + 1) % 3], a)
    return pairs[crossing]


def _segment_hits(start: Vertices, end: Vertices, triangle: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether segments cross triangles (N, 3, 3); Möller and Trumbore's test."""
    e1, e2 = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    direction = end - start
    p = np.cross(direction, e2)
    determinant = np.einsum("nk,nk->n", e1, p)
    safe = np.where(np.abs(determinant) > 1e-18, determinant, 1.0)
    offset = start - triangle[:, 0]
    u = np.einsum("nk,nk->n", offset, p) / safe
    q = np.cross(offset, e1)
    w = np.einsum("nk,nk->n", direction, q) / safe
    t = np.einsum("nk,nk->n", e2, q) / safe
    inside = (u >= 0) & (w >= 0) & (u + w <= 1) & (t >= 0) & (t <= 1)
    hits: NDArray[np.bool_] = inside & (np.abs(determinant) > 1e-18)
    return hits
