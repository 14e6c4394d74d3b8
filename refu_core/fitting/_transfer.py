"""Carries what a body's skin knows (skinning weights, shape directions) over to a garment around it.

After Abdrashitov, Raichstat, Monsen and Hill, *Robust Skin Weights Transfer via Weight Inpainting* (SIGGRAPH Asia 2023
Technical Communications): where the closest skin is near and faces the way the cloth does, its values are trusted; from
there they spread over the cloth. Here both steps are one equation. Trusted values count more the nearer they are:

    minimise  Σ mᵢ/ℓᵢ² ‖xᵢ - yᵢ‖² (trusted i) + xᵀ L x,    ℓᵢ = ℓ + dᵢ

with m a vertex's area, L the Laplacian of the cloth, y the skin's value and d the distance to it. So values are smooth
over a length ℓᵢ that grows with the distance: cloth on the skin follows it, a wide hem follows what it hangs round. L
has no negative weights: what lies between 0 and 1 stays there, and sums of 1 stay 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.spatial import cKDTree

from refu_core.fitting._clean import components, open_pieces, rim_vertices
from refu_core.fitting._mesh_file import F64, Ints
from refu_core.fitting._posed import PosedBody
from refu_core.mesh import symmetric_solver, vertex_areas, vertex_normals

_FARTHEST = 0.15
"""Skin farther off than this isn't trusted [m]."""
_FACING = 0.7
"""Least cosine between the cloth's normal and the way off the skin: 45°."""
_SEAM = 0.01
"""Rims of two pieces this near are sewn together [m]."""
_RIGID = 0.06
"""A piece no larger than this [m], beside larger ones, doesn't bend: a button, a buckle."""
_LEAST_TRUST = 1e-6
"""Trust in every other vertex, so that the equation has a unique solution."""
_OF_ITS_OWN = 0.05
"""A mesh, or a piece of one, of which less than this share is trusted has no skin of its own."""


@dataclass(frozen=True, eq=False)
class Transfer:
    """From the skin to a garment's V vertices."""

    face: Ints
    """The closest face of the body, shape (V,)."""
    barycentric: F64
    """Where in it, shape (V, 3)."""
    distance: F64
    """How far off the skin, negative inside [m], shape (V,)."""
    is_trusted: NDArray[np.bool_]
    """Whether that skin is near and faces the way the cloth does, shape (V,)."""
    body_faces: Ints
    mass: F64
    """Area of each vertex [m²], shape (V,)."""
    laplacian: csc_array
    """Shape (V, V)."""
    rigid: tuple[NDArray[np.intp], ...]
    """Vertices of the pieces that don't bend."""

    @classmethod
    def of(cls, vertices: F64, faces: Ints, body: PosedBody) -> Transfer:
        """For a garment of vertices (V, 3) [m] and faces (F, 3), outward, on a posed body."""
        distance, gradient = body(vertices)
        face, barycentric = body.closest(vertices)
        normals = vertex_normals(vertices, faces)
        agrees = (normals * gradient).sum(1)
        n_pieces, label = components(faces, len(vertices))
        rim = rim_vertices(faces)
        is_open = open_pieces(vertices, faces, label)
        # A closed piece is cloth with a thickness: its inner side faces the skin and follows it no less.
        agrees = np.where(is_open[label], agrees, np.abs(agrees))
        is_trusted = (agrees > _FACING) & (distance < _FARTHEST)
        if is_trusted.mean() < _OF_ITS_OWN:  # ruffles all over, or a single strap: the nearest skin is all there is
            is_trusted = np.abs(distance) <= max(np.quantile(np.abs(distance), 0.5), 0.02)
        sizes = [np.linalg.norm(np.ptp(vertices[label == k], axis=0)) for k in range(n_pieces)]
        is_rigid = np.array(sizes) < _RIGID
        is_rigid &= not is_rigid.all()
        rigid = tuple(np.flatnonzero(label == k) for k in np.flatnonzero(is_rigid))
        trusted = np.bincount(label, is_trusted) / np.bincount(label)
        is_led = (trusted < _OF_ITS_OWN) | is_rigid
        laplacian = _laplacian(vertices, faces, _seams(vertices, label, rim, is_led))
        body_faces = body.body.faces.numpy()
        return cls(face, barycentric, distance, is_trusted, body_faces, vertex_areas(vertices, faces), laplacian, rigid)

    def __call__(self, values: F64, *, length: float) -> F64:
        """Values at the body's vertices (N, K), carried to the garment's (V, K), smooth over at least `length` [m]."""
        corners = values[self.body_faces[self.face]]
        there = (self.barycentric[:, :, None] * corners).sum(1)
        reach = length + np.abs(self.distance)
        trust = np.where(self.is_trusted, 1.0, _LEAST_TRUST) * np.maximum(self.mass, 1e-12) / reach**2
        # Columns without any value, as of joints far away, needn't be solved for.
        some = np.flatnonzero(there.any(0))
        found = np.zeros((len(there), values.shape[1]))
        if len(some):
            solve = symmetric_solver(self.laplacian + diags_array(trust))
            found[:, some] = solve(trust[:, None] * there[:, some])
        for piece in self.rigid:
            found[piece] = found[piece].mean(0)
        return found


def _laplacian(v: F64, f: Ints, seams: Ints) -> csc_array:
    """Cotangents where they are positive, a tenth of an equilateral triangle's elsewhere; seams as firm as edges."""
    starts, ends, opposite = f.T, np.roll(f, -1, axis=1).T, np.roll(f, 1, axis=1).T
    u, w = v[starts] - v[opposite], v[ends] - v[opposite]
    cotangent = (u * w).sum(2) / np.maximum(np.linalg.norm(np.cross(u, w), axis=2), 1e-12)
    weight = np.append(0.5 * np.clip(cotangent, 0.06, 10.0), np.ones(len(seams)))
    pairs = np.append(starts, seams[:, 0]), np.append(ends, seams[:, 1])
    adjacent = coo_array((weight, pairs), shape=(len(v), len(v))).tocsr()
    adjacent = adjacent + adjacent.T
    return csc_array(diags_array(adjacent.sum(axis=1)) - adjacent)


def _seams(v: F64, label: Ints, rim: Ints, is_led: NDArray[np.bool_]) -> Ints:
    """Pairs of vertices that move together: touching rims of two pieces, and each piece that is led with the nearest.

    Pieces with skin of their own aren't tied to each other: two gloves follow two hands.
    """
    found = [np.empty((0, 2), np.int64)]
    if len(rim) and len(is_led) > 1:
        close: Any = cKDTree(v).query_ball_point(v[rim], _SEAM)
        near = [(a, b) for a, others in zip(rim.tolist(), close, strict=True) for b in others if label[a] != label[b]]
        found.append(np.array(near, np.int64).reshape(-1, 2))
    size = np.bincount(label)
    joined = ~is_led[label]
    for piece in np.argsort(np.where(is_led, size, 0))[::-1][: is_led.sum()]:
        own = np.flatnonzero(label == piece)
        others = np.flatnonzero(joined)
        if len(others):
            distance, nearest = (np.asarray(one) for one in cKDTree(v[others]).query(v[own]))
            few = np.argsort(distance)[:3]
            found.append(np.stack((own[few], others[nearest[few]]), 1))
        joined |= label == piece
    return np.unique(np.sort(np.concatenate(found), 1), axis=0)
