"""SMPL's 24 joints: their names, and which hangs from which."""

from __future__ import annotations

import numpy as np

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
