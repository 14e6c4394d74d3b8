"""A motion that needs no recording."""

from __future__ import annotations

import numpy as np

from msg_adapters.joints import SMPL_JOINTS
from msg_adapters.motion import Motion
from msg_adapters.rotations import quaternion_from_rotvec, quaternion_product, rotvec_from_quaternion

MARCH_FPS = 30.0
_STEPS_S = 1.2
_ROOT_HEIGHT_M = 1.156  # of the built-in male body's root above its soles


def march() -> Motion:
    """Steps on the spot with swinging arms, in SMPL axes; the end joins the beginning."""
    t = np.arange(round(2 * _STEPS_S * MARCH_FPS)) / (2 * _STEPS_S * MARCH_FPS) * 2 * np.pi
    pose = np.zeros((len(t), len(SMPL_JOINTS), 3))
    x, z = np.eye(3)[[0, 2]]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        lift = np.maximum(sign * np.sin(t), 0) ** 2  # one leg always stands, straight
        pose[:, SMPL_JOINTS.index(f"{side}_hip"), 0] = -0.9 * lift
        pose[:, SMPL_JOINTS.index(f"{side}_knee"), 0] = 1.3 * lift
        pose[:, SMPL_JOINTS.index(f"{side}_ankle"), 0] = -0.4 * lift  # the sole stays level
        down = quaternion_from_rotvec(np.broadcast_to(-sign * 1.15 * z, (len(t), 3)))
        swing = quaternion_from_rotvec((0.5 * sign * np.sin(t))[:, None] * x)
        pose[:, SMPL_JOINTS.index(f"{side}_shoulder")] = rotvec_from_quaternion(quaternion_product(swing, down))
        pose[:, SMPL_JOINTS.index(f"{side}_elbow"), 1] = -sign * 0.4
    pose[:, SMPL_JOINTS.index("spine2"), 1] = 0.12 * np.sin(t)
    transl = np.tile([0.0, _ROOT_HEIGHT_M, 0.0], (len(t), 1))
    return Motion(pose.astype(np.float32), transl, np.zeros(10, np.float32), MARCH_FPS)
