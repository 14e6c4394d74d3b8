"""The root's rotation, taken off a frame before it is dressed and put back at the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from refu_core._warp import Repeated, is_plain, strips
from refu_core.body import BodyOutput
from refu_core.realtime._turn_kernels import turn_kernel


@dataclass(frozen=True, eq=False)
class RootTurn:
    """Turns one person about their root: they are dressed in the root's axes, whichever way they face or lie.

    In world axes, turning a person would move vertices by millimetres at a fold, and by centimetres where limbs run
    into each other: the approximate distance would look up other guides, and rounding would decide thresholds anew.
    """

    rotation: Tensor
    """Shape (3, 3)."""
    root: Tensor
    """It stays in its place [m], shape (3,)."""

    @staticmethod
    def taken_off(posed: BodyOutput) -> list[RootTurn]:
        """The turns of persons who were posed in their roots' axes (`SmplBody.posed`)."""
        return [RootTurn(*turn) for turn in zip(posed.rotations[:, 0], posed.joints[:, 0], strict=True)]

    @property
    def shift(self) -> Tensor:
        """What is added to turned points, to keep the root in its place [m], shape (3,)."""
        return self.root - self.rotation @ self.root

    def __call__(self, points: Tensor) -> Tensor:
        """Points [m], shape (N, 3), from the root's axes to the world's."""
        if points.shape[1:] != (3,) or not is_plain(points, self.rotation, self.root):
            return functional.linear(points, self.rotation, self.shift)
        n_strips, each = strips(len(points), points.device)
        turned = torch.empty_like(points, memory_format=torch.contiguous_format)
        _turn((n_strips,), self.rotation[None], self.root[None], points.contiguous(), each, turned)
        return turned

    def to_host(self, points: Tensor) -> NDArray[np.float32]:
        """The same, as an array on the host."""
        seen: NDArray[np.float32] = self(points).cpu().numpy()
        return seen


_turn = Repeated(turn_kernel, (wp.mat33, wp.vec3, wp.vec3, wp.int32, wp.vec3))
