"""A backbone with ReFU on it, as it is trained: from body parameters to garments and their distance; and losses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from refu_core.backbones import Backbone
from refu_core.body import Collider, SmplBody
from refu_core.contact import Blend
from refu_core.garments import GarmentTemplate
from refu_core.realtime import Outfit, Wearable, Wearer, dress
from refu_core.refu import Refu
from refu_core.sdf import BAND, ApproxSdf, BodySdf, SdfSample, exact_sdf


def refu_loss(
    vertices: Tensor,
    truth: Tensor,
    distance: Tensor,
    *,
    reconstruction_weight: float = 1.5,
    collision_weight: float = 0.5,
) -> Tensor:
    """L = λ₁ L_r + λ₂ L_c of garments after ReFU (paper, Eq. 7), with its weights λ₁ and λ₂ (Sec. 4.2), shape ().

    L_r is `reconstruction_loss`, L_c `collision_loss`. With positions in metres both are about 1e-4 for a good
    backbone, which is what the paper's weights balance. `vertices` and `truth` are garments [m], shape (B, N, 3),
    `distance` the signed distance of `vertices` [m], (B, N).
    """
    return reconstruction_weight * reconstruction_loss(vertices, truth) + collision_weight * collision_loss(distance)


def reconstruction_loss(vertices: Tensor, truth: Tensor) -> Tensor:
    """L_r: squared distance to the truth [m²], shape () (paper, Eq. 8).

    The paper's sum over vertices is divided by their number, here and in L_c. Adam doesn't see a common factor, and
    garments of different sizes can be compared.
    """
    return (vertices - truth).square().sum(dim=-1).mean()


def collision_loss(distance: Tensor) -> Tensor:
    """L_c: depth inside the body, max(-f, 0) (paper, Eq. 9), mean over vertices [m], shape ()."""
    return (-distance).clamp_min(0).mean()


Sdf = Literal["accurate", "approx"]


class Dresser(nn.Module):
    """Bodies to garments after ReFU, differentiable with respect to the networks.

    The derivative of a distance, ∇f, is kept; the direction of a push is held fixed. The derivative of that direction,
    the curvature of the skin, would turn a push of some mm by a few degrees, and would cost a graph through the closest
    triangles. (Both are available where they are needed: `BodySdf.query` is differentiable.)
    """

    def __init__(
        self,
        backbone: Backbone,
        refu: Refu | None,
        garment: GarmentTemplate,
        body: SmplBody,
        in_refu: Sdf,
        in_loss: Sdf,
        *,
        is_blended: bool = True,
    ) -> None:
        """For one garment on its body, both on one device; without `refu` the garment stays as predicted.

        `in_refu` is the distance that ReFU sees, `in_loss` the one that is returned. If `is_blended`, pushed vertices
        take their neighbourhood along.
        """
        super().__init__()
        self.backbone, self.refu = backbone, refu  # submodules: their weights are this module's, too
        self._garment = garment
        self._network = _InPrecision(backbone)
        wearable = Wearable(garment, self._network, refu, 0.0)
        self._outfit = Outfit(body, {garment.name: wearable}, Collider(body))
        self._blend = Blend.of_faces(garment.faces, garment.n_vertices) if is_blended else None
        made = {name: _Distances(name, garment, body) for name in {in_refu, in_loss}}
        self._in_refu, self._in_loss = made[in_refu], made[in_loss]

    def forward(self, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        """Garments [m] for betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4), shape (B, N, 4).

        The fourth coordinate is the signed distance to the body [m], which may be clipped beyond `BAND`.
        """
        name, kind = self._garment.name, betas.device.type
        self._network.is_low, self._network.dtype = torch.is_autocast_enabled(kind), torch.get_autocast_dtype(kind)
        # Millimetres need float32, whatever precision the networks are run in.
        with torch.autocast(kind, enabled=False):
            wearer = Wearer.of(self._outfit, betas, self._garment.own(style))
            dressed = dress(pose, wearer)
            drape = dressed.drapes[name]
            vertices = drape.vertices
            if self.refu is not None:
                sample = self._in_refu(dressed.body, vertices, drape.on_mean)
                pushed = self.refu(vertices, sample, drape.feature)
                if self._blend is not None:
                    pushed = self._blend.follow(vertices, pushed, sample, self.refu.margin)
                vertices = pushed
            distance = self._in_loss(dressed.body, vertices, drape.on_mean).distance
            in_world = torch.stack([turn(one) for turn, one in zip(dressed.turns, vertices, strict=True)])
            return torch.cat((in_world, distance[..., None]), dim=-1)


@dataclass(eq=False)
class _InPrecision:
    """A backbone run in the precision that the training loop asks for, inside code that needs float32."""

    heeds_past = False
    backbone: Backbone
    is_low: bool = False
    dtype: torch.dtype = torch.float32

    def wearer_code(self, betas: Tensor, style: Tensor | None) -> Tensor | None:
        """As `Backbone.wearer_code`, in full precision."""
        return self.backbone.wearer_code(betas, style)

    def __call__(
        self, betas: Tensor, pose: Tensor, style: Tensor | None, *, wearer_code: Tensor | None = None
    ) -> Tensor | None:
        """As `Backbone`."""
        with torch.autocast(betas.device.type, self.dtype, enabled=self.is_low):
            return self.backbone(betas, pose, style, wearer_code=wearer_code)


class _Distances:
    """The distances of a batch of garments to their own bodies, with the derivative that `Dresser` describes."""

    def __init__(self, name: Sdf, garment: GarmentTemplate, body: SmplBody) -> None:
        self._sdf: BodySdf = ApproxSdf(body) if name == "approx" else exact_sdf(body)
        self._ask = self._sdf.of_garment(garment)

    def __call__(self, bodies: Tensor, garments: Tensor, on_mean: Tensor) -> SdfSample:
        """Distances (B, N), gradients (B, N, 3) of garments (B, N, 3) to bodies (B, V, 3) [m].

        `on_mean` (B, N, 3) is where the vertices are on the unposed mean shape.
        """
        samples = []
        with torch.no_grad():
            for body, points, places in zip(bodies, garments, on_mean, strict=True):
                self._sdf.update(body)
                samples.append(self._ask(points, on_mean=places, reach=BAND))
        gradient = torch.stack([sample.gradient for sample in samples])
        moved = ((garments - garments.detach()) * gradient).sum(-1)
        return SdfSample(torch.stack([sample.distance for sample in samples]) + moved, gradient)
