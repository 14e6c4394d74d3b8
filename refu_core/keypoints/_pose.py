"""Forward kinematics of one skeleton in NumPy, and how its keypoints move with joints and shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core._npz import read_npz
from refu_core.errors import BodyError, FrameError, require_type
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.keypoints._layouts import KeypointLayout
from refu_core.modes import BUILTIN_BODIES
from refu_core.skeleton import CARRIED, PARENTS

Array = NDArray[np.float64]

_ABOVE = np.array(PARENTS)


def _hops() -> list[NDArray[np.intp]]:
    """The joints that are 1, 2, 4, 8 levels above each, shape (24,) per level; 24 where that is beyond the root."""
    hops, above = [], np.append(np.where(_ABOVE < 0, N_JOINTS, _ABOVE), N_JOINTS)
    while (above < N_JOINTS).any():
        hops.append(above[:-1])
        above = above[above]
    return hops


_HOPS = _hops()
LIMBS = ((16, 18, 20, 22), (17, 19, 21, 23), (1, 4, 7, 10), (2, 5, 8, 11))
"""The joints of arms and legs, from the trunk on."""
_IDENTITY = np.eye(3)
_CROSSES = np.stack([np.cross(axis, _IDENTITY).T.ravel() for axis in _IDENTITY])  # 3, 9: each axis as a skew matrix
_NEARLY_HALF = -1.98  # twice the cosine of 172°
_TINY = 1e-40  # added to a square, so that zero is never divided by zero


@dataclass(frozen=True, eq=False)
class Proportions:
    """The joints of a body in the T-pose as a function of its betas."""

    joints: Array
    """Joints of the mean shape [m], shape (24, 3)."""
    shapedirs: Array
    """How a unit of each beta moves them [m], shape (24, 3, 10)."""

    @classmethod
    @cache
    def builtin(cls, name: str) -> Proportions:
        """The proportions of a built-in body. Raises `BodyError`."""
        keys = ("v_template", "J_regressor", "shapedirs")
        if name not in BUILTIN_BODIES:
            raise BodyError(f"no built-in body {name!r}: wanted one of {', '.join(BUILTIN_BODIES)}")
        with resources.as_file(resources.files("refu_core") / "assets" / f"body_{name}.npz") as path:
            data = read_npz(path, keys=keys, error=BodyError, wanted="a body model")
        regressor = np.asarray(data["J_regressor"], np.float64)
        moves = np.einsum("jv,vck->jck", regressor, np.asarray(data["shapedirs"], np.float64)[:, :, :N_BETAS])
        return cls(regressor @ np.asarray(data["v_template"], np.float64), moves)

    @classmethod
    def of_body(cls, body: Any) -> Proportions:
        """The proportions of an `SmplBody`; raises `BodyError` for anything else."""
        import torch

        if not hasattr(body, "rest_joints"):  # the class isn't known in this layer
            raise BodyError(f"wanted a body (load_body), got {type(body).__name__}")
        betas = torch.cat([torch.zeros(1, N_BETAS), torch.eye(N_BETAS)]).to(body.device, body.dtype)
        joints = body.rest_joints(betas).cpu().numpy().astype(np.float64)
        return cls(joints[0], np.moveaxis(joints[1:] - joints[0], 0, -1))

    def of(self, betas: Array) -> Array:
        """Joints in the T-pose [m], shape (24, 3), for betas (10,)."""
        return self.joints + self.shapedirs @ betas


class Posed(NamedTuple):
    """A posed skeleton and its keypoints."""

    turns: Array
    """Rotation of each joint in the world, shape (24, 3, 3)."""
    joints: Array
    """[m], shape (24, 3)."""
    points: Array
    """Keypoints [m], shape (K, 3)."""
    moves: Array
    """How a unit of each beta moves a keypoint [m], shape (K, 3, 10)."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a person is and how they stand."""

    pelvis: Array
    """Place of the root joint [m], shape (3,)."""
    turns: Array
    """Rotation of each joint in its parent, shape (24, 3, 3)."""
    betas: Array
    """Shape coefficients, shape (10,)."""

    def moved(self, step: Array, *, most_beta: float = np.inf) -> Pose:
        """The pose after a step (pelvis 3 [m], turns 24 * 3 [rad] in the joint's own axes, betas 10), shape (85,).

        Betas stay within `most_beta`.
        """
        turns = self.turns @ exp_so3(step[3 : 3 + 3 * N_JOINTS].reshape(N_JOINTS, 3))
        betas = np.minimum(np.maximum(self.betas + step[3 + 3 * N_JOINTS :], -most_beta), most_beta)
        return Pose(self.pelvis + step[:3], turns, betas)


