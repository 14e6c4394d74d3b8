"""3D keypoints of people to poses of SMPL: inverse kinematics and a filter in one, without torch."""

from refu_core.keypoints._layouts import LAYOUTS as LAYOUTS
from refu_core.keypoints._layouts import KeypointLayout as KeypointLayout
from refu_core.keypoints._layouts import keypoint_layout as keypoint_layout
from refu_core.keypoints._layouts import layout_of as layout_of
from refu_core.keypoints._people import MOST_PEOPLE as MOST_PEOPLE
from refu_core.keypoints._people import People as People
from refu_core.keypoints._pose import Proportions as Proportions
from refu_core.keypoints._pose import Skeleton as Skeleton
from refu_core.keypoints._solver import TrackerSettings as TrackerSettings
from refu_core.keypoints._tracker import KeypointTracker as KeypointTracker
