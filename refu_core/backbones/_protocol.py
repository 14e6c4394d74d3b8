"""What a backbone is: (β, θ, γ) to unposed displacement and global feature."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from torch import Tensor


class Prediction(NamedTuple):
    """What a backbone predicts for a batch of bodies."""

    displacement: Tensor | None
    """Added to the garment's template in the T-pose [m], shape (B, V, 3); None for none."""
    feature: Tensor | None
    """Global garment feature z = h(β, θ, γ) that the ReFU scale is predicted from, shape (B, M); None without one."""


class Backbone(Protocol):
    """Predicts one garment."""

    def __call__(self, betas: Tensor, pose: Tensor, style: Tensor | None) -> Prediction:
        """Predicts for betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4)."""
        ...


class Skinned:
    """No network: the template follows the skin. What every other backbone is measured against."""

    def __call__(self, betas: Tensor, pose: Tensor, style: Tensor | None) -> Prediction:  # noqa: ARG002
        """Predicts no displacement."""
        return Prediction(None, None)
