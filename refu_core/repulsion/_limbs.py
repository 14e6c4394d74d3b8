"""Which limb a garment vertex lies on, so that another limb can't pull the garment through itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.garments import unique_edges
from refu_core.repulsion._kernels import add_normals_kernel

_LIMBS: tuple[tuple[int, ...], ...] = (
    (0, 3, 6, 9, 12, 13, 14, 15),  # trunk and head
    (16, 18, 20, 22),  # left arm
    (17, 19, 21, 23),  # right arm
    (1, 2, 4, 5, 7, 8, 10, 11),  # both legs: a skirt lies on either
)
"""SMPL joints of each limb."""
_OWN = 0.02
"""A vertex lies on every limb that has more than this of its skinning weight: around the armpit, on trunk and arm."""
INWARD = 0.15
"""Share of vertices that a limb has to push inwards not to count as under the cloth."""
SIDEWAYS = -0.3
"""Cosine between push and outward normal above which a push leads around a limb, and no longer back from it."""


@dataclass(frozen=True, eq=False)
class Limbs:
    """The limbs of a body's faces and of a garment's vertices."""

    of_face: Tensor
    """Limb of each body face, int64, shape (F,)."""
    own: Tensor
    """Which limbs each garment vertex lies on, bool, shape (N, L)."""
    faces: Tensor
    """The garment's faces, counter-clockwise from outside, shape (G, 3)."""
    clearance: Tensor
    """How far off the skin the garment is cut [m], shape (N,): room that it can give way into."""

    @classmethod
    def of(
        cls,
        body_weights: Tensor,
        body_faces: Tensor,
        garment_weights: Tensor,
        garment_faces: Tensor,
        *,
        clearance: Tensor,
    ) -> Limbs:
        """From the skinning weights of body (V, 24) and garment (N, 24), their faces (F, 3) and (G, 3), and the
        garment's distance from the body in the rest pose [m], shape (N,)."""
        groups = body_weights.new_zeros(24, len(_LIMBS))
        for limb, joints in enumerate(_LIMBS):
            groups[list(joints), limb] = 1
        of_face = (body_weights @ groups)[body_faces].sum(1).argmax(1)
        return cls(of_face, garment_weights @ groups > _OWN, garment_faces, clearance.clamp_min(0.0))

    @cached_property
    def edges(self) -> Tensor:
        """The garment's edges, each once, shape (E, 2)."""
        return unique_edges(self.faces)

    def outward(self, points: Tensor) -> Tensor:
        """Unit normals of the garment [m], away from the skin it lies on, shape (N, 3), for its vertices (N, 3)."""
        summed = torch.zeros_like(points)
        with torch_stream(points.device):
            wp.launch(
                add_normals_kernel,
                len(self.faces),
                [as_warp(points.contiguous(), wp.vec3), as_warp(self.faces, wp.int64)],
                [as_warp(summed, wp.vec3)],
                device=str(points.device),
            )
        return torch.nn.functional.normalize(summed, dim=-1)

    def mean_of_neighbours(self, points: Tensor, rows: Tensor) -> Tensor:
        """Mean place of the neighbours of `rows` (R,) that aren't among them [m], shape (R, 3); their own if none."""
        missing = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        missing[rows] = True
        ends = self.faces[missing[self.faces].any(1)][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        here, there = torch.cat((ends, ends.flip(1))).unbind(1)
        use = missing[here] & ~missing[there]
        here, there = here[use], there[use]
        total = torch.zeros_like(points).index_add_(0, here, points[there])[rows]
        count = torch.zeros_like(points[:, 0]).index_add_(0, here, torch.ones_like(points[here, 0]))[rows]
        mean: Tensor = torch.where(count[:, None] > 0, total / count.clamp_min(1)[:, None], points[rows])
        return mean

    def is_foreign(self, rows: Tensor, body_face: Tensor) -> Tensor:
        """Whether the face (R,) that is closest to each vertex of `rows` (R,) is of a limb that it doesn't lie on."""
        return ~self.own[rows, self.of_face[body_face.long()]]

    def is_sole(self, rows: Tensor, body_face: Tensor) -> Tensor:
        """Whether the face (R,) that is closest to each vertex of `rows` (R,) is of the only limb that it lies on."""
        own = self.own[rows]
        return own.gather(1, self.of_face[body_face.long()][:, None])[:, 0] & (own.sum(1) == 1)

    def crosses(self, rows: Tensor, body_face: Tensor, gradient: Tensor, outward: Tensor) -> Tensor:
        """Whether a push along `gradient` (R, 3) would take vertices `rows` (R,) out through a limb they don't lie on.

        `body_face` (R,) is each one's closest face. Between the skin it lies on and another limb, a garment leaves the
        other limb on the near side, towards its own skin. The gradient points out on the far side where a limb is thin
        (a hand, a forearm): half the vertices would follow it, and the cloth between them be torn around the limb.
        """
        limb = self.of_face[body_face.long()]
        along = (gradient * outward[rows]).sum(-1)
        foreign = self.is_foreign(rows, body_face)
        # A limb that nearly all of the cloth would leave outwards is under the cloth, as a hand in a fold of a skirt:
        # there the gradient is right.
        inward = torch.zeros(len(_LIMBS), device=rows.device)
        touched = inward.index_add(0, limb[foreign], torch.ones_like(along[foreign]))
        inward.index_add_(0, limb[foreign], (along[foreign] < 0).float())
        under_cloth = inward < INWARD * touched
        return foreign & (along > SIDEWAYS) & ~under_cloth[limb]
