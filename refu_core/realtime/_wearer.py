"""What is worn, and what of that depends on a person's (β, γ) only."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, nn

from refu_core._device import without_autocast
from refu_core.backbones import Backbone
from refu_core.body import BodyFit, Collider, Shape, ShapeMap, SmplBody, require_batch
from refu_core.errors import FrameError, require_type
from refu_core.frames import N_BETAS, N_STYLES
from refu_core.garments import GarmentTemplate, SkinBelow
from refu_core.refu import Refu


@dataclass(frozen=True, eq=False)
class Wearable:
    """A garment and its networks."""

    template: GarmentTemplate
    backbone: Backbone
    refu: Refu | None
    """Predicts the scale α; None for α = 1."""
    margin: float
    """ε that the networks were trained with [m]."""
    betas: ShapeMap | None = None
    """Maps the body's betas to those of the body that the networks were trained on; None if that is the same body."""
    size: float = 1.0
    """How many times as large as the latter the body is: networks know the folds of adults."""
    knows_arms: bool = False
    """Whether the networks have learnt where cloth lies beside arms: they are told where the arms are, and in their
    samples arms were where people have them."""

    def known_as(self, betas: Tensor) -> Tensor:
        """The networks' betas for those of the body, both (B, 10)."""
        return betas if self.betas is None else self.betas(betas)


@dataclass(frozen=True, eq=False)
class Outfit:
    """A body model and what is worn on it, the same for all persons."""

    body: SmplBody
    wearables: Mapping[str, Wearable]
    """By name."""
    collider: Collider | None = None
    """Makes the body that garments are brought off; None for the posed body as it is, which may run through itself."""
    fit: BodyFit | None = None
    """How a body that isn't the garments' own relates to the built-in ones."""

    def __repr__(self) -> str:
        return f"Outfit({', '.join(self.wearables)} on {self.body.name})"

    @cached_property
    def below(self) -> Mapping[str, SkinBelow]:
        """The skin that each garment lies on, by name."""
        return {name: SkinBelow.of(one.template, self.body) for name, one in self.wearables.items()}

    def beside(self) -> Outfit:
        """The same with a collider of its own, for another thread: nothing else has memory that a frame works in."""
        return replace(self, collider=self._collider_of(self.body))

    def to(self, dtype: torch.dtype) -> Outfit:
        """The same in another precision; nothing is shared."""
        body = self.body.to(dtype=dtype)
        wearables = {name: _cast(one, dtype) for name, one in self.wearables.items()}
        return Outfit(body, wearables, self._collider_of(body), self.fit)

    def _collider_of(self, body: SmplBody) -> Collider | None:
        return None if self.collider is None else Collider(body, settings=self.collider.settings)


class UnposedGarment(NamedTuple):
    """One garment on B persons before it is posed, without what a backbone adds."""

    rest: Tensor
    """t(β, γ) [m], shape (B, V, 3)."""
    on_mean: Tensor
    """t(0, γ), the same on the mean shape [m], shape (B, V, 3)."""
    code: Tensor | None
    """`Backbone.wearer_code`, shape (B, K)."""
    betas: Tensor
    """β as the garment's networks know the person, shape (B, 10)."""


@dataclass(frozen=True, eq=False)
class Wearer:
    """What depends on (β, γ) only, of a batch of B persons: computed once, for all of their poses."""

    outfit: Outfit
    betas: Tensor
    """Shape (B, 10)."""
    style: Tensor
    """Shape (B, 4)."""
    shape: Shape
    garments: Mapping[str, UnposedGarment]

    @classmethod
    def of(cls, outfit: Outfit, betas: Tensor, style: Tensor | None = None) -> Wearer:
        """For betas (B, 10) and style (B, 4), the mean style if not given. Garments with only one style keep it.

        Differentiable. Raises `FrameError` for anything but an outfit and tensors of these shapes in the body's
        precision.
        """
        require_type(outfit, Outfit, "a pipeline's outfit", error=FrameError)
        dtype = outfit.body.dtype
        require_batch("betas", betas, (N_BETAS,), dtype=dtype)
        if style is not None:
            require_batch("style", style, (N_STYLES,), dtype=dtype, sizes=(1, len(betas)))
        with without_autocast(betas.device.type):
            mean = betas.new_zeros(1, betas.shape[1])
            garments = {}
            for name, one in outfit.wearables.items():
                own, known = one.template.own(style), one.known_as(betas)
                rest = one.template.rest(betas, own)
                on_mean = one.template.rest(mean, own).expand_as(rest)
                garments[name] = UnposedGarment(rest, on_mean, one.backbone.wearer_code(known, own), known)
            gamma = betas.new_zeros(1, N_STYLES) if style is None else style
            return cls(outfit, betas, gamma.expand(len(betas), -1), outfit.body.shape(betas), garments)

    @classmethod
    def of_tensors(cls, outfit: Outfit, tensors: Mapping[str, Tensor]) -> Wearer:
        """The inverse of `tensors`."""
        garments = {
            name: UnposedGarment(*(tensors.get(f"{name}/{field}") for field in UnposedGarment._fields))  # type: ignore[arg-type]
            for name in outfit.wearables
        }
        shape = Shape(tensors["vertices"], tensors["joints"])
        return cls(outfit, tensors["betas"], tensors["style"], shape, garments)

    @classmethod
    def together(cls, wearers: Sequence[Wearer]) -> Wearer:
        """The persons of several wearers in the same outfit, one after another."""
        if len(wearers) == 1:
            return wearers[0]
        each = [wearer.tensors() for wearer in wearers]
        return cls.of_tensors(wearers[0].outfit, {name: torch.cat([one[name] for one in each]) for name in each[0]})

    def tensors(self) -> dict[str, Tensor]:
        """All that it holds except the outfit, by name; the first axis of each tensor is B."""
        found = {"betas": self.betas, "style": self.style}
        found |= {"vertices": self.shape.vertices, "joints": self.shape.joints}
        for name, garment in self.garments.items():
            found |= {f"{name}/{field}": tensor for field, tensor in garment._asdict().items() if tensor is not None}
        return found


def _cast(wearable: Wearable, dtype: torch.dtype) -> Wearable:
    network, refu = copy.deepcopy((wearable.backbone, wearable.refu))
    if isinstance(network, nn.Module):
        network.to(dtype)
    if refu is not None:
        refu.to(dtype)
    return replace(wearable, template=wearable.template.to(dtype=dtype), backbone=network, refu=refu)
