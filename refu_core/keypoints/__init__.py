"""3D keypoints of people to poses of SMPL: inverse kinematics and a filter in one, without torch."""

from refu_core.keypoints._layouts import LAYOUTS, KeypointLayout, keypoint_layout
from refu_core.keypoints._pose import Proportions, Skeleton
from refu_core.keypoints._tracker import KeypointTracker, TrackerSettings

__all__ = [
    "LAYOUTS",
    "KeypointLayout",
    "KeypointTracker",
    "Proportions",
    "Skeleton",
    "TrackerSettings",
    "keypoint_layout",
]
