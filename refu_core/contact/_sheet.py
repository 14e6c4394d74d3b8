"""A mesh whose triangles a garment is brought off: a garment below it, or the body, in the pose that came last."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Recorded, Unpicklable, as_warp, ints, memory, torch_stream
from refu_core.contact import _layers_kernels as kernels
from refu_core.mesh import Connectivity


class Sheet(Unpicklable):
    """A mesh as kernels read it: places, box, tree and normals. These last three follow a pose when asked for."""

    def __init__(self, mesh: Connectivity, rest: Tensor) -> None:
        """For a mesh with vertices (U, 3) [m] in the rest pose."""
        self.mesh = mesh
        self.vertices = memory(*rest.shape, device=rest.device).copy_(rest.detach())
        """[m], shape (U, 3)."""
        self._normals = torch.empty_like(self.vertices)
        self._extent = memory(2, 3, device=rest.device)
        self.data = data = kernels.Below()
        """The mesh as kernels read it; `fit` its box and tree and `point_out` its normals before they are needed."""
        data.points, data.normals, data.extent = (
            as_warp(tensor, wp.vec3) for tensor in (self.vertices, self._normals, self._extent)
        )
        data.cut = cut_of(mesh, rest.device)
        self._tree = wp.Mesh(data.points, data.cut.faces.flatten())
        data.tree = self._tree.id
        self._has_late_tree = self._has_late_normals = True
        arrays = [data.points, data.cut, data.normals]
        self._normals_of = Recorded(kernels.normals_kernel, len(self.vertices), arrays, rest.device)

    def take(self, vertices: Tensor) -> None:
        """Takes over a pose, (U, 3) [m]."""
        with torch_stream(self.vertices.device):
            self.vertices.copy_(vertices)
        self._has_late_tree = self._has_late_normals = True

    def fit(self) -> None:
        """Fits box and tree to the pose, once."""
        if self._has_late_tree:
            with torch_stream(self.vertices.device):
                torch.aminmax(self.vertices, dim=0, out=(self._extent[0], self._extent[1]))
                self._tree.refit()
            self._has_late_tree = False

    def point_out(self) -> None:
        """Computes the pose's normals, once."""
        if self._has_late_normals:
            with torch_stream(self.vertices.device):
                self._normals_of.launch()
            self._has_late_normals = False


def cut_of(mesh: Connectivity, device: torch.device) -> Any:
    """A mesh as the kernels read it."""
    open_edge = (mesh.n_faces_of_edge == 1)[mesh.edge_of_corner]
    open_vertex = np.isin(mesh.faces, mesh.boundary)
    cut = kernels.Cut()
    cut.faces = ints(mesh.faces, device)
    cut.rim = ints(np.concatenate((open_vertex, open_edge), axis=1) @ (1 << np.arange(1, 7)), device)
    cut.fan_start, cut.fan_face = (ints(array, device) for array in mesh.fan)
    cut.ring_start, cut.ring = (ints(array, device) for array in mesh.ring)
    return cut
