"""Forward kinematics of one skeleton in NumPy, and how its keypoints move with joints and shape."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core._npz import read_npz
from refu_core.errors import BodyError
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.keypoints._layouts import KeypointLayout
from refu_core.skeleton import PARENTS

Array = NDArray[np.float64]

_ABOVE = np.array(PARENTS)
_DEPTH = np.zeros(N_JOINTS, int)
for _joint in range(1, N_JOINTS):
    _DEPTH[_joint] = _DEPTH[_ABOVE[_joint]] + 1
# Joints as deep as each other follow one another in SMPL's order.
_LEVELS = [
    (slice(int(found[0]), int(found[-1]) + 1), _ABOVE[found])
    for found in (np.flatnonzero(depth == _DEPTH) for depth in range(1, _DEPTH.max() + 1))
]
_BELOW, _OVER = [7, 2, 3], [5, 6, 1]  # entries of a 3 x 3 matrix across the diagonal from each other
_NEARLY_HALF = -1.98  # twice the cosine of 172°
CARRIES = np.eye(N_JOINTS, dtype=bool)
"""Whether what hangs from a joint (row) moves when another (column) turns, shape (24, 24)."""
for _joint in range(1, N_JOINTS):
    CARRIES[_joint] |= CARRIES[_ABOVE[_joint]]


@dataclass(frozen=True, eq=False)
class Proportions:
    """The joints of a body in the T-pose as a function of its betas."""

    joints: Array
    """Of the mean shape [m], shape (24, 3)."""
    shapedirs: Array
    """How a unit of each beta moves them [m], shape (24, 3, 10)."""

    @classmethod
    def builtin(cls, name: str) -> Proportions:
        """Those of a built-in body. Raises `BodyError`."""
        keys = ("v_template", "J_regressor", "shapedirs")
        with resources.as_file(resources.files("refu_core") / "assets" / f"body_{name}.npz") as path:
            data = read_npz(path, keys=keys, error=BodyError, wanted="a body model")
        regressor = np.asarray(data["J_regressor"], np.float64)
        moves = np.einsum("jv,vck->jck", regressor, np.asarray(data["shapedirs"], np.float64)[:, :, :N_BETAS])
        return cls(regressor @ np.asarray(data["v_template"], np.float64), moves)

    @classmethod
    def of_body(cls, body: Any) -> Proportions:
        """Those of an `SmplBody`."""
        import torch

        betas = torch.cat([torch.zeros(1, N_BETAS), torch.eye(N_BETAS)]).to(body.device, body.dtype)
        joints = body.rest_joints(betas).cpu().numpy().astype(np.float64)
        return cls(joints[0], np.moveaxis(joints[1:] - joints[0], 0, -1))

    def of(self, betas: Array) -> Array:
        """Joints in the T-pose [m], shape (24, 3), of betas (10,)."""
        joints: Array = self.joints + self.shapedirs @ betas
        return joints


class Posed(NamedTuple):
    """A posed skeleton and its keypoints."""

    turns: Array
    """Of each joint in the world, shape (24, 3, 3)."""
    joints: Array
    """[m], shape (24, 3)."""
    points: Array
    """Keypoints [m], shape (K, 3)."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a person is and how they stand."""

    pelvis: Array
    """Of the root joint [m], shape (3,)."""
    turns: Array
    """Rotation of each joint in its parent, shape (24, 3, 3)."""
    betas: Array
    """Shape (10,)."""

    def moved(self, step: Array) -> Pose:
        """By (pelvis 3 [m], turns 24 * 3 [rad] in the joint's own axes, betas 10), shape (85,)."""
        turns = self.turns @ exp_so3(step[3 : 3 + 3 * N_JOINTS].reshape(N_JOINTS, 3))
        return replace(self, pelvis=self.pelvis + step[:3], turns=turns, betas=self.betas + step[3 + 3 * N_JOINTS :])


