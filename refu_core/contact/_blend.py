"""Pushed vertices take their neighbours along, so that cloth gives way as cloth, not vertex by vertex."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from refu_core.contact._settings import DEFAULT_CONTACT
from refu_core.mesh import Connectivity
from refu_core.refu import unit_direction
from refu_core.sdf import SdfSample

_STEPS = DEFAULT_CONTACT.blend_steps * (DEFAULT_CONTACT.around // 2)


@dataclass(frozen=True, eq=False)
class Blend:
    """Spreads the pushes of some vertices over the garment's mesh, so that folds stay.

    A few sweeps average towards the smoothest displacements d with nᵢᵀdᵢ ≥ pᵢ, the smoothness term of DRAPE (Guan et
    al. 2012). They begin with pushes of the predicted scale, which may lead beyond the margin. The bound pᵢ is no more
    than the way to the margin: α differs from neighbour to neighbour, and as a bound would print noise into the cloth.
    """

    neighbours: Tensor
    """The neighbours of each vertex along edges, one vertex after another, int64, shape (2 E,)."""
    start: Tensor
    """Where in `neighbours` those of each vertex begin, int64, shape (N,)."""
    share: Tensor
    """One divided by the number of neighbours, shape (N, 1)."""

    @classmethod
    def of_faces(cls, faces: Tensor, n_vertices: int) -> Blend:
        """For garments of `faces` (G, 3) and `n_vertices` N. Raises `MeshError` for a face that names no vertex."""
        ring = Connectivity.of(faces.cpu(), n_vertices).ring
        number = np.diff(ring.start)[:, None]
        return cls(
            torch.as_tensor(ring.items.astype(np.int64), device=faces.device),
            torch.as_tensor(ring.start[:-1].astype(np.int64), device=faces.device),
            torch.as_tensor((1 / np.maximum(number, 1)).astype(np.float32), device=faces.device),
        )

    def mean(self, field: Tensor) -> Tensor:
        """Mean of each vertex's neighbours, shape (N, C), of a field of the same shape; zero where there are none."""
        total = functional.embedding_bag(self.neighbours, field, self.start, mode="sum")
        return total * self.share.to(field)

    def follow(self, points: Tensor, pushed: Tensor, sample: SdfSample, margin: float) -> Tensor:
        """Garments [m], shape (B, N, 3): the neighbours of the vertices that ReFU `pushed` follow them.

        Differentiable.

        Args:
            points: Before the push [m], shape (B, N, 3).
            pushed: After it [m], shape (B, N, 3).
            sample: Distances (B, N) [m] and gradients (B, N, 3) that they were pushed by, to the `margin` [m].
        """
        push, least = (pushed - points).transpose(0, 1), (margin - sample.distance).clamp_min(0).T
        along = unit_direction(sample.gradient.detach()).transpose(0, 1)
        field = self.spread(push, least=least, along=along).transpose(0, 1)
        length = torch.linalg.vector_norm(field.detach(), dim=-1, keepdim=True)
        most = DEFAULT_CONTACT.max_displacement
        blended: Tensor = points + field * (most / length.clamp_min(most))
        return blended

    def spread(
        self,
        push: Tensor,
        *,
        least: Tensor | None = None,
        along: Tensor | None = None,
        steps: Sequence[float] = _STEPS,
        reach: int = DEFAULT_CONTACT.near,
    ) -> Tensor:
        """Smooth displacements [m], shape (N, B, 3), that go at least as far along each push as wanted. Differentiable.

        Args:
            push: The displacements to begin with [m]; zero is no push.
            least: How far each vertex has to go along its push, but no farther than the push itself [m], shape (N, B);
                by default as far as the push.
            along: The directions of the pushes, unit vectors that count as constant, shape (N, B, 3); by default those
                of the pushes themselves, whose derivative is endless where a push is next to nothing.
            steps: How far each sweep goes towards the mean of the neighbours; 1 is all the way.
            reach: Up to how many edges from a pushed vertex others give way.
        """
        is_pushed = (push.detach() != 0).any(dim=-1)
        gives_way = is_pushed.to(push)
        for _ in range(reach):
            gives_way = ((gives_way > 0) | (self.mean(gives_way) > 0)).to(push)
        # Vertices without a push have no direction, and lack nothing.
        rows = torch.nonzero(is_pushed.any(dim=1))[:, 0]
        pushed = push[rows]
        if along is None:
            length = torch.linalg.vector_norm(pushed, dim=-1, keepdim=True)
            direction = pushed / length.clamp_min(torch.finfo(push.dtype).tiny ** 0.5)
        else:
            direction = along[rows] * is_pushed[rows].unsqueeze(-1)
            length = (pushed * direction).sum(-1, keepdim=True)
        if least is not None:
            length = torch.minimum(length, least[rows].unsqueeze(-1))
        field = push
        for step in steps:
            mean = self.mean(field.flatten(1)).view_as(push) * gives_way.unsqueeze(-1)
            field = field + step * (mean - field)
            lack = (length - (field[rows] * direction).sum(-1, keepdim=True)).clamp_min(0)
            field = field.index_add(0, rows, lack * direction)
        return field
