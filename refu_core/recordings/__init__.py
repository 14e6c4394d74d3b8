"""Recorded motion: one reader for what archives, pose estimators and motion capture write."""

from refu_core.recordings._layouts import SUFFIXES as SUFFIXES
from refu_core.recordings._layouts import is_named_as_motion as is_named_as_motion
from refu_core.recordings._read import read_recording as read_recording
from refu_core.recordings._recording import FASTEST as FASTEST
from refu_core.recordings._recording import FPS_RANGE as FPS_RANGE
from refu_core.recordings._recording import MAX_FRAMES as MAX_FRAMES
from refu_core.recordings._recording import Recording as Recording
from refu_core.recordings._recording import interpolated as interpolated
from refu_core.recordings._recording import n_resampled as n_resampled
from refu_core.recordings._recording import not_finite as not_finite
from refu_core.recordings._rotations import LONGEST_TURN as LONGEST_TURN
from refu_core.recordings._upright import AXES as AXES
from refu_core.recordings._upright import PELVIS as PELVIS
from refu_core.recordings._upright import Axes as Axes
from refu_core.recordings._upright import axis_of as axis_of
from refu_core.recordings._upright import turn_from as turn_from
from refu_core.recordings._upright import upright_share as upright_share
from refu_core.recordings._upright import upright_turn as upright_turn
from refu_core.recordings._values import GENDERS as GENDERS
