"""Continuous motion for sequences: stretches of recorded clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from refu_core.errors import SimulationError
from refu_core.simulation._poses import Clip, mirrored, without_heading

FPS = 30
"""Frames of a sequence [1/s]."""
STEPS = 2
"""Simulated frames per frame of the sequence."""
_SMOOTH = 2.0  # simulated frames: standard deviation of the low-pass on recorded translations, which jitter
_MOST_ACCELERATION = 20.0  # [m/s²]: as in a jump; more is an error of the recording


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A stretch of a clip as n simulated frames, `STEPS` per frame of the sequence."""

    poses: NDArray[np.float32]
    """Rotation vectors [rad], shape (n, 24, 3); the first one faces +z."""
    transl: NDArray[np.float64]
    """Translations [m], shape (n, 3); x and z start at 0."""
    clip: int
    """Number of the clip."""
    start: float
    """Where in the clip it starts [s]."""
    mirrored: bool
    """Whether left and right are exchanged."""

    def acceleration(self) -> NDArray[np.float64]:
        """Acceleration of the root, smoothed and limited [m/s²], shape (n, 3)."""
        if len(self.transl) < 3:
            return np.zeros_like(self.transl)
        smooth = gaussian_filter1d(self.transl, _SMOOTH, axis=0, mode="nearest")
        second = np.gradient(np.gradient(smooth, axis=0), axis=0) * (FPS * STEPS) ** 2
        size = np.linalg.norm(second, axis=1, keepdims=True)
        limited: NDArray[np.float64] = second * np.minimum(1, _MOST_ACCELERATION / np.maximum(size, 1e-9))
        return limited


def n_steps(n_frames: int) -> int:
    """Simulated frames of a sequence of `n_frames`: its frames and those between them."""
    return (n_frames - 1) * STEPS + 1


def draw_motion(clips: Sequence[Clip], n_frames: int, rng: np.random.Generator) -> DrawnMotion:
    """A stretch of `n_frames` at `FPS` of one of the clips, mirrored or not.

    Raises `SimulationError` when no clip is that long.
    """
    rate, n = FPS * STEPS, n_steps(n_frames)
    lengths = np.array([int((len(clip.poses) - 1) / clip.fps * rate + 1e-9) + 1 for clip in clips])
    long = np.flatnonzero(lengths >= n)
    if not len(long):
        got = f"{lengths.max() / rate:.1f} s" if len(lengths) else "none"
        msg = (
            f"wanted motions of {n_frames / FPS:g} s at least in training and test, the longest has {got}: ask for less"
        )
        raise SimulationError(msg)
    weights = np.sqrt(lengths[long])
    which = int(rng.choice(long, p=weights / weights.sum()))
    first = int(rng.integers(lengths[which] - n + 1))
    mirror = bool(rng.random() < 0.5)
    clip = clips[which].resampled(rate)
    poses, transl = clip.poses[first : first + n], clip.transl[first : first + n].copy()
    if mirror:
        poses = np.stack([mirrored(pose) for pose in poses])
        transl[:, 0] *= -1
    poses = poses.copy()
    root = Rotation.from_rotvec(poses[:, 0].astype(np.float64))
    heading = Rotation.from_rotvec(without_heading(poses[0])[0].astype(np.float64)) * root[0].inv()
    poses[:, 0] = (heading * root).as_rotvec()
    transl -= transl[0] * (1, 0, 1)
    return DrawnMotion(poses, heading.apply(transl), which, first / rate, mirror)
