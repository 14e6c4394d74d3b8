"""A pose's covariance, pushed through the kinematics to the vertices of a garment."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.body import PARENTS

if TYPE_CHECKING:
    from refu_core.body import SmplBody
    from refu_core.frames import SmplFrame
    from refu_core.garments import GarmentTemplate

F64 = NDArray[np.float64]


def input_variance(
    body: SmplBody, garment: GarmentTemplate, frame: SmplFrame, vertices: NDArray[np.float32], covariance: F64
) -> F64:
    """Variance of a garment's vertices in a coordinate, by the pose's covariance, to first order [m²], shape (V,).

    A joint turns what hangs on it about itself: dx = -w [x - p]× G J dθ, with the vertex's weight w of all joints below
    it, the posed joint p, its world rotation G, and the right Jacobian J of its rotation vector θ.

    Args:
        body: that wears it.
        garment: whose vertices they are.
        frame: their pose and shape.
        vertices: without the translation [m], shape (V, 3).
        covariance: of the rotation vectors [rad²], shape (72, 72) or (24, 3, 3).
    """
    device = body.device
    pose = torch.tensor(frame.pose, device=device, dtype=body.dtype)[None]
    posed = body.posed(pose, body.shape(torch.tensor(frame.betas, device=device, dtype=body.dtype)[None]))
    joints = posed.joints[0].cpu().double().numpy()
    turn = posed.transforms.rotation[0].cpu().double().numpy() @ _right_jacobians(frame.pose.astype(np.float64))
    hangs = garment.weights.detach().cpu().double().numpy() @ _below()
    arm = hangs[:, :, None] * (vertices[:, None].astype(np.float64) - joints)
    n = len(joints)
    if covariance.ndim == 3:
        spread = turn @ covariance @ turn.transpose(0, 2, 1)
        found = np.einsum("vji,vji,j->v", arm, arm, np.trace(spread, axis1=1, axis2=2))
        found -= np.einsum("vji,jik,vjk->v", arm, spread, arm, optimize=True)
        return np.asarray(np.maximum(found, 0.0) / 3)
    blocks = covariance.reshape(n, 3, n, 3)
    spread = np.einsum("aij,ajbk,blk->abil", turn, blocks, turn, optimize=True)
    trace = np.trace(spread, axis1=2, axis2=3)
    flat = arm.reshape(len(arm), -1)
    # tr([a]× S [b]×ᵀ) = (a·b) tr S - bᵀ S a
    form = np.einsum("ab,il->aibl", trace, np.eye(3)) - spread.transpose(0, 3, 1, 2)
    total = ((flat @ form.reshape(3 * n, 3 * n)) * flat).sum(1)
    return np.asarray(np.maximum(total, 0.0) / 3)


def _below() -> F64:
    """1 where a joint (row) hangs on another or is that one (column), shape (24, 24)."""
    found = np.eye(len(PARENTS))
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            found[joint] += found[parent]
    return found


def _right_jacobians(pose: F64) -> F64:
    """Of rotation vectors (N, 3) [rad], shape (N, 3, 3): R(θ + dθ) = R(θ) exp([J dθ]×)."""
    angle = np.linalg.norm(pose, axis=1)[:, None, None]
    x, y, z = pose.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    square = np.maximum(angle, 1e-3) ** 2
    first = np.where(angle < 1e-3, 0.5, (1 - np.cos(angle)) / square)
    second = np.where(angle < 1e-3, 1 / 6, (angle - np.sin(angle)) / (square * np.maximum(angle, 1e-3)))
    found: F64 = np.eye(3) - first * cross + second * (cross @ cross)
    return found
