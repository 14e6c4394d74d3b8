"""The poses and shapes that "nothing inside" is promised for, in one place."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.body import JOINT_NAMES
from refu_core.frames import SmplFrame

PROMISED_SIZE = 3.0
"""Components of β and γ are promised up to this size, in standard deviations. At a γ of 12, 65 vertices of a T-shirt
were inside."""

# Degrees about x, y and z: the range of 6,798 frames of recorded motion and their mirror images (walks, runs, jumps,
# punches, climbing, bending, hanging by the arms), plus 20 degrees. Where those clips don't reach what anatomy allows
# (collars, an arm overhead, a knee on the heel), ranges go up to that; for knees and elbows, whose axes estimators
# often miss, they go beyond it. These are of the left side; the right side is its mirror image.
_RANGES: dict[str, tuple[tuple[float, float], ...]] = {
    "hip": ((-130, 45), (-50, 65), (-50, 50)),
    "knee": ((-45, 150), (-45, 45), (-45, 45)),
    "ankle": ((-65, 80), (-55, 65), (-30, 40)),
    "foot": ((-90, 90), (-20, 20), (-20, 20)),
    "spine1": ((-30, 70), (-35, 35), (-50, 50)),
    "spine2": ((-25, 50), (-40, 40), (-35, 35)),
    "spine3": ((-35, 40), (-30, 30), (-50, 50)),
    "neck": ((-70, 40), (-50, 50), (-55, 55)),
    "head": ((-90, 90), (-75, 75), (-75, 75)),
    "collar": ((-30, 30), (-30, 30), (-30, 30)),
    "shoulder": ((-100, 90), (-145, 65), (-135, 110)),
    "elbow": ((-60, 60), (-150, 60), (-60, 90)),
    "wrist": ((-80, 70), (-85, 90), (-40, 90)),
    "hand": ((-30, 30), (-30, 30), (-30, 30)),
}


PROMISED_BEND = np.radians(80.0)
"""The most that the spine's three joints may turn together [rad]: 78 degrees in those clips. From 86 on, bellies were
folded upon themselves, and a T-shirt was caught in them."""
SPINE = [JOINT_NAMES.index(name) for name in ("spine1", "spine2", "spine3")]


def _limits() -> NDArray[np.float64]:
    """Least and largest components of all joints' rotation vectors [rad], shape (2, 24, 3)."""
    limits: NDArray[np.float64] = np.full((2, len(JOINT_NAMES), 3), np.inf)
    limits[0] *= -1  # the root turns freely
    for joint, name in enumerate(JOINT_NAMES[1:], start=1):
        low, high = np.radians(_RANGES[name.rpartition("_")[2]]).T
        mirror = np.array((1, -1, -1) if name.startswith("right") else (1, 1, 1))
        limits[:, joint] = np.sort(np.stack((low * mirror, high * mirror)), axis=0)
    return limits


PROMISED_POSES = _limits()
"""Least and largest components of the joints' rotation vectors of at most half a turn [rad], shape (2, 24, 3)."""
_LIMITS = PROMISED_POSES.reshape(2, -1).tolist()


def within_promise(frame: SmplFrame, style: Sequence[float] | NDArray[np.floating] | None = None) -> bool:
    """Whether "nothing inside" is promised for a frame: its joints are within people's range, β and γ up to 3.

    `style` is the γ (4,) that is worn; None is the mean style.

    The promise has one more condition, which only the posed body can tell: `FrameStats.within_promise`.
    """
    pose: NDArray[np.floating] = frame.pose
    if not _is_in_range(pose):  # unless another vector of the same rotation is within
        angle = np.linalg.norm(pose.astype(np.float64), axis=1, keepdims=True)
        turns = np.round(angle / (2 * np.pi))
        pose = pose * (1 - 2 * np.pi * turns / np.maximum(angle, 1e-9))
        if not _is_in_range(pose):
            return False
    # Together they turn no farther than the sum of their angles, which is enough to decide most frames.
    if sum(math.hypot(*turn) for turn in pose[SPINE].tolist()) > PROMISED_BEND and spine_bend(pose) > PROMISED_BEND:
        return False
    sizes = map(abs, (*frame.betas.tolist(), *(() if style is None else style)))
    return float(max(sizes)) <= PROMISED_SIZE


def _is_in_range(pose: NDArray[np.floating]) -> bool:
    # Within a frame caches are cold: going through 72 numbers in Python is faster than NumPy's few functions.
    numbers, (low, high) = pose.ravel().tolist(), _LIMITS
    return all(map(operator.le, low, numbers)) and all(map(operator.le, numbers, high))


def spine_bend(pose: NDArray[np.floating]) -> float:
    """The angle by which the joints of the spine turn the chest against the hips [rad], of a pose (24, 3) [rad]."""
    spine = Rotation.from_rotvec(pose[SPINE])
    return float((spine[0] * spine[1] * spine[2]).magnitude())
