"""Which limb a garment vertex lies on, so that no other limb pulls the garment through itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from refu_core.body import ARMS, LEGS, joints_of, part_of_faces, weight_of_parts
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.mesh import Connectivity

_LIMBS = (joints_of("trunk", "head"), *ARMS, LEGS[0] + LEGS[1])
"""Joints of each limb; both legs are one, as a skirt lies on either."""


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
    """The garment's distance from the body at rest [m], shape (N,): room that it can give way into."""

    @classmethod
    def of(
        cls,
        body_weights: Tensor,
        body_faces: Tensor,
        garment_weights: Tensor,
        garment_faces: Tensor,
        *,
        clearance: Tensor,
        settings: ContactSettings = DEFAULT_CONTACT,
    ) -> Limbs:
        """From the skinning weights of body (V, 24) and garment (N, 24), their faces (F, 3) and (G, 3), and the
        garment's distance from the body in the rest pose [m], shape (N,)."""
        own = weight_of_parts(garment_weights, _LIMBS) > settings.own_weight
        return cls(part_of_faces(body_weights, body_faces, _LIMBS), own, garment_faces, clearance.clamp_min(0.0))

    @classmethod
    def one(cls, body_faces: Tensor, garment_faces: Tensor, *, n_vertices: int) -> Limbs:
        """One limb, the whole body: for a garment of `n_vertices` N without skinning weights, or a body without limbs.

        Then nothing keeps a limb from pulling the cloth of another one through itself. Faces (F, 3) and (G, 3).
        """
        own = torch.ones(n_vertices, 1, dtype=torch.bool, device=garment_faces.device)
        return cls(
            body_faces.new_zeros(len(body_faces)), own, garment_faces, torch.zeros_like(own[:, 0], dtype=torch.float32)
        )

    @cached_property
    def mesh(self) -> Connectivity:
        """What is next to what in the garment."""
        return Connectivity.of(self.faces.cpu().numpy(), len(self.own))

    @cached_property
    def edges(self) -> Tensor:
        """The garment's edges, each once, shape (E, 2), int64."""
        return torch.as_tensor(self.mesh.edges.astype(np.int64), device=self.faces.device)
