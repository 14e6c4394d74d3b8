"""What joints do when nothing shows what they do: a mean and a spread for each, wider than recorded motion has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from refu_core.skeleton import JOINT_NAMES

Array = NDArray[np.float64]

# Rotation vectors [rad] about x, y, z: mean and standard deviation, of the left side where there are two; the right
# side mirrors it (y and z change sign). Rounded up from 116 s of recorded motion (ten clips of CMU), where the spread
# of elbows about their own axis and of feet and collars, which those clips don't measure, is set from anatomy.
_RESTING: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "hip": ((-0.4, 0.05, 0.0), (0.6, 0.3, 0.25)),
    "spine1": ((0.2, 0, 0), (0.25, 0.12, 0.12)),
    "knee": ((0.6, 0, 0), (0.6, 0.08, 0.08)),
    "spine2": ((0.1, 0, 0), (0.15, 0.12, 0.1)),
    "ankle": ((-0.2, 0.1, 0.05), (0.3, 0.3, 0.1)),
    "spine3": ((0, 0, 0), (0.12, 0.12, 0.12)),
    "foot": ((0, 0, 0), (0.2, 0.05, 0.05)),
    "neck": ((-0.1, 0, 0), (0.25, 0.3, 0.25)),
    "collar": ((0, 0, 0), (0.1, 0.15, 0.15)),
    "head": ((0.1, 0, 0), (0.4, 0.4, 0.3)),
    "shoulder": ((0.1, -0.4, -1.1), (0.6, 0.7, 0.7)),
    "elbow": ((0, -0.8, 0.3), (0.25, 0.7, 0.35)),
    "wrist": ((-0.1, 0.1, 0.2), (0.35, 0.4, 0.3)),
    "hand": ((0, 0, 0), (0.1, 0.1, 0.1)),
}
_MIRROR = np.array([1.0, -1, -1])


def resting() -> tuple[Array, Array]:
    """Mean and standard deviation of each joint's rotation vector [rad], shapes (24, 3); the root's spread is 100."""
    mean, spread = np.zeros((len(JOINT_NAMES), 3)), np.full((len(JOINT_NAMES), 3), 100.0)
    for i, name in enumerate(JOINT_NAMES[1:], start=1):
        side, _, part = name.rpartition("_")
        mean[i], spread[i] = _RESTING[part]
        if side == "right":
            mean[i] *= _MIRROR
    return mean, spread
