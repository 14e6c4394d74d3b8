"""Exact triangle-triangle checks of garments against themselves and each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import as_warp
from refu_core.metrics._intersect import Triangles, as_vertices, crossings


class SheetChecker:
    """A garment as an open sheet: where it cuts through itself or another one."""

    device = torch.device("cpu")

    def __init__(self, faces: Any) -> None:
        """For a garment of these faces, shape (G, 3)."""
        self.faces = np.ascontiguousarray(faces, dtype=np.int32)
        self._flat = torch.from_numpy(self.faces.reshape(-1).copy())
        self._points = torch.zeros(0, 3)
        self._mesh: Any = None
        self._triangles: Triangles | None = None

    @property
    def mesh_id(self) -> int:
        """Warp's handle of the mesh being checked."""
        return int(self._mesh.id)

    def update(self, vertices: Any) -> None:
        """Takes over a garment's vertices [m], shape (N, 3). Raises `MeshError` as `as_vertices`."""
        self._points = torch.from_numpy(as_vertices("the garment's vertices", vertices).copy())
        self._mesh = wp.Mesh(as_warp(self._points, wp.vec3), as_warp(self._flat, wp.int32))

    def with_itself(self) -> NDArray[np.int32]:
        """The pairs of its faces that intersect, shape (K, 2); neighbours may meet at an edge or vertex."""
        points = self._points.numpy()
        self._triangles = self._triangles or Triangles(self.faces, points, self.device)
        return crossings(self, points, self._triangles, is_body=True).pairs

    def with_other(self, vertices: Any, faces: Any) -> NDArray[np.int32]:
        """Intersecting (other's face, own face), shape (K, 2), of a garment (M, 3) [m] and (F, 3)."""
        other = as_vertices("the other garment's vertices", vertices)
        triangles = Triangles(np.ascontiguousarray(faces, dtype=np.int32), other, self.device)
        return crossings(self, other, triangles).pairs
