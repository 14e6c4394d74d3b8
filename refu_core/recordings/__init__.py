"""Recorded motion: one reader for what archives, pose estimators and motion capture write."""

from refu_core.recordings._rate import FPS_RANGE, MAX_FRAMES, n_resampled
from refu_core.recordings._recording import SUFFIXES, Recording, read_recording
from refu_core.recordings._upright import AXES, Axes, axis_of, upright_share, upright_turn

__all__ = [
    "AXES",
    "FPS_RANGE",
    "MAX_FRAMES",
    "SUFFIXES",
    "Axes",
    "Recording",
    "axis_of",
    "n_resampled",
    "read_recording",
    "upright_share",
    "upright_turn",
]
