"""3D keypoints of people to poses of SMPL: inverse kinematics and a filter in one, without torch."""

from refu_core.keypoints._layouts import LAYOUTS, KeypointLayout, keypoint_layout, layout_of
from refu_core.keypoints._people import People
from refu_core.keypoints._pose import Proportions, Skeleton
from refu_core.keypoints._settings import TrackerSettings
from refu_core.keypoints._tracker import KeypointTracker

__all__ = [
    "LAYOUTS",
    "KeypointLayout",
    "KeypointTracker",
    "People",
    "Proportions",
    "Skeleton",
    "TrackerSettings",
    "keypoint_layout",
    "layout_of",
]
