"""A first pose from one frame of keypoints: the trunk as a whole, then limb by limb."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from refu_core.keypoints._pose import Pose, Skeleton, exp_so3
from refu_core.skeleton import PARENTS

Array = NDArray[np.float64]

_TRUNK = (0, 1, 2, 3, 6, 9, 12, 13, 14, 15, 16, 17)
"""Joints that turn with the pelvis, more or less."""
_LIMBS = ((16, 18, 20, 1.0), (17, 19, 21, 1.0), (1, 4, 7, -1.0), (2, 5, 8, -1.0))
"""Ball, hinge, end; and which way along z a bending hinge moves the end in the T-pose: forearms forward, shins back."""
_LEAST = 0.05
"""Least length [m] of a vector that gives a direction; least half width of a trunk that shows which way it faces."""
_BENT = 0.15
"""Least sine of a bend that shows which way a limb is turned."""


def first_pose(skeleton: Skeleton, points: Array, seen: NDArray[np.bool_], start: Pose) -> Pose | None:
    """A pose near that of keypoints [m], shape (K, 3), of which those `seen`, shape (K,), count; None for too few."""
    joints = skeleton.layout.joints
    upright = Pose(start.pelvis, np.broadcast_to(np.eye(3), start.turns.shape).copy(), start.betas)
    rest = skeleton.posed(upright).points
    trunk = seen & np.isin(joints, _TRUNK)
    if trunk.sum() < 3:
        return None
    here, there = rest[trunk], points[trunk]
    centre = here.mean(axis=0), there.mean(axis=0)
    u, spread, vt = np.linalg.svd((there - centre[1]).T @ (here - centre[0]))
    if spread[1] < _LEAST**2:  # all in a line
        return None
    root = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turns = start.turns.copy()
    turns[0] = root
    pose = Pose(centre[1] + root @ (upright.pelvis - centre[0]), turns, start.betas)
    bones = skeleton.bones(start.betas)
    for ball, hinge, end, bends in _LIMBS:
        at = [skeleton.layout.at_joint(joint) for joint in (ball, hinge, end)]
        if at[0] < 0 or at[1] < 0 or not (seen[at[0]] and seen[at[1]]):
            continue
        above = _turn_above(turns, ball)
        upper = above.T @ (points[at[1]] - points[at[0]])
        lower = above.T @ (points[at[2]] - points[at[1]]) if at[2] >= 0 and seen[at[2]] else np.zeros(3)
        if np.linalg.norm(upper) < _LEAST:
            continue
        turns[ball] = _aligned(bones[hinge], np.array([0, 0, bends]), upper, lower)
        if np.linalg.norm(lower) >= _LEAST:
            turns[hinge] = _shortest(bones[end], turns[ball].T @ lower)
    return pose


def _turn_above(turns: Array, joint: int) -> Array:
    """Rotation of a joint's parent in the world."""
    turn = np.eye(3)
    while (joint := PARENTS[joint]) >= 0:
        turn = turns[joint] @ turn
    return turn


def _unit(vector: Array) -> Array:
    unit: Array = vector / max(float(np.linalg.norm(vector)), 1e-9)
    return unit


def _shortest(start: Array, end: Array) -> Array:
    """The smallest rotation from one direction to another."""
    a, b = _unit(start), _unit(end)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-9:  # the same direction, or the opposite one: any perpendicular axis will do
        axis = _unit(np.cross(a, np.eye(3)[np.abs(a).argmin()]))
    angle = np.arctan2(sine, cosine)
    turn: Array = exp_so3(_unit(axis)[None] * angle)[0]
    return turn


def _aligned(bone: Array, bend: Array, upper: Array, lower: Array) -> Array:
    """The rotation of a bone onto `upper` that bends the limb towards `lower`, if the bend shows."""
    along = _unit(upper)
    side = _unit(lower) - (_unit(lower) @ along) * along
    if np.linalg.norm(side) < _BENT:
        return _shortest(bone, upper)
    first = _unit(bone)
    across = _unit(bend - (bend @ first) * first)
    before = np.stack([first, across, np.cross(first, across)], axis=1)
    side = _unit(side)
    result: Array = np.stack([along, side, np.cross(along, side)], axis=1) @ before.T
    return result
