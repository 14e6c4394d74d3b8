"""Cloth that goes along where the skin below it gives way: no network has to say that."""

from __future__ import annotations

import torch
from torch import Tensor

from refu_core.body import Collider, SmplBody
from refu_core.garments import GarmentTemplate, SkinBelow
from refu_core.realtime import RootTurn


class TakenAlong:
    """How far `refu_core.realtime.dress` takes cloth along with skin that gives way, in unposed displacements."""

    def __init__(self, body: SmplBody, garment: GarmentTemplate) -> None:
        self._body, self._garment = body, garment
        self._collider, self._below = Collider(body), SkinBelow.of(garment, body)

    def without(self, displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        """Of displacements that were simulated (B, N, 3) [m] what a network has to say."""
        return self._moved(displacement, betas, pose, style, -1.0)

    def with_it(self, displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        """The inverse."""
        return self._moved(displacement, betas, pose, style, 1.0)

    @torch.no_grad()
    def _moved(self, displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor, sign: float) -> Tensor:
        garment, shape = self._garment, self._body.shape(betas)
        _, at_root = RootTurn.taken_off(pose, shape.joints)
        posed = self._body.posed(at_root, shape)
        shift = self._below(self._collider(posed.vertices, posed.transforms) - posed.vertices)
        rest = garment.rest(betas, garment.own(style))
        vertices = garment.pose(rest + displacement, posed.transforms) + sign * shift
        return garment.unpose(vertices, posed.transforms) - rest
