"""A few things that people do, for what has to fit in all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import N_JOINTS, SmplFrame
from refu_core.skeleton import JOINT_NAMES

if TYPE_CHECKING:
    from refu_core.realtime import GarmentPipeline

Turn = tuple[float, float, float]
_POSES: tuple[dict[str, Turn], ...] = (
    {},  # the T-pose
    {"left_shoulder": (0, 0, -1.15), "right_shoulder": (0, 0, 1.15)},  # stands
    {  # both arms overhead
        "left_shoulder": (0, 0, 0.95),
        "right_shoulder": (0, 0, -0.95),
        "left_collar": (0, 0, 0.3),
        "right_collar": (0, 0, -0.3),
    },
    {  # squats
        "left_hip": (-1.3, 0.2, 0.4),
        "right_hip": (-1.3, -0.2, -0.4),
        "left_knee": (1.7, 0, 0),
        "right_knee": (1.7, 0, 0),
        "spine1": (0.2, 0, 0),
        "left_shoulder": (0.2, 0, -0.7),
        "right_shoulder": (0.2, 0, 0.7),
    },
    {  # walks
        "left_hip": (-0.6, 0, 0.05),
        "right_hip": (0.35, 0, 0),
        "left_knee": (0.3, 0, 0),
        "right_knee": (0.6, 0, 0),
        "left_shoulder": (0.3, 0.1, -1.1),
        "right_shoulder": (-0.3, 0.3, 1.1),
        "spine2": (0, 0.15, 0),
        "left_elbow": (0, -0.4, 0),
        "right_elbow": (0, 0.5, 0),
    },
    {  # reaches forward
        "left_shoulder": (0, -0.9, -0.3),
        "right_shoulder": (0.2, 0, 1.2),
        "left_elbow": (0, -0.5, 0),
        "spine1": (0.15, 0.1, 0),
        "spine3": (0, 0.2, 0),
    },
    {  # one arm overhead, the other bent
        "left_shoulder": (0, 0, 1.0),
        "left_collar": (0, 0, 0.3),
        "spine2": (0, 0, -0.15),
        "right_shoulder": (0, 0.3, 1.15),
        "right_elbow": (0, 1.3, 0),
    },
    {  # a knee up, an arm across
        "left_shoulder": (0.3, -1.1, -0.9),
        "right_shoulder": (0, 0.2, 1.0),
        "left_elbow": (0, -1.5, 0),
        "right_elbow": (0, 0.8, 0),
        "left_hip": (-1.2, 0.1, 0.1),
        "left_knee": (1.3, 0, 0),
    },
    {  # bends over
        "spine1": (0.35, 0.1, 0),
        "spine2": (0.25, 0.1, 0),
        "spine3": (0.15, 0, 0),
        "left_hip": (-0.7, 0, 0.1),
        "right_hip": (-0.6, 0, -0.1),
        "left_knee": (0.5, 0, 0),
        "right_knee": (0.4, 0, 0),
        "left_shoulder": (0, -0.6, -1.0),
        "right_shoulder": (0, 0.8, 0.9),
    },
    {  # sits
        "left_hip": (-1.5, 0, 0.15),
        "right_hip": (-1.5, 0, -0.1),
        "left_knee": (1.5, 0, 0),
        "right_knee": (1.4, 0, 0),
        "left_shoulder": (0.2, -0.2, -1.2),
        "right_shoulder": (0.2, 0.4, 1.1),
        "right_elbow": (0, 1.2, 0),
    },
)  # rotation vectors [rad]


def practised(pipeline: GarmentPipeline, garment: str) -> NDArray[np.float64]:
    """A pipeline's garment as it is worn while somebody does these things [m], shape (P, V, 3)."""
    worn = []
    for turns in _POSES:
        pose = np.zeros((N_JOINTS, 3))
        for joint, turn in turns.items():
            pose[JOINT_NAMES.index(joint)] = turn
        # Not by calling it, whose last result is remembered for whoever asks the same again.
        worn.append(pipeline.adjusted(SmplFrame(pose=pose.astype(np.float32)), lambda dressed: dressed)[garment].local)
    return np.stack(worn).astype(np.float64)
