"""The joints of ROS4HRI's `human_description` (REP-155): 20 angles of a person, as `hri_body_detect` publishes them.

Names are `<joint>_<id>` for each of `AXES`. The skeleton has no spine, collars, wrists, ankles or root: the
waist's angle is spread over SMPL's three spine joints, the head's over neck and head, and the others stay at rest. The
person stands upright in the frame `body_<id>`, with the pelvis at its origin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters.axes import vertices_smpl_from_ros
from msg_adapters.errors import DecodeError
from refu_core.frames import MAX_ANGLE
from refu_core.skeleton import JOINT_NAMES

AXES = {
    "waist": (0, 1, 0), "r_head": (1, 0, 0), "y_head": (0, 0, 1), "p_head": (0, -1, 0),
    "l_y_shoulder": (0, 0, -1), "l_p_shoulder": (1, 0, 0), "l_r_shoulder": (0, 0, 1), "l_elbow": (0, -1, 0),
    "r_y_shoulder": (0, 0, 1), "r_p_shoulder": (-1, 0, 0), "r_r_shoulder": (0, 0, -1), "r_elbow": (0, -1, 0),
    "l_y_hip": (0, 0, -1), "l_p_hip": (1, 0, 0), "l_r_hip": (0, -1, 0), "l_knee": (0, -1, 0),
    "r_y_hip": (0, 0, -1), "r_p_hip": (-1, 0, 0), "r_r_hip": (0, -1, 0), "r_knee": (0, -1, 0),
}  # fmt: skip
"""Axis of each joint in ROS axes, as in the URDF; each limb is listed from the trunk outwards."""


def _joints(*names: str) -> list[int]:
    return [JOINT_NAMES.index(name) for name in names]


_AXES = vertices_smpl_from_ros(np.array([*AXES.values()], np.float64))
_SPINE, _HEAD = _joints("spine1", "spine2", "spine3"), _joints("neck", "head")
_BALLS = _joints("left_shoulder", "right_shoulder", "left_hip", "right_hip")
_HINGES = _joints("left_elbow", "right_elbow", "left_knee", "right_knee")
_REST = Rotation.from_rotvec([[0, 0, -np.pi / 2], [0, 0, np.pi / 2], [0, 0, 0], [0, 0, 0]])
"""Rotations from SMPL's limbs at rest, where the arms point sideways, to ROS4HRI's, where they hang."""


def body_of(names: Sequence[str]) -> str | None:
    """The id of the body whose joints these are, None for other names; raises `DecodeError` for several bodies."""
    bodies = [name.removeprefix("waist_") for name in names if name.startswith("waist_")]
    if len(bodies) > 1:
        raise DecodeError(f"wanted the joints of one body, got {len(bodies)} names that begin with waist_")
    return bodies[0] if bodies else None


def pose_of(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vectors of SMPL's joints [rad], shape (24, 3), from the angles of `AXES` [rad], shape (20,).

    Raises `DecodeError` for an angle that isn't finite, or larger than any joint's.
    """
    bad = np.flatnonzero(~(np.abs(angles) <= MAX_ANGLE))
    if bad.size:
        raise DecodeError(f"{[*AXES][bad[0]]} has the angle {angles[bad[0]]:g}, wanted radians")
    vectors = angles[:, None] * _AXES
    turns = Rotation.from_rotvec(vectors)
    first, second, third, hinge = (turns[4 + joint :: 4] for joint in range(4))  # of the four limbs
    pose = np.zeros((len(JOINT_NAMES), 3))
    pose[_SPINE] = vectors[0] / len(_SPINE)
    pose[_HEAD] = (turns[1] * turns[2] * turns[3]).as_rotvec() / len(_HEAD)
    pose[_BALLS] = (first * second * third * _REST).as_rotvec()
    pose[_HINGES] = (_REST.inv() * hinge * _REST).as_rotvec()
    return pose