class Skeleton:
    """The keypoints of a layout on a body. Raises `FrameError` for anything else."""

    def __init__(self, layout: KeypointLayout, proportions: Proportions) -> None:
        require_type(layout, KeypointLayout, "a layout, as keypoint_layout gives", error=FrameError)
        require_type(proportions, Proportions, "a body's Proportions", error=FrameError)
        self.layout = layout
        self.proportions = proportions
        above = np.maximum(_ABOVE, 0)
        bones, dirs = (given - given[above] for given in (proportions.joints, proportions.shapedirs))
        self._bones = np.concatenate([bones[:, :, None], dirs], axis=2)  # from its parent to each joint, and per beta
        rest, slopes = (
            np.tensordot(layout.places, given, 1) - given[layout.joints]
            for given in (proportions.joints, proportions.shapedirs)
        )
        rest = rest + layout.offsets
        self._beside = np.concatenate([rest[:, :, None], slopes], axis=2)  # from its joint to each keypoint, per beta
        carried = CARRIED[layout.joints]
        carried[np.arange(len(layout)), layout.joints] *= ~layout.is_joint
        self.turning = np.flatnonzero(carried.any(axis=0))
        """Joints that move a keypoint when they turn, shape (m,)."""
        self.carried = carried[:, self.turning]
        """Whether a keypoint moves (1) or not (0) when each of those joints turns, shape (K, m)."""
        self.chains = [self._chain(limb) for limb in LIMBS]
        """Of each of the `LIMBS`, the joints that move a keypoint, shape (n,), and the ends of their bones, from the
        first one on, about which they may turn without moving any, shape (m,), m ≤ n."""
        self._last: tuple[Pose, Posed] | None = None

    def _chain(self, limb: Sequence[int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        shown = {joint: {-1} for joint in limb}
        for i, joint in enumerate(self.turning.tolist()):
            shown[joint] = {-1, *np.flatnonzero(self.carried[:, i]).tolist()}
        joints = [joint for joint in limb if len(shown[joint]) > 1]
        ends = []
        for joint, end in zip(joints, limb[1:], strict=False):
            if shown[joint] != shown[end] | {self.layout.at_joint(end)}:
                break
            ends.append(end)
        return np.array(joints), np.array(ends, dtype=np.intp)

    def bones(self, betas: Array) -> Array:
        """The vector from each joint's parent to it in the T-pose [m], shape (24, 3)."""
        return self._bones[:, :, 0] + self._bones[:, :, 1:] @ betas

    def posed(self, pose: Pose) -> Posed:
        """Joints and keypoints of a pose; those of the last pose are remembered."""
        if self._last is None or self._last[0] is not pose:
            self._last = pose, self._posed(pose)
        return self._last[1]

    def _posed(self, pose: Pose) -> Posed:
        turns = np.empty((N_JOINTS + 1, 3, 3))
        turns[:N_JOINTS], turns[N_JOINTS] = pose.turns, _IDENTITY
        for above in _HOPS:  # each round doubles the length of the chain that a turn is the product of
            turns[:N_JOINTS] = turns[above] @ turns[:N_JOINTS]
        bones = turns[_HOPS[0]] @ self._bones
        reach = (CARRIED @ bones.reshape(N_JOINTS, -1)).reshape(bones.shape)
        moves, turns = reach[:, :, 1:], turns[:N_JOINTS]
        joints = pose.pelvis + reach[:, :, 0] + moves @ pose.betas
        at = self.layout.joints
        beside = turns[at] @ self._beside
        spread = moves[at] + beside[:, :, 1:]
        points = joints[at] + beside[:, :, 0] + beside[:, :, 1:] @ pose.betas
        return Posed(turns, joints, points, spread)

    def jacobian(self, posed: Posed, *, of_betas: bool) -> Array:
        """How keypoints move with the pelvis, with each joint of `turning` about its own axes, and betas if wanted.

        Shape (3 K, 3 + 3 m + 10), or without the 10.
        """
        n, m = len(self.layout), len(self.turning)
        arms = posed.points[:, None] - posed.joints[self.turning]
        turns = (skew(self.carried[:, :, None] * -arms) @ posed.turns[self.turning]).swapaxes(1, 2)
        columns = [np.broadcast_to(_IDENTITY, (n, 3, 3)), turns.reshape(n, 3, 3 * m)]
        columns += [posed.moves] if of_betas else []
        return np.concatenate(columns, axis=2).reshape(3 * n, -1)


def exp_so3(vectors: Array) -> Array:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3) [rad]."""
    return Rotation.from_rotvec(vectors).as_matrix()


def log_so3(matrices: Array) -> Array:
    """Rotation vectors (n, 3) [rad], no longer than pi, of rotation matrices (n, 3, 3)."""
    vector = matrices.reshape(-1, 9) @ _CROSSES.T  # twice the sine times the axis
    twice_sine = np.sqrt(np.einsum("ij,ij->i", vector, vector) + _TINY)
    twice_cosine = np.einsum("ijj->i", matrices) - 1
    result: Array = (np.arctan2(twice_sine, twice_cosine) / twice_sine)[:, None] * vector
    near = twice_cosine < _NEARLY_HALF  # half a turn, where the sine vanishes
    if near.any():
        result[near] = Rotation.from_matrix(matrices[near]).as_rotvec()
    return result


def skew(vectors: Array) -> Array:
    """Matrices (…, 3, 3) that multiply as the cross product with vectors (…, 3) does."""
    matrices: Array = (vectors @ _CROSSES).reshape(*vectors.shape, 3)
    return matrices
