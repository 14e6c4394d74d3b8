"""A garment as backbones see it: a mesh in the T-pose that follows β and γ and is posed by the body's transforms.

What is known of it besides its mesh is a card, which its file stores as JSON text under the key `card`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core._files import parse_json
from refu_core.body import RigidTransforms, Skinning, blend_transforms, unapply_transforms
from refu_core.errors import GarmentError, require_type
from refu_core.frames import N_JOINTS, N_STYLES
from refu_core.mesh import Connectivity

_MAX_LAYER = 99


@dataclass(frozen=True)
class Tailoring:
    """One tailoring parameter: how far the cut moves at the place where it moves most [m]."""

    name: str
    mean: float
    """Added to the template as it was cut: the middle of the range."""
    std: float
    """Standard deviation of the parameter; γ of ±2 reaches two of them."""


@dataclass(frozen=True)
class GarmentCard:
    """What is known of a garment besides its mesh. Raises `ValueError` for values that no garment has."""

    layer: int
    """A garment is worn over those with a lower number; within a layer, the one named later is the outer one."""
    color: tuple[float, float, float]
    """sRGB, 0 to 1."""
    joints: tuple[int, ...]
    """Joints that affect the garment (Patel et al. 2020); the others would only be a source of overfitting."""
    held_at_waist: bool
    """Whether a waistband holds it; otherwise it hangs from the shoulders."""
    tailoring: tuple[Tailoring, ...]
    """The parameters that its styles are made of, four or none."""
    provenance: str
    """What it was made from, by what, and under which licence."""

    def __post_init__(self) -> None:
        numbers = [number for one in self.tailoring for number in (one.mean, one.std)]
        checks = {
            "layer": (_is_whole(self.layer, _MAX_LAYER), f"a whole number up to {_MAX_LAYER}"),
            "color": (
                isinstance(self.color, (tuple, list))
                and len(self.color) == 3
                and all(_is_number(c) and 0 <= c <= 1 for c in self.color),
                "three numbers from 0 to 1, as a tuple",
            ),
            "joints": (
                0 < len(set(self.joints)) == len(self.joints) and all(_is_whole(j, N_JOINTS - 1) for j in self.joints),
                f"different numbers of joints, 0 to {N_JOINTS - 1}",
            ),
            "held_at_waist": (isinstance(self.held_at_waist, bool), "true or false"),
            "tailoring": (
                len(self.tailoring) in (0, N_STYLES) and all(map(_is_number, numbers)),
                f"{N_STYLES} parameters or none, each a name, a mean and a standard deviation",
            ),
            "provenance": (isinstance(self.provenance, str), "a text"),
        }
        for name, (is_right, wanted) in checks.items():
            if not is_right:
                raise ValueError(f"{name}: wanted {wanted}, got {str(getattr(self, name))[:80]}")


def card_to_json(card: GarmentCard) -> str:
    """The card as JSON, as a garment's file stores it."""
    return json.dumps(asdict(card))


def json_to_card(text: bytes | str) -> GarmentCard:
    """The inverse of `card_to_json`. Raises `ValueError` if it isn't a card, `RecursionError` if nested too deeply."""
    values = parse_json(text.encode() if isinstance(text, str) else text)
    wanted = [field.name for field in fields(GarmentCard)]
    if not isinstance(values, dict) or sorted(values) != sorted(wanted):
        got = ", ".join(map(str, values))[:200] if isinstance(values, dict) else str(values)[:80]
        raise ValueError(f"wanted a card of {', '.join(wanted)}, got {got}")
    try:
        tailoring = tuple(Tailoring(**one) for one in values["tailoring"])
        rows = {name: tuple(values[name]) for name in ("color", "joints")}
        return GarmentCard(**{**values, **rows, "tailoring": tailoring})
    except TypeError as error:
        raise ValueError(f"a card of other types: {error}") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: Any, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most


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
