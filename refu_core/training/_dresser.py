"""A backbone with ReFU on it, as it is trained: from body parameters to garments and their distance to the body."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_core.repulsion import Blend, Refu
from refu_core.sdf import ApproxSdf, BandSdf, BodySdf, ExactSdf, Links, RestFaces, SdfSample

Sdf = Literal["accurate", "approx"]


class Dresser(nn.Module):
    """Bodies to garments after ReFU, differentiable with respect to the networks.

    A distance's own derivative, ∇f, is kept; the direction of a push is held fixed. Its derivative, the curvature of
    the skin, would turn a push of some mm by a few degrees, and costs a graph through the closest triangles. (Both are
    there for who needs them: `BodySdf.query` is differentiable.)
    """

    def __init__(
        self,
        backbone: nn.Module,
        refu: Refu | None,
        garment: GarmentTemplate,
        body: SmplBody,
        *,
        in_refu: Sdf,
        in_loss: Sdf,
        is_blended: bool = True,
    ) -> None:
        """For one garment on one body model.

        Args:
            backbone: a module that is a `Backbone`.
            refu: the layer; None for the raw garment.
            garment: the template.
            body: its body, on the garment's device.
            in_refu: the distance that ReFU sees.
            in_loss: the distance that is returned.
            is_blended: whether pushed vertices take their neighbourhood along.
        """
        super().__init__()
        self.backbone, self.refu = backbone, refu
        self._garment, self._body = garment, body
        self._blend = Blend.of_faces(garment.faces, garment.n_vertices) if is_blended else None
        self._rest_faces = RestFaces(body) if "approx" in (in_refu, in_loss) else None
        made = {name: _Distances(name, garment, body) for name in {in_refu, in_loss}}
        self._in_refu, self._in_loss = made[in_refu], made[in_loss]

    def forward(self, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        """Garments [m] for betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4), shape (B, N, 4).

        The fourth coordinate is the signed distance to the body [m], exact where that is less than the margin.
        """
        prediction = self.backbone(betas, pose, style)
        # Millimetres need float32, whatever precision the networks are run in.
        with torch.autocast(betas.device.type, enabled=False):
            with torch.no_grad():
                posed = self._body(pose, betas)
            rest = self._garment.rest(betas, None if self._garment.styledirs is None else style)
            unposed = rest + prediction.displacement.float()
            vertices = self._garment.pose(unposed, posed.transforms)
            near = None
            if self._rest_faces is not None:
                near = self._rest_faces.under(unposed, betas, self._garment.shapedirs)
            if self.refu is not None:
                z = self.refu.feature(betas, pose, style, prediction.feature)
                sample = self._in_refu(posed.vertices, vertices, near)
                vertices = self.refu(vertices, sample, z, blend=self._blend)
            distance = self._in_loss(posed.vertices, vertices, near).distance
            return torch.cat((vertices, distance[..., None]), dim=-1)


class _Distances:
    """The distances of a batch of garments to their own bodies, with the derivative that `Dresser` speaks of."""

    def __init__(self, name: Sdf, garment: GarmentTemplate, body: SmplBody) -> None:
        self._links = Links.of(garment.edges, garment.n_vertices)
        self._sdf: BodySdf
        if name == "approx":
            self._sdf = ApproxSdf(body)
        elif body.device.type == "cpu":
            # Tells garment vertices near the skin, which are few, ten times as fast as the tree does.
            self._sdf = BandSdf(body.faces)
        else:
            self._sdf = ExactSdf(body.faces, device=body.device)

    def __call__(self, bodies: Tensor, garments: Tensor, near: Tensor | None) -> SdfSample:
        """Distances (B, N), gradients (B, N, 3) of garments (B, N, 3) to bodies (B, V, 3); `near` faces are (B, N)."""
        with torch.no_grad():
            samples = [
                self._of_one(body, points, None if near is None else near[i])
                for i, (body, points) in enumerate(zip(bodies, garments.detach(), strict=True))
            ]
        gradient = torch.stack([sample.gradient for sample in samples])
        moved = ((garments - garments.detach()) * gradient).sum(-1)
        return SdfSample(torch.stack([sample.distance for sample in samples]) + moved, gradient)

    def _of_one(self, body: Tensor, points: Tensor, near: Tensor | None) -> SdfSample:
        self._sdf.update(body)
        if isinstance(self._sdf, BandSdf):
            return self._sdf.clipped(points, self._links)
        return self._sdf.query(points, near=near)
