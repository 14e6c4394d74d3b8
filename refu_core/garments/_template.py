"""A garment as backbones see it: a mesh in the T-pose that follows β and γ and is posed by the body's transforms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core.body import RigidTransforms, Skinning, blend_transforms, unapply_transforms
from refu_core.errors import GarmentError, require_type
from refu_core.garments._card import GarmentCard
from refu_core.mesh import Connectivity

_TENSOR = "a torch.Tensor, such as torch.as_tensor(array) gives"


def inner_first(garments: Mapping[str, GarmentTemplate]) -> list[str]:
    """Names of garments worn together, from the skin outwards (`GarmentCard.layer`)."""
    return sorted(garments, key=lambda name: garments[name].card.layer)


@dataclass(frozen=True, eq=False)
class UvMap:
    """Texture coordinates, which have seams where the mesh has none."""

    coordinates: NDArray[np.float32]
    """Shape (T, 2)."""
    faces: NDArray[np.int64]
    """Which of the coordinates each corner of each face has, shape (F, 3)."""


@dataclass(frozen=True, eq=False)
class GarmentTemplate:
    """One garment of V vertices and F faces, made for one body.

    Posing is g_i = T_i(θ, β) (t_i(β, γ) + D_i) with the template t, a backbone's displacement D, and the body's blended
    transforms T at the garment's own skinning weights (Patel et al. 2020).
    """

    name: str
    """The name of its file, and of the folder of its weights."""
    body: str
    """Name of the built-in body that the garment was cut for."""
    card: GarmentCard
    """What is known of it besides its mesh."""
    faces: Tensor
    """Counter-clockwise from outside, shape (F, 3), int64."""
    weights: Tensor
    """Skinning weights, rows sum to one, shape (V, 24)."""
    v_template: Tensor
    """Mean garment on the mean body in the T-pose, SMPL axes [m], shape (V, 3)."""
    shapedirs: Tensor
    """Displacement per unit of each beta [m], shape (V * 3, 10)."""
    styledirs: Tensor | None
    """Displacement per unit of each style component γ [m], shape (V * 3, 4); None for a garment of one style."""
    uv: UvMap | None = None
    """Texture coordinates; None for a garment without them."""

    def __repr__(self) -> str:
        return f"GarmentTemplate({self.name} on {self.body}, {self.n_vertices} vertices, {len(self.faces)} faces)"

    @property
    def n_vertices(self) -> int:
        """Number of vertices V."""
        return len(self.v_template)

    @cached_property
    def mesh(self) -> Connectivity:
        """The connectivity of its mesh."""
        return Connectivity.of(self.faces.cpu().numpy(), self.n_vertices)

    @cached_property
    def edges(self) -> Tensor:
        """Each edge once, lower vertex first, shape (E, 2), int64."""
        return torch.as_tensor(self.mesh.edges.astype(np.int64), device=self.faces.device)

    @cached_property
    def edge_length(self) -> float:
        """Median length of the mean garment's edges at rest [m]."""
        first, second = self.v_template[self.edges].unbind(1)
        return float((first - second).norm(dim=1).median())

    def to(self, *, device: str | torch.device | None = None, dtype: torch.dtype | None = None) -> GarmentTemplate:
        """The same garment on another device or in another precision."""
        own = {name: getattr(self, name) for name in ("weights", "v_template", "shapedirs", "styledirs")}
        moved: dict[str, Any] = {
            name: None if one is None else one.to(device=device, dtype=dtype) for name, one in own.items()
        }
        return replace(self, faces=self.faces.to(device=device), **moved)

    def rest(self, betas: Tensor, style: Tensor | None = None) -> Tensor:
        """The template t(β, γ) in the T-pose [m], shape (B, V, 3), for betas (B, 10) and style (B, 4) or None.

        Raises `GarmentError` if a style is given for a garment that has one style only.
        """
        require_type(betas, Tensor, _TENSOR, error=GarmentError)
        offset = betas @ self.shapedirs.T
        if style is not None:
            if self.styledirs is None:
                raise GarmentError(f"{self.name} has one style only: leave the style out")
            offset = offset + style @ self.styledirs.T
        return self.v_template + offset.view(len(offset), self.n_vertices, 3)

    def own(self, style: Tensor | None) -> Tensor | None:
        """The style γ unchanged; None for a garment of one style, whose samples carry a γ all the same."""
        return None if self.styledirs is None else style

    def vertex_transforms(self, transforms: RigidTransforms) -> RigidTransforms:
        """The body's transforms (leading shape (B, 24)) blended at the garment's vertices (leading shape (B, V))."""
        return blend_transforms(self.weights, transforms)

    def pose(self, unposed: Tensor, transforms: RigidTransforms) -> Tensor:
        """Posed garment [m], shape (B, V, 3), of an unposed one of the same shape, by the body's transforms (B, 24)."""
        require_type(unposed, Tensor, _TENSOR, error=GarmentError)
        return self._skinning(unposed, transforms)

    @cached_property
    def _skinning(self) -> Skinning:
        return Skinning(self.weights)

    def unpose(self, posed: Tensor, transforms: RigidTransforms) -> Tensor:
        """The inverse of `pose`, exact to rounding (see `refu_core.body.unapply_transforms`)."""
        require_type(posed, Tensor, _TENSOR, error=GarmentError)
        return unapply_transforms(posed, self.vertex_transforms(transforms))
