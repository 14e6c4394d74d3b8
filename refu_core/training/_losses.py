"""The losses that a backbone with ReFU is trained with (paper, Sec. 3.2)."""

from __future__ import annotations

from torch import Tensor


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
