"""The tuned numbers of the filter."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """The numbers, tuned on ten clips of CMU at 30 and 60 Hz; `docs/guide/inputs.md` has the results."""

    smoothing: float = 1.0
    """How much smoother than the most likely motion: accelerations are taken to be this many times smaller."""
    noise: float = 0.01
    """Standard deviation of a keypoint along each axis at the start of a track [m]; it then adapts to what is seen."""
    least_noise: float = 0.004
    """[m]"""
    most_noise: float = 0.06
    """[m]"""
    offset_noise: float = 0.01
    """Noise added for keypoints beside a joint, whose places differ between people and trackers [m]."""
    push: float = 5.0
    """Power of the pelvis's acceleration [m²/s³]: about 9 m/s² for 60 ms."""
    twist: float = 80.0
    """Power of the joints' angular acceleration [rad²/s³]: about 35 rad/s² for 60 ms."""
    growth: float = 1e-3
    """Power of the betas' drift [1/s]: 0.03 in a second, since the first guess may be wrong."""
    rest_after: float = 0.1
    """A joint that isn't seen comes to rest in about this time [s]."""
    coast: float = 0.2
    """The rate of anything that isn't seen dies away in this time [s]."""
    outlier: float = 3.0
    """A keypoint this many deviations off has half the weight; farther off it soon has none."""
    hold: float = 0.5
    """A person of whom nothing is seen for this long is taken to have left [s]."""
    doubt: float = 1.0
    """Exchanged sides, or keypoints that don't fit the pose, are believed after this long [s]."""
    jump: float = 0.75
    """Keypoints farther than this from the prediction are somebody else's [m]."""
    beta_step: float = 0.1
    """New betas are sent only if they changed by this: each change costs the pipeline a few frames' time."""
    most_beta: float = 3.0
    """Betas stay within this."""
    steps: int = 2
    """Gauss-Newton steps a frame at most; a third one changes the error by a hundredth of a millimetre."""


DEFAULTS = TrackerSettings()
