"""Poses in which a body touches itself, as people do all day."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from refu_core.body import JOINT_NAMES

Angles = Mapping[str, tuple[float, float, float]]


def _both(**left: tuple[float, float, float]) -> dict[str, tuple[float, float, float]]:
    """Joints of the left side, and of the right one as its mirror image."""
    return {
        f"{side}_{name}": (x, s * y, s * z)
        for side, s in (("left", 1), ("right", -1))
        for name, (x, y, z) in left.items()
    }


TOUCHING_POSES: Mapping[str, Angles] = {
    "hanging arms": _both(shoulder=(18, -16, -83), elbow=(0, -9, 0)),
    "crossed arms": {
        "left_shoulder": (38, -67, -54),
        "left_elbow": (0, -95, 0),
        "right_shoulder": (28, 68, 52),
        "right_elbow": (0, 87, 0),
    },
    "hands on hips": _both(shoulder=(72, -19, -52), elbow=(0, -85, 0)),
    "hands in the lap": _both(shoulder=(17, -35, -76), elbow=(0, -61, 0), hip=(-88, 0, 5), knee=(85, 0, 0)),
    "squat": {
        "pelvis": (30, 0, 0),
        "spine1": (10, 0, 0),
        "spine2": (10, 0, 0),
        "neck": (-15, 0, 0),
        **_both(shoulder=(-36, -56, -64), elbow=(0, -28, 0), hip=(-118, 0, 14), knee=(125, 0, 0), ankle=(-30, 0, 0)),
    },
    "sitting": _both(shoulder=(-4, -13, -80), elbow=(0, -59, 0), hip=(-85, 0, 8), knee=(82, 0, 0)),
    "prayer": _both(shoulder=(18, -37, -66), elbow=(0, -117, 0)),
    "lying curled up": {
        "pelvis": (0, 0, 90),
        "spine1": (18, 0, 0),
        "spine2": (18, 0, 0),
        "spine3": (12, 0, 0),
        "neck": (22, 0, 0),
        "head": (12, 0, 0),
        **_both(shoulder=(-25, -55, -73), elbow=(0, -91, 0), hip=(-115, 0, -10), knee=(122, 0, 0), ankle=(15, 0, 0)),
    },
}
"""By name: rotation vectors of joints [degrees], zero for those that aren't named; SMPL's axes, x to the left."""


def touching_pose(name: str) -> NDArray[np.float32]:
    """One of `TOUCHING_POSES`, rotation vectors [rad], shape (24, 3)."""
    pose = np.zeros((len(JOINT_NAMES), 3), np.float32)
    for joint, angles in TOUCHING_POSES[name].items():
        pose[JOINT_NAMES.index(joint)] = np.radians(angles)
    return pose
