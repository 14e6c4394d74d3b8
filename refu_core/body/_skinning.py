"""Linear blend skinning of points, and its inverse."""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Repeated, is_plain, strips
from refu_core.body._kinematics import RigidTransforms
from refu_core.body._pose_kernels import skin_kernel
from refu_core.errors import MeshError

_MIN_DETERMINANT = 1e-4
"""Blends of rotations almost half a turn apart collapse; below this determinant unposing is bounded, not exact."""

_skin = Repeated(skin_kernel, (wp.vec3, wp.int32, wp.int32, wp.float32, wp.mat33, wp.vec3, wp.int32, wp.vec3))


def blend_transforms(weights: Tensor, transforms: RigidTransforms) -> RigidTransforms:
    """The joints' transforms, leading shape (B, 24), blended by skinning weights (V, 24), whose rows sum to one.

    The result's leading shape is (B, V); the "rotation" of a blend isn't orthonormal.
    """
    blended = weights @ torch.cat((transforms.rotation.flatten(2), transforms.translation), -1)
    return RigidTransforms(blended[..., :9].view(*blended.shape[:2], 3, 3), blended[..., 9:])


class JointWeights(NamedTuple):
    """The joints that have a weight at each of V vertices: those of vertex v are rows `start[v]` to `start[v + 1]`."""

    start: Tensor
    """int32, shape (V + 1,)."""
    joint: Tensor
    """int32, shape (R,)."""
    weight: Tensor
    """float32, shape (R,)."""

    @classmethod
    def of(cls, weights: Tensor) -> JointWeights:
        """From skinning weights (V, 24)."""
        has_weight = weights != 0
        vertex, joint = torch.nonzero(has_weight, as_tuple=True)
        start = torch.nn.functional.pad(has_weight.sum(1).cumsum(0), (1, 0))
        return cls(start.int(), joint.int(), weights[vertex, joint].float())


class Skinning:
    """Linear blend skinning of one mesh, using only the joints that have a weight at each vertex."""

    def __init__(self, weights: Tensor) -> None:
        """For skinning weights whose rows sum to one, shape (V, 24)."""
        self._weights, self._by_joint = weights, JointWeights.of(weights)

    def __call__(self, points: Tensor, transforms: RigidTransforms) -> Tensor:
        """Posed points [m], shape (B, V, 3), of rest-pose points (B, V, 3), or (1, V, 3) for bodies of one shape.

        `transforms` are the joints', leading shape (B, 24). Differentiable. Raises `MeshError` for other points.
        """
        rotation, translation = transforms
        batch, n = len(rotation), len(self._weights)
        if points.shape not in ((batch, n, 3), (1, n, 3)):
            raise MeshError(f"wanted points of the shape ({batch}, {n}, 3) or (1, {n}, 3), got {tuple(points.shape)}")
        if not is_plain(points, rotation, translation, self._weights):
            return apply_transforms(points, blend_transforms(self._weights, transforms))
        posed = points.new_empty(batch, n, 3)
        n_strips, each = strips(n, posed.device)
        moves = rotation.contiguous(), translation.contiguous()
        _skin((batch, n_strips), points.contiguous(), *self._by_joint, *moves, each, posed)
        return posed


def apply_transforms(points: Tensor, transforms: RigidTransforms) -> Tensor:
    """Posed points [m], shape (B, V, 3), of rest-pose points of the same shape, by transforms of the shape (B, V)."""
    posed = transforms.translation
    # Three sums over columns: multiplying thousands of 3 × 3 matrices takes half as long again.
    for column, coordinate in zip(transforms.rotation.unbind(-1), points.unsqueeze(-1).unbind(-2), strict=True):
        posed = torch.addcmul(posed, column, coordinate)
    return posed


def unapply_transforms(points: Tensor, transforms: RigidTransforms) -> Tensor:
    """Rest-pose points [m] of posed points [m], both (B, V, 3): the inverse of `apply_transforms`.

    Exact up to rounding. Where a blend has collapsed (joint rotations almost half a turn apart) the determinant is
    bounded away from zero, so that the result stays finite.
    """
    moved = points - transforms.translation
    a, b, c = transforms.rotation.unbind(-1)  # columns
    bc, ca, ab = torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)
    det = (a * bc).sum(-1)
    det = torch.where(det.abs() < _MIN_DETERMINANT, torch.where(det < 0, -_MIN_DETERMINANT, _MIN_DETERMINANT), det)
    solved = torch.stack(((bc * moved).sum(-1), (ca * moved).sum(-1), (ab * moved).sum(-1)), -1)  # Cramer's rule
    return solved / det.unsqueeze(-1)
