"""The skin below a garment: where it gives way, the cloth on it moves along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from refu_core._cache import remembered
from refu_core._warp import Repeated, is_plain, strips
from refu_core.body import ARMS, LEGS, SmplBody, joints_of, weight_of_parts
from refu_core.garments._below_kernels import N_BELOW, Vertices, Weights, follow_kernel
from refu_core.garments._template import GarmentTemplate

_WIDTH = 0.01
"""How much farther than a part's nearest vertex its other vertices may be and still count much [m]: the length of a
body's shorter edges."""
_PARTS = (joints_of("trunk", "head") + ARMS[0] + ARMS[1], *LEGS)
"""A skirt follows both legs, however near one of them is: cloth between them moves half way with each."""


@dataclass(frozen=True, eq=False)
class SkinBelow:
    """The skin that each vertex of a garment lies on.

    A collider pulls apart limbs that run through each other: a flank gives way to an arm by centimetres. Cloth that was
    predicted for the skin would be left behind in the middle of the arm, where one vertex's way out is in front and the
    next one's is behind. So the cloth first moves with the skin below it, before collisions are resolved.
    """

    vertex: Tensor
    """Vertices of the body, int32, shape (N, K)."""
    weight: Tensor
    """How much each of them counts; rows sum to one, shape (N, K)."""

    @classmethod
    def of(cls, garment: GarmentTemplate, body: SmplBody) -> SkinBelow:
        """From both in their rest poses; on the body's device and in its precision."""
        skin, cloth = (one.v_template.detach().cpu().double().numpy() for one in (body, garment))
        part_of = weight_of_parts(body.weights.cpu(), _PARTS).argmax(1).numpy()
        vertex, weight = _nearest(skin, cloth, part_of)
        return cls(torch.from_numpy(vertex).to(body.device), torch.from_numpy(weight).to(body.v_template))

    def mean(self, values: Tensor) -> Tensor:
        """The mean below each vertex of the cloth, shape (N,), of `values` of the skin's vertices (V,)."""
        return (values[self.vertex.long()] * self.weight).sum(1)

    def __call__(self, shift: Tensor) -> Tensor:
        """How far cloth moves [m], shape (B, N, 3), with skin that moves by `shift` (B, V, 3). Differentiable."""
        if is_plain(shift, self.weight):
            n_strips, each = strips(len(self.vertex), shift.device)
            cloth = shift.new_empty(len(shift), len(self.vertex), 3)
            _follow((len(shift), n_strips), self.vertex, self.weight, shift.contiguous(), each, cloth)
            return cloth
        by_vertex = shift.transpose(0, 1).flatten(1)
        moved = functional.embedding_bag(self.vertex, by_vertex, mode="sum", per_sample_weights=self.weight)
        return moved.view(len(self.vertex), len(shift), 3).transpose(0, 1)


@remembered(8)  # every pipeline of a garment asks for the same
def _nearest(
    skin: NDArray[np.float64], cloth: NDArray[np.float64], part_of: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """`vertex` and `weight` of a `SkinBelow`: of cloth (N, 3) over skin (V, 3) [m], each vertex of a part (V,)."""
    square, vertex = [], []
    for part in range(len(_PARTS)):
        (own,) = np.nonzero(part_of == part)
        distance, nearest = cKDTree(skin[own]).query(cloth, N_BELOW)
        square.append(torch.from_numpy(distance**2))
        vertex.append(torch.from_numpy(own[nearest]))
    # A part counts by its squared distance relative to that of the nearest part.
    nearest_of = torch.stack([one[:, 0] for one in square], 1)
    height = nearest_of.amin(1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
    by_part = (-2 * nearest_of / height).log_softmax(1)
    within = [((one[:, :1] - one) / (2 * _WIDTH**2)).log_softmax(1) for one in square]
    score = torch.cat([one + by_part[:, k, None] for k, one in enumerate(within)], 1)
    best, which = score.topk(N_BELOW, 1)
    return torch.cat(vertex, 1).gather(1, which).int().numpy(), best.softmax(1).numpy()


_follow = Repeated(follow_kernel, (Vertices, Weights, wp.vec3, wp.int32, wp.vec3))
