"""Torch in, torch out: body shape and pose are fitted to an observed garment through the whole prediction.

python examples/gradients.py
"""

from __future__ import annotations

import torch
from torch import Tensor

from refu_core import GarmentPipeline
from refu_core.realtime import Outfit, Wearer, dress

GARMENT = "tshirt-male"


def garment(outfit: Outfit, pose: Tensor, betas: Tensor) -> Tensor:
    """Vertices before collision handling (B, V, 3) [m], differentiable in pose (B, 24, 3) [rad] and betas (B, 10)."""
    dressed = dress(pose, Wearer.of(outfit, betas))
    seen_by_root = dressed.drapes[GARMENT].vertices
    return torch.stack([turn(one) for turn, one in zip(dressed.turns, seen_by_root, strict=True)])


def main(steps: int = 40) -> tuple[float, float]:
    """Returns the mean distance to the observed vertices before and after [mm]."""
    torch.manual_seed(0)
    outfit = GarmentPipeline.load([GARMENT], collider=False).outfit
    true_pose = torch.zeros(1, 24, 3)
    true_pose[0, 16, 2], true_pose[0, 17, 2], true_pose[0, 3, 0] = -0.7, 0.8, 0.2
    with torch.no_grad():
        observed = garment(outfit, true_pose, torch.randn(1, 10).clamp(-1, 1))

    pose, betas = torch.zeros(1, 24, 3, requires_grad=True), torch.zeros(1, 10, requires_grad=True)
    optimizer = torch.optim.Adam([pose, betas], lr=0.05)
    errors = []
    for _ in range(steps):
        difference = garment(outfit, pose, betas) - observed
        optimizer.zero_grad()
        difference.square().sum(-1).mean().backward()
        optimizer.step()
        errors.append(1e3 * float(difference.detach().norm(dim=-1).mean()))
    print(f"distance to the observed garment: {errors[0]:.1f} mm → {errors[-1]:.1f} mm")
    return errors[0], errors[-1]


if __name__ == "__main__":
    main()
