"""What the pipeline holds of a garment and of the persons' figures, and the way from (β, θ, γ) to posed vertices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from refu_core.backbones import Backbone, TailorNet
from refu_core.body import RigidTransforms, Shape
from refu_core.garments import GarmentTemplate
from refu_core.realtime._collisions import Collisions
from refu_core.repulsion import Refu, VertexScale

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Figures:
    """What depends on (β, γ) only, of a batch of bodies."""

    key: bytes
    betas: Tensor
    """Shape (B, 10)."""
    style: Tensor | None
    """Shape (B, 4); None where nobody gave any."""
    body: Shape
    rest: Mapping[str, Tensor]
    """Garments before anything is predicted [m], shape (B, V, 3)."""
    mean_rest: Mapping[str, Tensor]
    """The same on the mean shape, of β = 0 [m], shape (B, V, 3) or (1, V, 3)."""


class Dressed(NamedTuple):
    """One garment on a batch of bodies, before collisions are handled."""

    posed: Tensor
    """Vertices [m], shape (B, V, 3)."""
    near: Tensor | None
    """A body face near each vertex, shape (B, V), where the distance wants to know."""
    scale: list[float | VertexScale]
    """α of each body."""


@dataclass(frozen=True, eq=False)
class Wearable:
    """A loaded garment, its networks, and what collision handling knows of it."""

    template: GarmentTemplate
    backbone: Backbone
    refu: Refu | None
    faces: NDArray[np.int64]
    margin: float

    def dress(
        self,
        pose: Tensor,
        figures: Figures,
        transforms: RigidTransforms,
        collisions: Collisions | None,
        *,
        mixture: Tensor | None = None,
    ) -> Dressed:
        """Puts it on bodies of `figures` in poses (B, 24, 3) [rad], whose joints have the `transforms`.

        The `mixture` is `TailorNet`'s, where that is known beforehand.
        """
        name = self.template.name
        if mixture is not None and isinstance(self.backbone, TailorNet):
            predicted = self.backbone(figures.betas, pose, figures.style, mixture=mixture)
        else:
            predicted = self.backbone(figures.betas, pose, figures.style)
        unposed, on_mean = figures.rest[name], figures.mean_rest[name]
        if predicted.displacement is not None:
            unposed = unposed + predicted.displacement
            on_mean = on_mean + predicted.displacement
        near = None if collisions is None else collisions.near(on_mean.expand_as(unposed))
        scale: list[float | VertexScale] = [1.0] * len(pose)
        if self.refu is not None:
            z = self.refu.feature(figures.betas, pose, figures.style, predicted.feature)
            scale = [self.refu.of_body(None if z is None else z[i]) for i in range(len(pose))]
        return Dressed(self.template.pose(unposed, transforms), near, scale)
