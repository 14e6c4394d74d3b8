"""Frequency division (Patel et al. 2020): what Laplacian smoothing leaves of a garment, and what it takes away."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity

STEPS = 80
STEP_SIZE = 0.15


class LaplacianSmoothing:
    """Moves vertices towards the mean of their neighbours; those at a border along the border only.

    All garments are smoothed unposed, even the skirt, which the original smooths posed. So smoothing is one linear map
    of displacements, and can be applied to a basis of them instead of to every sample.
    """

    def __init__(self, garment: GarmentTemplate) -> None:
        self._map = _one_step(garment.mesh)

    def __call__(self, vertices: Tensor) -> Tensor:
        """Smoothed vertices [m] of the same shape (..., V, 3)."""
        return self._apply(self._map, vertices.detach().cpu().movedim(-2, 0)).movedim(0, -2).to(vertices)

    def transposed(self, components: Tensor) -> Tensor:
        """`components` @ S of the same shape (R, 3 V), where S smooths: (components @ S) @ x = components @ (S x)."""
        columns = components.detach().cpu().view(len(components), -1, 3).movedim(-2, 0)
        smoothed = self._apply(sparse.csr_array(self._map.T), columns)
        return smoothed.movedim(0, -2).reshape(components.shape).to(components)

    def _apply(self, matrix: sparse.csr_array, columns: Tensor) -> Tensor:
        x = columns.double().numpy().reshape(len(columns), -1)
        for _ in range(STEPS):
            x = matrix @ x
        return torch.as_tensor(x).view(columns.shape)


def _one_step(mesh: Connectivity) -> sparse.csr_array:
    n_vertices = mesh.n_vertices
    border = np.zeros(n_vertices, bool)
    border[mesh.boundary] = True
    ends = np.concatenate((mesh.edges, mesh.edges[:, ::-1]))
    along = np.tile(mesh.n_faces_of_edge == 1, 2)
    ends = ends[along | ~border[ends[:, 0]]]  # row: the vertex that moves, column: a neighbour that it listens to
    links = sparse.csr_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n_vertices, n_vertices))
    mean = sparse.diags_array(1 / np.maximum(links.sum(1), 1)) @ links
    eye = sparse.eye_array(n_vertices)
    listens = sparse.diags_array((links.sum(1) > 0).astype(float))
    return sparse.csr_array(eye + STEP_SIZE * (mean - listens))
