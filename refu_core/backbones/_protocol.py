"""What a backbone is: (β, θ, γ) to unposed displacements."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

MAX_OFFSET = 2.0
"""No vertex is farther than this from its place in the template [m], whatever a network says; as in training data."""


class Backbone(Protocol):
    """Predicts one garment."""

    @property
    def heeds_past(self) -> bool:
        """Whether it wants to know how a person has moved (`SmplFrame.past`), too."""
        ...

    def wearer_code(self, betas: Tensor, style: Tensor | None) -> Tensor | None:
        """What depends on betas (B, 10) and style (B, 4) only, shape (B, K): to be computed once per person.

        None where there is no such thing.
        """
        ...

    def __call__(
        self, betas: Tensor, pose: Tensor, style: Tensor | None, *, wearer_code: Tensor | None = None
    ) -> Tensor | None:
        """What is added to the garment's template in the T-pose [m], shape (B, V, 3); None for nothing.

        For betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4). The `wearer_code` of (β, γ) isn't computed again if
        given. A backbone that heeds the past takes that, too, as `past` of the shape (B, 4, 219).
        """
        ...


class WithoutWearerCode:
    """A backbone that computes each frame anew, from that frame alone."""

    heeds_past = False

    def wearer_code(self, betas: Tensor, style: Tensor | None) -> None:
        """None: there is nothing to keep."""


class Skinned(WithoutWearerCode):
    """No network: the template follows the skin. What every other backbone is measured against."""

    def __call__(self, betas: Tensor, pose: Tensor, style: Tensor | None, *, wearer_code: Tensor | None = None) -> None:
        """Predicts no displacement."""
