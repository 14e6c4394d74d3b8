"""Forward kinematics of one skeleton in NumPy, and how its keypoints move with joints and shape."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from refu_core._npz import read_npz
from refu_core.errors import BodyError
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.skeleton import PARENTS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from refu_core.keypoints._layouts import KeypointLayout

    Array = NDArray[np.float64]

_ABOVE = np.array(PARENTS)
_DEPTH = np.zeros(N_JOINTS, int)
for _joint in range(1, N_JOINTS):
    _DEPTH[_joint] = _DEPTH[_ABOVE[_joint]] + 1
_LEVELS = [(found, _ABOVE[found]) for depth in range(1, _DEPTH.max() + 1) for found in [np.flatnonzero(_DEPTH == depth)]]
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
        return self.joints + self.shapedirs @ betas


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
        self._bone_dirs = proportions.shapedirs - proportions.shapedirs[above]
        self._carried = CARRIES[layout.joints].astype(np.float64)
        self._carried[np.arange(len(layout)), layout.joints] *= layout.offsets.any(axis=1)
        self._last: tuple[Pose, Posed] | None = None

    def bones(self, betas: Array) -> Array:
        """From each joint's parent to it in the T-pose [m], shape (24, 3)."""
        joints = self.proportions.of(betas)
        return joints - joints[np.maximum(_ABOVE, 0)]

    def posed(self, pose: Pose) -> Posed:
        """Joints and keypoints of a pose; of the last one asked for it is known."""
        if self._last is None or self._last[0] is not pose:
            self._last = pose, self._posed(pose)
        return self._last[1]

    def _posed(self, pose: Pose) -> Posed:
        turns, joints = pose.turns.copy(), np.empty((N_JOINTS, 3))
        joints[0] = pose.pelvis
        bones = self.bones(pose.betas)[:, :, None]
        for here, above in _LEVELS:
            turns[here] = turns[above] @ turns[here]
            joints[here] = joints[above] + (turns[above] @ bones[here])[:, :, 0]
        at = self.layout.joints
        points = joints[at] + (turns[at] @ self.layout.offsets[:, :, None])[:, :, 0]
        return Posed(turns, joints, points)

    def jacobian(self, posed: Posed) -> Array:
        """How keypoints move with a step as `Pose.moved` takes it, shape (3 K, 85)."""
        n = len(self.layout)
        jacobian = np.zeros((n, 3, 3 + 3 * N_JOINTS + N_BETAS))
        jacobian[:, :, :3] = np.eye(3)
        arms = (posed.points[:, None] - posed.joints[None]) * self._carried[:, :, None]  # K, 24, 3
        x, y, z = (arms[:, :, None, i] for i in range(3))
        u, v, w = (posed.turns[None, :, i] for i in range(3))  # 1, 24, 3: rows of the axes
        turning = jacobian[:, :, 3 : 3 + 3 * N_JOINTS].reshape(n, 3, N_JOINTS, 3)
        turning[:, 0] = v * z - w * y
        turning[:, 1] = w * x - u * z
        turning[:, 2] = u * y - v * x
        moves = np.zeros((N_JOINTS, 3, N_BETAS))
        for here, above in _LEVELS:
            moves[here] = moves[above] + posed.turns[above] @ self._bone_dirs[here]
        jacobian[:, :, 3 : 3 + 3 * N_JOINTS] = turning.reshape(n, 3, 3 * N_JOINTS)
        jacobian[:, :, 3 + 3 * N_JOINTS :] = moves[self.layout.joints]
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
    return np.eye(3) + a[:, None, None] * k + b[:, None, None] * (k @ k)


def log_so3(matrices: Array) -> Array:
    """Rotation vectors (n, 3) [rad], no longer than pi, of rotation matrices (n, 3, 3)."""
    w = 0.5 * np.sqrt(np.maximum(0.0, 1 + np.trace(matrices, axis1=1, axis2=2)))
    vector = np.stack(
        [
            matrices[:, 2, 1] - matrices[:, 1, 2],
            matrices[:, 0, 2] - matrices[:, 2, 0],
            matrices[:, 1, 0] - matrices[:, 0, 1],
        ],
        axis=1,
    )
    near_pi = w < 0.05  # the difference above vanishes there; the column of the largest entry doesn't
    sine = 0.5 * np.linalg.norm(vector, axis=1)
    angle = np.arctan2(sine, 2 * w * w - 1)
    scale = np.where(sine < 1e-6, 0.5, angle / np.maximum(2 * sine, 1e-12))
    result: Array = scale[:, None] * vector
    for i in np.flatnonzero(near_pi):
        from scipy.spatial.transform import Rotation

        result[i] = Rotation.from_matrix(matrices[i]).as_rotvec()
    return result


def skew(vectors: Array) -> Array:
    """Matrices (n, 3, 3) that multiply as the cross product with vectors (n, 3) does."""
    k = np.zeros((len(vectors), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    k[:, 1, 0], k[:, 2, 0], k[:, 2, 1] = vectors[:, 2], -vectors[:, 1], vectors[:, 0]
    return k
