"""A smooth field over a garment, stored at some of its vertices: what few samples can tell needs no more numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.sparse.linalg import splu
from torch import Tensor

from refu_core.errors import WeightsError
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity

_HOLD = 100.0
"""How much more a control's own value weighs than the smoothness at a vertex."""
_NEVER_SINGULAR = 1e-9
"""Keeps the matrix from being singular: a piece of cloth without a control doesn't move."""


@dataclass(frozen=True, eq=False)
class Controls:
    """Vertices of a garment whose values determine those of all others, smoothly, as in a least-squares mesh.

    Sorkine and Cohen-Or (2004): each vertex is the mean of its neighbours, as far as the controls' values allow.
    """

    mesh: Connectivity
    """The garment's."""
    vertices: Tensor
    """Which of its vertices are controls, int32, shape (C,)."""

    @classmethod
    def of(cls, garment: GarmentTemplate, vertices: Tensor) -> Controls:
        """With these vertices (C,). Raises `WeightsError` unless they are vertices of the garment, each once."""
        numbers = vertices.tolist() if vertices.ndim == 1 and not vertices.is_floating_point() else []
        inside = bool(numbers) and 0 <= min(numbers) <= max(numbers) < garment.n_vertices
        if not inside or len(set(numbers)) < len(numbers):
            msg = f"wanted controls among the {garment.n_vertices} vertices of {garment.name}, each once, got "
            msg += f"{vertices.dtype} {tuple(vertices.shape)}: get the weights again"
            raise WeightsError(msg)
        return cls(garment.mesh, vertices.to(torch.int32))

    @classmethod
    def spread(cls, garment: GarmentTemplate, count: int) -> Controls:
        """`count` controls, each new one where it is farthest along the cloth from all before it."""
        points, (first, second) = garment.v_template.cpu().double().numpy(), garment.mesh.edges.T
        length = np.linalg.norm(points[first] - points[second], axis=1)
        graph = sparse.csr_array((length, (first, second)), (len(points), len(points)))
        chosen, way = [0], np.full(len(points), np.inf)
        while len(chosen) < min(count, len(points)):
            way = np.minimum(way, dijkstra(graph, directed=False, indices=[chosen[-1]])[0])
            chosen.append(int(way.argmax()))
        return cls(garment.mesh, torch.tensor(chosen, dtype=torch.int32))

    def __call__(self, values: Tensor) -> Tensor:
        """The field at all vertices, float32, shape (N, V, K), from its values at the controls (N, C, K)."""
        n_fields, n_controls, width = values.shape
        n, at = self.mesh.n_vertices, self.vertices.numpy()
        bend = self.mesh.uniform_laplacian()
        hold = np.full(n, _NEVER_SINGULAR)
        hold[at] += _HOLD
        known = np.zeros((n, n_fields * width))
        known[at] = _HOLD * values.detach().cpu().double().numpy().transpose(1, 0, 2).reshape(n_controls, -1)
        # The matrix is symmetric and positive; unless the solver is told so, its factors are several times as large.
        solver = splu(
            (bend.T @ bend + sparse.diags(hold)).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        field = torch.from_numpy(solver.solve(known)).float()
        return field.view(n, n_fields, width).transpose(0, 1).contiguous()

    def matrix(self) -> Tensor:
        """The weight of each control at each vertex, shape (V, C)."""
        return self(torch.eye(len(self.vertices))[None])[0]
