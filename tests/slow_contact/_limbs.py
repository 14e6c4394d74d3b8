"""Which limb a garment vertex lies on, and what follows from it, vertex by vertex."""

from __future__ import annotations

import torch
from torch import Tensor

from refu_core.contact import DEFAULT_CONTACT, Limbs


class SlowLimbs(Limbs):
    """The limbs with what the reference asks of them."""

    def outward(self, points: Tensor) -> Tensor:
        """Unit normals of the garment [m], away from the skin it lies on, shape (N, 3), for its vertices (N, 3)."""
        a, b, c = points[self.faces].unbind(1)
        normal = torch.linalg.cross(b - a, c - a)
        summed = torch.zeros_like(points)
        for corner in self.faces.unbind(1):
            summed.index_add_(0, corner, normal)
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
        inward = torch.zeros(self.own.shape[1], device=rows.device)
        touched = inward.index_add(0, limb[foreign], torch.ones_like(along[foreign]))
        inward.index_add_(0, limb[foreign], (along[foreign] < 0).float())
        under_cloth = inward < DEFAULT_CONTACT.inward * touched
        return foreign & (along > DEFAULT_CONTACT.sideways) & ~under_cloth[limb]