class Skeleton:
    """The keypoints of a layout on a body."""

    def __init__(self, layout: KeypointLayout, proportions: Proportions) -> None:
        self.layout = layout
        self.proportions = proportions
        above = np.maximum(_ABOVE, 0)
        self._bones = proportions.joints - proportions.joints[above]
        self._bone_dirs = proportions.shapedirs - proportions.shapedirs[above]
        carried = CARRIES[layout.joints].astype(np.float64)
        carried[np.arange(len(layout)), layout.joints] *= layout.offsets.any(axis=1)
        self.turning = np.flatnonzero(carried.any(axis=0))
        """Joints that move a keypoint when they turn."""
        self._carried = carried[None, :, self.turning]
        parts = np.concatenate([np.arange(3), (3 + 3 * self.turning[:, None] + np.arange(3)).ravel()])
        self.parts = np.concatenate([parts, 3 + 3 * N_JOINTS + np.arange(N_BETAS)])
        """Which of the 85 numbers of a step that `Pose.moved` takes the keypoints depend on, in order, shape (P,)."""
        self._last: tuple[Pose, Posed] | None = None

    def bones(self, betas: Array) -> Array:
        """From each joint's parent to it in the T-pose [m], shape (24, 3)."""
        bones: Array = self._bones + self._bone_dirs @ betas
        return bones

    def posed(self, pose: Pose) -> Posed:
        """Joints and keypoints of a pose; of the last one asked for they are known."""
        if self._last is None or self._last[0] is not pose:
            self._last = pose, self._posed(pose)
        return self._last[1]

    def _posed(self, pose: Pose) -> Posed:
        placed = np.empty((N_JOINTS, 3, 4))  # a joint's turn, and the way to it from its parent
        placed[:, :, :3], placed[:, :, 3] = pose.turns, self.bones(pose.betas)
        joints = np.empty((N_JOINTS, 3))
        joints[0] = pose.pelvis
        for here, above in _LEVELS:
            placed[here] = placed[above, :, :3] @ placed[here]
            joints[here] = joints[above] + placed[here, :, 3]
        at, turns = self.layout.joints, placed[:, :, :3]
        points = joints[at] + (turns[at] @ self.layout.offsets[:, :, None])[:, :, 0]
        return Posed(turns, joints, points)

    def jacobian(self, posed: Posed) -> Array:
        """How keypoints move with `parts`, shape (3 K, P): first the x of all of them, then y, then z."""
        n, m = len(self.layout), len(self.turning)
        jacobian = np.zeros((3, n, len(self.parts)))
        for axis in range(3):
            jacobian[axis, :, axis] = 1.0
        arms = (posed.points.T[:, :, None] - posed.joints[self.turning].T[:, None]) * self._carried  # 3, K, m
        x, y, z = arms[:, :, :, None]
        u, v, w = (np.ascontiguousarray(posed.turns[self.turning, i]) for i in range(3))  # m, 3: rows of the axes
        turning = jacobian[:, :, 3 : 3 + 3 * m]
        turning[0] = (v * z - w * y).reshape(n, 3 * m)
        turning[1] = (w * x - u * z).reshape(n, 3 * m)
        turning[2] = (u * y - v * x).reshape(n, 3 * m)
        moves = np.zeros((N_JOINTS, 3, N_BETAS))
        for here, above in _LEVELS:
            moves[here] = moves[above] + posed.turns[above] @ self._bone_dirs[here]
        jacobian[:, :, 3 + 3 * m :] = moves[self.layout.joints].swapaxes(0, 1)
        return jacobian.reshape(3 * n, -1)


def exp_so3(vectors: Array) -> Array:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3) [rad]: Rodrigues' formula."""
    squared = np.einsum("ij,ij->i", vectors, vectors)
    angle = np.sqrt(squared)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1 - squared / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - squared / 24, (1 - np.cos(safe)) / (safe * safe))
    k = skew(vectors)
    matrices: Array = np.eye(3) + a[:, None, None] * k + b[:, None, None] * (k @ k)
    return matrices


def log_so3(matrices: Array) -> Array:
    """Rotation vectors (n, 3) [rad], no longer than pi, of rotation matrices (n, 3, 3)."""
    flat = matrices.reshape(-1, 9)
    vector = flat[:, _BELOW] - flat[:, _OVER]
    twice_sine = np.sqrt(np.einsum("ij,ij->i", vector, vector))
    twice_cosine = flat[:, 0] + flat[:, 4] + flat[:, 8] - 1
    scale = np.where(twice_sine < 1e-9, 0.5, np.arctan2(twice_sine, twice_cosine) / np.maximum(twice_sine, 1e-9))
    result: Array = scale[:, None] * vector
    for i in np.flatnonzero(twice_cosine < _NEARLY_HALF):  # the difference vanishes there
        result[i] = Rotation.from_matrix(matrices[i]).as_rotvec()
    return result


def skew(vectors: Array) -> Array:
    """Matrices (n, 3, 3) that multiply as the cross product with vectors (n, 3) does."""
    k = np.zeros((len(vectors), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    k[:, 1, 0], k[:, 2, 0], k[:, 2, 1] = vectors[:, 2], -vectors[:, 1], vectors[:, 0]
    return k
