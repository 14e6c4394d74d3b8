"""A garment as backbones see it: a mesh in the T-pose that follows β and γ and is posed by the body's transforms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from refu_core._npz import read_npz
from refu_core.body import RigidTransforms, Skinning, blend_transforms, unapply_transforms
from refu_core.errors import GarmentError
from refu_core.frames import N_STYLES as N_STYLES

if TYPE_CHECKING:
    from numpy.typing import NDArray

BUILTIN_GARMENTS: tuple[str, ...] = ("shirt-male", "tshirt-male", "short-pant-male", "skirt-female")

LAYERS: Mapping[str, int] = {"short-pant-male": 0, "skirt-female": 0, "tshirt-male": 1, "shirt-male": 2}
"""Which garments are worn over which: those of a higher number over those of a lower one. Tops hang over bottoms, and
a shirt over a T-shirt. A garment that isn't listed is an outermost one; of one layer, the later named is the outer."""


def inner_first(names: Iterable[str]) -> list[str]:
    """Names of garments worn together, from the skin outwards (`LAYERS`)."""
    return sorted(names, key=lambda name: LAYERS.get(name, max(LAYERS.values())))


def unique_edges(faces: Tensor) -> Tensor:
    """The edges of triangles (F, 3), each once, lower vertex first, shape (E, 2), int64."""
    corners = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).cpu().numpy()
    return torch.as_tensor(np.unique(np.sort(corners, 1), axis=0), device=faces.device)


@dataclass(frozen=True, eq=False)
class GarmentTemplate:
    """One garment of V vertices and F faces, made for one body.

    Posing is g_i = T_i(θ, β) (t_i(β, γ) + D_i) with the template t, a backbone's displacement D, and the body's blended
    transforms T at the garment's own skinning weights (paper, section "Train Backbone with ReFU"; Patel et al. 2020).
    """

    name: str
    body: str
    """Name of the built-in body that the garment was cut for."""
    faces: Tensor
    """Counter-clockwise from outside, shape (F, 3), int64."""
    weights: Tensor
    """Skinning weights, rows sum to one, shape (V, 24)."""
    v_template: Tensor
    """Mean garment on the mean body in the T-pose, SMPL axes [m], shape (V, 3)."""
    shapedirs: Tensor
    """Displacement a unit of each beta [m], shape (V * 3, 10)."""
    styledirs: Tensor | None
    """Displacement a unit of each style component γ [m], shape (V * 3, 4); None for a garment of one style."""

    @property
    def n_vertices(self) -> int:
        """Number of vertices V."""
        return len(self.v_template)

    @cached_property
    def edges(self) -> Tensor:
        """Each edge once, lower vertex first, shape (E, 2), int64."""
        return unique_edges(self.faces)

    def to(self, *, device: str | torch.device | None = None, dtype: torch.dtype | None = None) -> GarmentTemplate:
        """The same garment on another device or in another precision."""
        styledirs = None if self.styledirs is None else self.styledirs.to(device=device, dtype=dtype)
        return GarmentTemplate(
            name=self.name,
            body=self.body,
            faces=self.faces.to(device=device),
            weights=self.weights.to(device=device, dtype=dtype),
            v_template=self.v_template.to(device=device, dtype=dtype),
            shapedirs=self.shapedirs.to(device=device, dtype=dtype),
            styledirs=styledirs,
        )

    def rest(self, betas: Tensor, style: Tensor | None = None) -> Tensor:
        """The template t(β, γ) in the T-pose [m], shape (B, V, 3), for betas (B, 10) and style (B, 4) or None.

        Raises:
            GarmentError: a style was asked of a garment that has one style only.
        """
        offset = betas @ self.shapedirs.T
        if style is not None:
            if self.styledirs is None:
                msg = f"{self.name} has one style only: leave the style out"
                raise GarmentError(msg)
            offset = offset + style @ self.styledirs.T
        return self.v_template + offset.view(len(offset), -1, 3)

    def vertex_transforms(self, transforms: RigidTransforms) -> RigidTransforms:
        """The body's transforms (leading shape (B, 24)) blended at the garment's vertices (leading shape (B, V))."""
        return blend_transforms(self.weights, transforms)

    def pose(self, unposed: Tensor, transforms: RigidTransforms) -> Tensor:
        """Posed garment [m], shape (B, V, 3), of an unposed one of the same shape, by the body's transforms (B, 24)."""
        return self._skinning(unposed, transforms)

    @cached_property
    def _skinning(self) -> Skinning:
        return Skinning(self.weights)

    def unpose(self, posed: Tensor, transforms: RigidTransforms) -> Tensor:
        """The inverse of `pose`, exact to rounding (see `refu_core.body.unapply_transforms`)."""
        return unapply_transforms(posed, self.vertex_transforms(transforms))


def load_garment(
    name: str, *, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32
) -> GarmentTemplate:
    """Loads a built-in garment: `shirt-male`, `tshirt-male`, `short-pant-male` or `skirt-female`.

    Raises:
        GarmentError: there is no garment of that name.
    """
    if name not in BUILTIN_GARMENTS:
        msg = f"no garment {name!r}: wanted one of {', '.join(BUILTIN_GARMENTS)}"
        raise GarmentError(msg)
    with resources.as_file(resources.files("refu_core") / "assets" / f"garment_{name}.npz") as path:
        data = read_npz(path, keys=("v_template", "f", "weights", "shapedirs", "styledirs", "body"), error=GarmentError)

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.tensor(array, device=device, dtype=dtype)

    n = len(data["v_template"])
    return GarmentTemplate(
        name=name,
        body=str(data["body"]),
        faces=torch.tensor(data["f"].astype(np.int64), device=device),
        weights=tensor(data["weights"]),
        v_template=tensor(data["v_template"]),
        shapedirs=tensor(data["shapedirs"].reshape(n * 3, -1)),
        styledirs=tensor(data["styledirs"].reshape(n * 3, -1)) if "styledirs" in data else None,
    )
