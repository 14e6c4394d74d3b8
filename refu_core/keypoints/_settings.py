"""The tuned numbers of the filter."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """The tuned numbers, on ten clips of CMU at 30 and 60 Hz; `docs/guide/inputs.md` has what comes of them."""

    smoothing: float = 1.0
    """How much smoother than the most likely motion: accelerations are believed this many times smaller."""
    noise: float = 0.01
    """Standard deviation of a keypoint along each axis that a track begins with [m]; it follows what it sees."""
    least_noise: float = 0.004
    """[m]"""
    most_noise: float = 0.06
    """[m]"""
    offset_noise: float = 0.01
    """What is added for keypoints beside a joint, whose places differ between people and trackers [m]."""
    push: float = 5.0
    """Power of the pelvis's acceleration [m²/s³]: about 9 m/s² for 60 ms."""
    twist: float = 80.0
    """Power of the joints' angular acceleration [rad²/s³]: about 35 rad/s² for 60 ms."""
    growth: float = 1e-3
    """Power of the betas' drift [1/s]: 0.03 in a second, for the first guess may be wrong."""
    rest_after: float = 0.1
    """A joint that isn't seen comes to rest in about this time [s]."""
    coast: float = 0.2
    """A rate of what isn't seen dies away in this time [s]."""
    outlier: float = 3.0
    """A keypoint so many deviations off has half the weight, and soon none."""
    hold: float = 0.5
    """A person of whom nothing is seen for so long isn't there [s]."""
    doubt: float = 1.0
    """Left and right, or a pose that doesn't fit, are believed after so long of it [s]."""
    jump: float = 0.75
    """Keypoints that are so far from the prediction are of somebody else [m]."""
    beta_step: float = 0.1
    """Betas that are sent change by this at least: each change costs the pipeline a few frames' time."""
    most_beta: float = 3.0
    """Betas stay within this."""
    steps: int = 2
    """Gauss-Newton steps a frame at most; a third one changes the error by a hundredth of a millimetre."""


DEFAULTS = TrackerSettings()
