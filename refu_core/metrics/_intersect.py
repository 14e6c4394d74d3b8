"""All pairs of intersecting triangles of two meshes: of a body and a garment, of garments, of one with itself."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import as_warp
from refu_core.mesh import as_points, check_faces, grouped
from refu_core.metrics._intersect_kernels import intersect_kernel
from refu_core.sdf._crossing_kernels import BLOCK


class Crossings(NamedTuple):
    """Every intersecting pair of a mesh's faces and the body's."""

    pairs: NDArray[np.int32]
    """(face, body face), shape (K, 2), in lexicographic order."""
    edge_of_face: NDArray[np.bool_]
    """Which edges (0, 1), (1, 2), (2, 0) of the face pierce the body face, shape (K, 3)."""
    edge_of_body: NDArray[np.bool_]
    """Which edges of the body face pierce the face, shape (K, 3)."""


def as_vertices(name: str, values: Any) -> NDArray[np.float32]:
    """`values` (numpy or torch) as a contiguous, finite float32 array, shape (N, 3)."""
    return as_points(name, values, dtype=np.float32)


class Triangles:
    """A mesh's faces, (G, 3), prepared to be looked at in blocks of neighbours."""

    def __init__(self, faces: NDArray[np.int32], vertices: NDArray[np.float32]) -> None:
        """`vertices` [m], shape (N, 3), decide which faces are neighbours, in this pose and mostly in others.

        That affects only the speed.
        """
        self.faces = faces
        order = grouped(vertices[faces].mean(axis=1)) if len(faces) else np.empty(0, np.int64)
        self.blocks = torch.as_tensor(faces[order])
        self.numbers = torch.as_tensor(order.astype(np.int32))


def crossings(mesh_id: int, vertices: NDArray[np.float32], triangles: Triangles, *, is_body: bool = False) -> Crossings:
    """The crossings of a mesh, with vertices (N, 3) [m], and the body, Warp's mesh number `mesh_id`.

    With `is_body` the mesh is that body: each pair is given once, faces that share an edge are left out, and
    faces that share a vertex are given only if they meet elsewhere, too.
    """
    points = torch.as_tensor(vertices)
    n_faces = len(triangles.faces)
    count = torch.zeros(1, dtype=torch.int32)
    room = max(1024, n_faces)
    while True:
        found = torch.empty(room, 3, dtype=torch.int32)
        count.zero_()
        wp.launch(
            intersect_kernel,
            dim=-(-n_faces // int(BLOCK)),
            inputs=[
                mesh_id,
                as_warp(points, wp.vec3),
                as_warp(triangles.blocks, wp.vec3i),
                as_warp(triangles.numbers, wp.int32),
                is_body,
            ],
            outputs=[as_warp(count, wp.int32), as_warp(found, wp.vec3i)],
            device="cpu",
        )
        n = int(count)
        if n <= room:
            break
        room = n  # too little room: once more, with room for all
    rows = found[:n].numpy()
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    bits = (rows[:, 2:] >> np.arange(6)) & 1 == 1
    return Crossings(np.ascontiguousarray(rows[:, :2]), bits[:, :3], bits[:, 3:])


class SheetChecker:
    """A garment as an open sheet: where it cuts through itself or another one."""

    def __init__(self, faces: Any) -> None:
        """For a garment of these faces, shape (G, 3). Raises `MeshError` as `check_faces`."""
        self.faces = check_faces(faces)
        self._flat = torch.from_numpy(self.faces.reshape(-1).copy())
        self._points = torch.zeros(0, 3)
        self._mesh: Any = None
        self._triangles: Triangles | None = None

    def update(self, vertices: Any) -> None:
        """Takes over a garment's vertices [m], shape (N, 3). Raises `MeshError` for others, or faces beyond them."""
        points = as_vertices("the garment's vertices", vertices).copy()
        check_faces(self.faces, n_vertices=len(points))
        self._points = torch.from_numpy(points)
        self._mesh = wp.Mesh(as_warp(self._points, wp.vec3), as_warp(self._flat, wp.int32))

    def with_itself(self) -> NDArray[np.int32]:
        """The pairs of its faces that intersect, shape (K, 2); meeting at a shared edge or vertex doesn't count."""
        points = self._points.numpy()
        self._triangles = self._triangles or Triangles(self.faces, points)
        return crossings(self._mesh.id, points, self._triangles, is_body=True).pairs

    def with_other(self, vertices: Any, faces: Any) -> NDArray[np.int32]:
        """Intersecting pairs (other's face, own face), shape (K, 2), with a garment of `vertices` and `faces`.

        The garment is (M, 3) [m] and (F, 3). Raises `MeshError` for other arrays.
        """
        other = as_vertices("the other garment's vertices", vertices)
        triangles = Triangles(check_faces(faces, n_vertices=len(other)), other)
        return crossings(self._mesh.id, other, triangles).pairs
