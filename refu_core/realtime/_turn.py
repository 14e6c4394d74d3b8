"""The root's rotation, taken off a frame before it is dressed and put back at the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from refu_core.body import rotvec_to_rotmat


@dataclass(frozen=True, eq=False)
class RootTurn:
    """Turns one person about their root: they are dressed in the root's axes, whichever way they face or lie.

    In world axes, turning a person would move vertices by millimetres at a fold, and by centimetres where limbs run
    into each other: the approximate distance would look up other guides, and rounding would decide thresholds anew.
    """

    rotation: Tensor
    """Shape (3, 3)."""
    shift: Tensor
    """Keeps the root in its place [m], shape (3,)."""

    @staticmethod
    def taken_off(pose: Tensor, joints: Tensor) -> tuple[list[RootTurn], Tensor]:
        """The turns of persons, and their poses without them, (B, 24, 3) [rad].

        Args:
            pose: Rotation vectors [rad], shape (B, 24, 3).
            joints: Joints in their rest poses [m], shape (B, 24, 3) or (1, 24, 3).
        """
        rotations, roots = rotvec_to_rotmat(pose[:, 0]), joints[:, 0]
        shifts = roots - (rotations @ roots.unsqueeze(-1)).squeeze(-1)
        at_root = torch.cat((torch.zeros_like(pose[:, :1]), pose[:, 1:]), 1)
        return [RootTurn(*turn) for turn in zip(rotations, shifts, strict=True)], at_root

    def __call__(self, points: Tensor) -> Tensor:
        """Points [m], shape (N, 3), from the root's axes to the world's."""
        return functional.linear(points, self.rotation, self.shift)

    def to_host(self, points: Tensor) -> NDArray[np.float32]:
        """The same, as an array on the host."""
        seen: NDArray[np.float32] = self(points).cpu().numpy()
        return seen
