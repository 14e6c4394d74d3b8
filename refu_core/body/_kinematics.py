"""Rotations and the kinematic tree of the 24 SMPL joints."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Repeated, is_plain
from refu_core.body._pose_kernels import UP_STEP, chain_kernel, rotation_kernel
from refu_core.errors import FrameError, require_type
from refu_core.skeleton import PARENTS


def require_batch(
    name: str, value: Tensor, row: tuple[int, ...], *, dtype: torch.dtype | None = None, sizes: Sequence[int] = ()
) -> None:
    """Raises `FrameError` unless `value` is a tensor (B, *row), of this type and with B in `sizes` if they are given.

    Kernels read what they are given without a check of their own.
    """
    shape = value.shape if isinstance(value, Tensor) else ()
    if shape and shape[1:] == row and dtype in (None, value.dtype) and (not sizes or shape[0] in sizes):
        return
    require_type(value, Tensor, f"{name} as a torch.Tensor, such as torch.as_tensor(array) gives", error=FrameError)
    kind, batch = dtype or "a tensor", " or ".join(map(str, dict.fromkeys(sizes))) or "B"
    msg = f"{name} must be {kind} of the shape ({', '.join(map(str, (batch, *row)))}), "
    raise FrameError(f"{msg}got {value.dtype} of the shape {tuple(shape)}")


def rotvec_to_rotmat(rotvec: Tensor) -> Tensor:
    """Rotation matrices of rotation vectors [rad]: shape (..., 3) -> (..., 3, 3) (Rodrigues' formula).

    Smooth, with finite derivatives at the zero rotation. Raises `FrameError` for another shape.
    """
    if rotvec.shape[-1:] != (3,):
        raise FrameError(f"rotation vectors must have the shape (..., 3), got {tuple(rotvec.shape)}")
    if is_plain(rotvec):
        flat = rotvec.reshape(-1, 3).contiguous()
        matrices = rotvec.new_empty(*rotvec.shape, 3)
        _rotate((len(flat),), flat, matrices.view(-1, 3, 3))
        return matrices
    angle2 = (rotvec * rotvec).sum(-1)
    small = angle2 < 1e-4 if rotvec.dtype == torch.float32 else angle2 < 1e-8
    safe2 = torch.where(small, torch.ones_like(angle2), angle2)  # keeps the unused branch's gradient finite
    angle = safe2.sqrt()
    a = torch.where(small, 1 - angle2 / 6 + angle2 * angle2 / 120, angle.sin() / angle)
    # 2 sin²(θ/2) instead of 1 - cos θ: no cancellation just above the switch to the series.
    b = torch.where(small, 0.5 - angle2 / 24 + angle2 * angle2 / 720, 2 * (0.5 * angle).sin().square() / safe2)
    x, y, z = rotvec.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*rotvec.shape, 3)
    # K² = r rᵀ - |r|² I, one outer product instead of a matrix product.
    outer = rotvec.unsqueeze(-1) * rotvec.unsqueeze(-2)
    eye = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return eye + a[..., None, None] * skew + b[..., None, None] * (outer - angle2[..., None, None] * eye)


def up_in(rotation: Tensor) -> Tensor:
    """World up in the axes of roots with a `rotation` (B, 3, 3), of about unit length, shape (B, 3).

    It lies on a grid of 512 roundings, 2⁻¹⁴ in float32, and has the derivatives of what it was. Otherwise somebody who
    turns round would be told from somebody who doesn't, by how the heading is rounded. Where limbs run through each
    other, cloth that differs by as little may be pressed out another way.
    """
    up, eps = rotation[:, 1], torch.finfo(rotation.dtype).eps
    step = UP_STEP * eps / torch.finfo(torch.float32).eps
    rounded = (up / step).round() * step
    return up + (rounded - up).detach() if up.requires_grad else rounded


class RigidTransforms(NamedTuple):
    """Maps from the rest pose to the posed body, one per joint."""

    rotation: Tensor
    """Shape (B, 24, 3, 3)."""
    translation: Tensor
    """[m], shape (B, 24, 3)."""


def forward_kinematics(
    pose: Tensor, joints: Tensor, *, in_root: bool = False
) -> tuple[Tensor, Tensor, RigidTransforms]:
    """Rotations, posed joints [m], (B, 24, 3), and the transforms that move rest-pose points with each joint's bone.

    `pose` are rotation vectors [rad], shape (B, 24, 3), and the rotations (B, 24, 3, 3) are the same, relative to the
    parent joints. `joints` are those at rest [m], shape (B, 24, 3), or (1, 24, 3) for bodies of one shape. With
    `in_root` joints and transforms are in the root's axes: all is posed but the root. Raises `FrameError` for a wrong
    shape.
    """
    n, batch = len(PARENTS), len(pose)
    if pose.shape != (batch, n, 3) or joints.shape not in ((batch, n, 3), (1, n, 3)):
        msg = f"wanted rotations (B, {n}, 3) of joints (B, {n}, 3) or (1, {n}, 3), "
        msg += f"got {tuple(pose.shape)} and {tuple(joints.shape)}"
        raise FrameError(msg)
    if is_plain(pose, joints):
        rotations, turned = pose.new_empty(2, batch, n, 3, 3).unbind()
        translation, posed = pose.new_empty(2, batch, n, 3).unbind()
        inputs = pose.contiguous(), joints.contiguous(), _parents(pose.device)
        _chain[in_root]((batch,), *inputs, rotations, turned, translation, posed)
        return rotations, posed, RigidTransforms(turned, translation)
    rotations = rotvec_to_rotmat(pose)
    root = torch.eye(3, dtype=pose.dtype, device=pose.device).expand(batch, 3, 3) if in_root else rotations[:, 0]
    turns, places = [root], [joints[:, 0].expand(batch, 3)]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        bone = joints[:, joint] - joints[:, parent]
        turns.append(turns[parent] @ rotations[:, joint])
        places.append(places[parent] + (turns[parent] @ bone[..., None])[..., 0])
    turned, posed = torch.stack(turns, 1), torch.stack(places, 1)
    return rotations, posed, RigidTransforms(turned, posed - (turned @ joints.unsqueeze(-1)).squeeze(-1))


@cache
def _parents(device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(PARENTS, dtype=torch.int32, device=device)


_rotate = Repeated(rotation_kernel, (wp.vec3, wp.mat33))
_CHAIN = wp.vec3, wp.vec3, wp.int32, wp.mat33, wp.mat33, wp.vec3, wp.vec3
_chain = {in_root: Repeated(chain_kernel, _CHAIN, [in_root]) for in_root in (False, True)}
