"""Pushed vertices take their neighbours along, so that cloth gives way as cloth and not vertex by vertex."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from refu_core.errors import MeshError

BLEND_REACH = 2
"""How far the neighbourhood reaches that gives way with a pushed vertex [edges]. What is farther off has no share in
the collision, and moving it makes it no truer."""
BLEND_STEPS = (3.0, 0.75) * 3
"""How far each sweep goes towards the mean of the neighbours: pairs of a long step, which levels what is wide, and a
short one, which levels the ripples that the long one overdoes (Richardson's method). Six of them do what twelve plain
means do. On a mesh of triangles a pair leaves no more than 0.6 of any ripple."""


@dataclass(frozen=True, eq=False)
class Blend:
    """Spreads the pushes of some vertices over the garment's mesh.

    Vertices pushed one by one to the margin lie flat on it, and are torn from neighbours that were just outside: folds
    are lost, and the edges between cut through the skin. So the displacement is made smooth, under the condition that
    every vertex goes at least as far along its gradient as it has to: a few sweeps of averaging for the smoothest field
    with nᵢᵀdᵢ ≥ pᵢ. It is the smoothness term of DRAPE's optimisation (Guan et al. 2012) at a few averages' price.

    A predicted scale says how far to go, and may say farther than to the margin. From there the field begins; but pᵢ is
    no more than the way to the margin. What α exceeds 1 by differs from neighbour to neighbour (by a twentieth): held
    as a bound it would be printed into the cloth, millimetres high.
    """

    neighbours: Tensor
    """The neighbours of each vertex along edges, one vertex after another, int64, shape (2 E,)."""
    start: Tensor
    """Where in `neighbours` each vertex's begin, int64, shape (N,)."""
    share: Tensor
    """One divided by their number, shape (N, 1)."""

    @classmethod
    def of_faces(cls, faces: Tensor, n_vertices: int) -> Blend:
        """For garments of these `faces`, shape (G, 3), and `n_vertices` N.

        Raises:
            MeshError: A face that names a vertex there isn't.
        """
        corners = faces.cpu().numpy()
        if corners.ndim != 2 or corners.shape[1] != 3 or not ((corners >= 0) & (corners < n_vertices)).all():
            msg = f"faces must be triangles of {n_vertices} vertices, got {corners.shape} of {corners.max(initial=-1)}"
            raise MeshError(msg)
        half_edges = np.concatenate([corners[:, [a, b]] for a in range(3) for b in range(3) if a != b])
        here, there = np.unique(half_edges, axis=0).T
        start = np.searchsorted(here, np.arange(n_vertices))
        number = np.diff(start, append=len(here))[:, None]
        return cls(
            torch.as_tensor(there.astype(np.int64), device=faces.device),
            torch.as_tensor(start, device=faces.device),
            torch.as_tensor((1 / np.maximum(number, 1)).astype(np.float32), device=faces.device),
        )

    def mean(self, field: Tensor) -> Tensor:
        """Mean of each vertex's neighbours, shape (N, C), of a field of the same shape; zero where there are none."""
        total = functional.embedding_bag(self.neighbours, field, self.start, mode="sum")
        return total * self.share.to(field)

    def spread(
        self,
        push: Tensor,
        *,
        least: Tensor | None = None,
        steps: Sequence[float] = BLEND_STEPS,
        reach: int = BLEND_REACH,
    ) -> Tensor:
        """Displacements [m], shape (N, B, 3), smooth and nowhere less along the pushes of the same shape than wanted.

        Differentiable. N vertices of B garments.

        Args:
            push: Where to begin [m]; zero is no push.
            least: How far each vertex has to go along its push, if that goes so far [m], shape (N, B); by default as
                far as it goes.
            steps: How far each sweep goes towards the mean of the neighbours; 1 is all the way.
            reach: How many edges from a pushed vertex others give way.
        """
        is_pushed = (push.detach() != 0).any(dim=-1)
        gives_way = is_pushed.to(push)
        for _ in range(reach):
            gives_way = ((gives_way > 0) | (self.mean(gives_way) > 0)).to(push)
        # Vertices without a push have no direction, and lack nothing.
        rows = torch.nonzero(is_pushed.any(dim=1))[:, 0]
        pushed = push[rows]
        length = torch.linalg.vector_norm(pushed, dim=-1, keepdim=True)
        direction = pushed / length.clamp_min(torch.finfo(push.dtype).tiny ** 0.5)
        if least is not None:
            length = torch.minimum(length, least[rows].unsqueeze(-1))
        field = push
        for step in steps:
            mean = self.mean(field.flatten(1)).view_as(push) * gives_way.unsqueeze(-1)
            field = field + step * (mean - field)
            lack = (length - (field[rows] * direction).sum(-1, keepdim=True)).clamp_min(0)
            field = field.index_add(0, rows, lack * direction)
        return field
