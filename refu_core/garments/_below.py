"""The skin below a garment: where it gives way, the cloth on it goes along."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from refu_core._warp import Repeated, is_plain, strips
from refu_core.body import SmplBody
from refu_core.garments._below_kernels import N_BELOW, Vertices, Weights, follow_kernel
from refu_core.garments._template import GarmentTemplate

_WIDTH = 0.01
"""How much farther than the nearest one these may be to count for much [m]: the length of a body's shorter edges."""


@dataclass(frozen=True, eq=False)
class SkinBelow:
    """What of the skin each vertex of a garment lies on.

    A collider pulls limbs apart that run through each other: a flank gives way to an arm by centimetres. Cloth that was
    predicted for the skin would be left behind in the middle of the arm, where the way out of one vertex is in front
    and that of the next one behind. So it moves as the skin below it does, before it is brought off anything.
    """

    vertex: Tensor
    """Vertices of the body, int32, shape (N, K)."""
    weight: Tensor
    """How much each of them counts; rows sum to one, shape (N, K)."""

    @classmethod
    def of(cls, garment: GarmentTemplate, body: SmplBody) -> SkinBelow:
        """From both in their rest poses; on the body's device and in its precision."""
        tree = cKDTree(body.v_template.detach().cpu().double().numpy())
        found, vertex = tree.query(garment.v_template.detach().cpu().double().numpy(), N_BELOW)
        distance = torch.from_numpy(found)
        weight = torch.softmax((distance[:, :1] ** 2 - distance**2) / (2 * _WIDTH**2), dim=1)
        return cls(torch.from_numpy(vertex).int().to(body.device), weight.to(body.v_template))

    def __call__(self, shift: Tensor) -> Tensor:
        """How far cloth goes along [m], shape (B, N, 3), with skin that moves by `shift` (B, V, 3). Differentiable."""
        if is_plain(shift, self.weight) and len(shift):
            n_strips, each = strips(len(self.vertex), shift.device)
            cloth = torch.empty(len(shift), len(self.vertex), 3, device=shift.device)
            _follow((len(shift), n_strips), self.vertex, self.weight, shift.contiguous(), each, cloth)
            return cloth
        by_vertex = shift.transpose(0, 1).flatten(1)
        moved = functional.embedding_bag(self.vertex, by_vertex, mode="sum", per_sample_weights=self.weight)
        return moved.view(-1, *shift.shape[::2]).transpose(0, 1)


_follow = Repeated(follow_kernel, (Vertices, Weights, wp.vec3, wp.int32, wp.vec3))
