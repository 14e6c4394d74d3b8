"""Closest points on the surface of a mesh, such as a body's."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import Unpicklable, ints
from refu_core.body._part_kernels import nearest_kernel
from refu_core.mesh import vertex_normals


class OnSurface(NamedTuple):
    """Points of a surface."""

    face: NDArray[np.int64]
    """Shape (N,)."""
    weight: NDArray[np.float64]
    """Barycentrics at the face's vertices 0, 1, 2; rows sum to one, shape (N, 3)."""

    def of(self, values: NDArray[Any], faces: NDArray[np.integer]) -> NDArray[np.float64]:
        """`values` (V, …) of the vertices of a surface of these `faces` (F, 3), interpolated at the points (N, …)."""
        return np.asarray(np.einsum("nk,nk...->n...", self.weight, values[faces[self.face]]))


class Surface(Unpicklable):
    """A triangle mesh that finds its points closest to others, on the CPU."""

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
        """From vertices (V, 3) [m] and faces (F, 3)."""
        self.vertices, self.faces = vertices, faces
        self.normals = vertex_normals(vertices, faces)
        """Unit normals at the vertices, shape (V, 3)."""
        points = wp.array(vertices.astype(np.float32), dtype=wp.vec3, device="cpu")
        self._tree = wp.Mesh(points, ints(faces.ravel(), "cpu"))

    def closest(self, points: NDArray[np.float64]) -> OnSurface:
        """The points of the surface that are closest to points (N, 3) [m]."""
        n = len(points)
        face, weight = wp.zeros(n, dtype=wp.int32, device="cpu"), wp.zeros(n, dtype=wp.vec3, device="cpu")
        asked = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
        wp.launch(nearest_kernel, n, [self._tree.id, asked], [face, weight], device="cpu")
        return OnSurface(face.numpy().astype(np.int64), weight.numpy().astype(np.float64))

    def at(self, found: OnSurface, values: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """`values` of the vertices (V, …), by default their places [m], interpolated at surface points (N, …)."""
        return found.of(self.vertices if values is None else values, self.faces)

    def heights(self, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distances (N,) of points near the surface [m], and the unit directions away from it (N, 3)."""
        found = self.closest(points)
        away = points - self.at(found)
        normal = self.at(found, self.normals)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        side = np.where((away * normal).sum(1) < 0, -1.0, 1.0)
        length = np.linalg.norm(away, axis=1)
        direction = np.where(length[:, None] > 1e-5, side[:, None] * away / np.maximum(length, 1e-12)[:, None], normal)
        return side * length, direction
