"""Postures of everyday life that recorded walks lack: limbs on the body, arms overhead, sitting, kneeling, lying."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.simulation._poses import mirrored, without_heading
from refu_core.skeleton import JOINT_NAMES

Angles = Mapping[str, tuple[float, float, float]]


def _both(**left: tuple[float, float, float]) -> dict[str, tuple[float, float, float]]:
    """The given joints of the left side, and those of the right side as their mirror image."""
    return {
        f"{side}_{name}": (x, s * y, s * z)
        for side, s in (("left", 1), ("right", -1))
        for name, (x, y, z) in left.items()
    }


_HANGING = _both(shoulder=(18, -16, -83), elbow=(0, -9, 0))

POSTURES: Mapping[str, Angles] = {
    "hanging arms": _HANGING,
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
    "arms overhead": _both(collar=(0, 0, 22), shoulder=(8, -14, 62), elbow=(0, -15, 0)),
    "one arm overhead": {
        **_HANGING,
        "left_collar": (0, 0, 22),
        "left_shoulder": (8, -14, 62),
        "left_elbow": (0, -20, 0),
    },
    "hands behind the head": _both(collar=(0, 0, 12), shoulder=(-90, -32, 22), elbow=(0, -125, 0)),
    "hands behind the back": _both(shoulder=(67, 14, -72), elbow=(0, -70, 0)),
    "hand at the ear": {**_HANGING, "left_shoulder": (-67, 12, -68), "left_elbow": (0, -135, 0)},
    "reaching forward": _both(collar=(0, -10, 0), shoulder=(3, -75, -4), elbow=(0, -15, 0)),
    "bent to the floor": {
        "pelvis": (45, 0, 0),
        "spine1": (25, 0, 0),
        "spine2": (15, 0, 0),
        "spine3": (10, 0, 0),
        **_both(shoulder=(7, -75, -9), elbow=(0, -10, 0), hip=(-60, 0, 3), knee=(20, 0, 0)),
    },
    "kneeling": _both(shoulder=(18, -30, -76), elbow=(0, -35, 0), hip=(-10, 0, 6), knee=(95, 0, 0), ankle=(20, 0, 0)),
    "crawling": {
        "pelvis": (80, 0, 0),
        "neck": (-20, 0, 0),
        "head": (-15, 0, 0),
        **_both(shoulder=(0, -80, 0), elbow=(0, -10, 0), hip=(-75, 0, 4), knee=(85, 0, 0), ankle=(25, 0, 0)),
    },
    "lunge": {
        "left_hip": (-75, 0, 4),
        "left_knee": (80, 0, 0),
        "right_hip": (20, 0, -4),
        "right_knee": (55, 0, 0),
        **_both(shoulder=(10, -25, -70), elbow=(0, -40, 0)),
    },
    "cross-legged": _both(shoulder=(14, -30, -72), elbow=(0, -45, 0), hip=(-89, 80, -10), knee=(122, 0, 0)),
    "straddle": _both(shoulder=(12, -50, -40), elbow=(0, -15, 0), hip=(-78, 22, 40), knee=(8, 0, 0)),
    "deep lunge": {
        "left_hip": (-98, 0, 6),
        "left_knee": (98, 0, 0),
        "right_hip": (35, 0, -5),
        "right_knee": (25, 0, 0),
        **_both(shoulder=(10, -30, -60), elbow=(0, -50, 0)),
    },
    "side lunge": {
        "pelvis": (15, 0, 0),
        "left_hip": (-55, 15, 42),
        "left_knee": (92, 0, 0),
        "right_hip": (-12, 0, -40),
        **_both(shoulder=(0, -55, -45), elbow=(0, -55, 0)),
    },
    "high kick": {
        **_HANGING,
        "spine1": (8, 0, 0),
        "left_hip": (-98, 0, 5),
        "left_knee": (18, 0, 0),
        "right_hip": (6, 0, 0),
    },
    "side kick": {
        "pelvis": (0, 0, -20),
        "left_hip": (-18, 0, 45),
        "left_knee": (12, 0, 0),
        "right_hip": (0, 0, 18),
        **_both(shoulder=(0, -50, -40), elbow=(0, -80, 0)),
    },
    "hugging oneself": {
        "left_collar": (0, -12, 0),
        "right_collar": (0, 12, 0),
        "left_shoulder": (28, -78, -38),
        "left_elbow": (0, -105, 0),
        "right_shoulder": (14, 80, 28),
        "right_elbow": (0, 98, 0),
    },
    "lying on the back": {"pelvis": (-90, 0, 0), **_both(shoulder=(8, -10, -62), hip=(-8, 0, 8), knee=(12, 0, 0))},
    "lying on the belly": {
        "pelvis": (90, 0, 0),
        "neck": (-25, 0, 0),
        **_both(shoulder=(-18, 8, 38), elbow=(0, -75, 0), hip=(0, 0, 8)),
    },
    "lying on the side": {
        "pelvis": (0, 0, 90),
        "left_shoulder": (0, 0, 55),
        "right_shoulder": (18, 28, 68),
        "right_elbow": (0, 42, 0),
        **_both(hip=(-28, 0, 0), knee=(42, 0, 0)),
    },
}
"""By name: rotation vectors of joints [degrees], zero for those that aren't named; SMPL's axes, x to the left."""
SELF_TOUCHING = tuple(POSTURES)[:8]
"""The postures in which the skin intersects itself."""
FIRST_POSTURES = tuple(POSTURES)[:18]
"""The postures of plans that don't say which."""
_SPREAD = 8.0
"""Standard deviation of a drawn posture's joints about the named one, in each coordinate [degrees]."""
_STIFF = tuple(JOINT_NAMES.index(f"{side}_{name}") for side in ("left", "right") for name in ("foot", "wrist", "hand"))
"""Joints that affect no garment; they aren't varied."""


def posture(name: str) -> NDArray[np.float32]:
    """One of `POSTURES`, rotation vectors [rad], shape (24, 3). Raises `KeyError` for another name."""
    pose = np.zeros((len(JOINT_NAMES), 3), np.float32)
    for joint, angles in POSTURES[name].items():
        pose[JOINT_NAMES.index(joint)] = np.radians(angles)
    return pose


def drawn_posture(rng: np.random.Generator, names: Sequence[str]) -> tuple[NDArray[np.float32], int]:
    """One of the postures `names`, varied at random, mirrored or not, without heading; and its number in `POSTURES`.

    Rotation vectors [rad], shape (24, 3).
    """
    name = names[int(rng.integers(len(names)))]
    noise = np.radians(rng.normal(0.0, _SPREAD, (len(JOINT_NAMES), 3)))
    noise[_STIFF, :] = 0.0
    named = Rotation.from_rotvec(posture(name).astype(np.float64))
    pose = (Rotation.from_rotvec(noise) * named).as_rotvec().astype(np.float32)
    if rng.random() < 0.5:
        pose = mirrored(pose)
    return without_heading(pose), tuple(POSTURES).index(name)
