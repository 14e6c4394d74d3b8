"""SMPL's 24 joints: their names, and which hangs from which."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
"""Names of the SMPL joints in their order; the pelvis is the root."""

PARENTS: tuple[int, ...] = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
"""Parent of each SMPL joint, -1 for the root; parents come before their children."""

CARRIED = np.eye(len(PARENTS))
"""1 where a joint (row) moves when another (column) turns: it hangs from that one, or is that one, shape (24, 24)."""
for _joint, _parent in enumerate(PARENTS[1:], start=1):
    CARRIED[_joint] += CARRIED[_parent]


def posed(turns: str) -> NDArray[np.float64]:
    """The pose that a text tells, rotation vectors, zero for joints that it doesn't name, shape (24, 3).

    In "neck 0.1 0 0, both_hip -1 0 0.2" the left hip is turned as told, the right one as its mirror image.
    """
    pose = np.zeros((len(JOINT_NAMES), 3))
    for name, *numbers in map(str.split, filter(None, turns.split(", "))):
        turn = np.array(numbers, np.float64)
        if name.startswith("both_"):
            pose[JOINT_NAMES.index(name.replace("both", "right"))] = 0.0 - turn * (-1, 1, 1)
            name = name.replace("both", "left")
        pose[JOINT_NAMES.index(name)] = turn
    return pose
