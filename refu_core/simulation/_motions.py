"""What a sequence shows: a stretch of a recorded motion, or a synthetic one that goes through drawn poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from refu_core.errors import SimulationError
from refu_core.recordings import interpolated
from refu_core.simulation._poses import Clip, drawn_pose, mirrored, without_heading
from refu_core.simulation._store import FPS

STEPS = 2
"""Simulated frames per frame of the sequence."""
RATE = FPS * STEPS
"""Simulated frames a second."""
_SMOOTH = 2.0  # simulated frames: standard deviation of the low-pass on recorded translations, which jitter
_MOST_ACCELERATION = 20.0  # [m/s²]: as in a jump; more is an error of the recording

# With these, synthetic people turn shoulders and hips at 1.9 and 0.9 rad/s (median; 1.2 and 1.3 in recorded motion).
# The root accelerates by 1.4 m/s² (1.4), and by over 3.2 in a tenth of the time (5.2).
_PACE = 4.0  # [rad/s], median of the fastest joint's speed from pose to pose
_PACE_SPREAD = 0.5  # standard deviation of its logarithm
_SHORTEST = 0.2  # [s] from pose to pose
_TURN = 0.7  # [rad], standard deviation of the turn about the vertical from pose to pose
_SPEED = np.array([0.5, 0.3, 0.5])  # [m/s], standard deviations of the root's velocity; y is up
_ROUNDED = 0.06  # [s], standard deviation of the low-pass that rounds off corners
_OF_CLIPS, _OF_POSTURES = 0.5, 0.25  # shares of poses that are frames of clips, and varied postures


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A motion of n simulated frames, `STEPS` per frame of the sequence."""

    poses: NDArray[np.float32]
    """Rotation vectors [rad], shape (n, 24, 3); the first one faces +z."""
    transl: NDArray[np.float64]
    """Translations [m], shape (n, 3); x and z start at 0."""
    clip: int = -1
    """Number of the clip; -1 for a synthetic motion."""
    start: float = 0.0
    """Where in the clip it starts [s]."""
    mirrored: bool = False
    """Whether left and right of the clip are exchanged."""

    def acceleration(self) -> NDArray[np.float64]:
        """Acceleration of the root, smoothed and limited [m/s²], shape (n, 3)."""
        if len(self.transl) < 3:
            return np.zeros_like(self.transl)
        smooth = gaussian_filter1d(self.transl, _SMOOTH, axis=0, mode="nearest")
        second = np.gradient(np.gradient(smooth, axis=0), axis=0) * RATE**2
        size = np.linalg.norm(second, axis=1, keepdims=True)
        limited: NDArray[np.float64] = second * np.minimum(1, _MOST_ACCELERATION / np.maximum(size, 1e-9))
        return limited


def n_steps(n_frames: int) -> int:
    """Simulated frames of a sequence of `n_frames`: its frames and those between them."""
    return (n_frames - 1) * STEPS + 1


def recorded_motion(clips: Sequence[Clip], n_frames: int, rng: np.random.Generator) -> DrawnMotion:
    """A stretch of `n_frames` at `FPS` of one of the clips, mirrored or not.

    Raises `SimulationError` when no clip is that long.
    """
    n = n_steps(n_frames)
    lengths = np.array([int((len(clip.poses) - 1) / clip.fps * RATE + 1e-9) + 1 for clip in clips])
    long = np.flatnonzero(lengths >= n)
    if not len(long):
        got = f"{lengths.max() / RATE:.1f} s" if len(lengths) else "none"
        wanted = f"motions of {n_frames / FPS:g} s at least in training and test"
        raise SimulationError(f"wanted {wanted}, the longest has {got}: ask for less")
    weights = np.sqrt(lengths[long])
    which = int(rng.choice(long, p=weights / weights.sum()))
    first = int(rng.integers(lengths[which] - n + 1))
    mirror = bool(rng.random() < 0.5)
    clip = clips[which].resampled(RATE)
    poses, transl = clip.poses[first : first + n], clip.transl[first : first + n]
    if mirror:
        poses, transl = mirrored(poses), transl * (-1, 1, 1)
    return DrawnMotion(*_facing_forward(poses, transl), which, first / RATE, mirror)


def synthetic_motion(clips: Sequence[Clip], n_frames: int, rng: np.random.Generator) -> DrawnMotion:
    """A motion of `n_frames` at `FPS` from pose to pose, each a clip's, a varied posture or within joints' limits.

    A network learns the motions of a few minutes' recordings by heart; between drawn poses there is no end of them.
    """
    n = n_steps(n_frames)

    def drawn() -> NDArray[np.float64]:
        return drawn_pose(clips, rng, recorded_share=_OF_CLIPS, posture_share=_OF_POSTURES)[0].astype(np.float64)

    keys, at, heading = [drawn()], [0.0], 0.0
    while at[-1] * RATE < n:
        pose = drawn()
        heading += _TURN * rng.standard_normal()
        pose[0] = (Rotation.from_euler("y", heading) * Rotation.from_rotvec(pose[0])).as_rotvec()
        angles = (Rotation.from_rotvec(keys[-1]).inv() * Rotation.from_rotvec(pose)).magnitude()
        pace = _PACE * np.exp(_PACE_SPREAD * rng.standard_normal())
        at.append(at[-1] + max(float(angles.max()) / pace, _SHORTEST))
        keys.append(pose)
    velocities = _SPEED * rng.standard_normal((len(at), 3))
    poses, velocity = interpolated(np.stack(keys), velocities, np.array(at), np.arange(n) / RATE)
    matrices = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(n, -1)
    poses = Rotation.from_matrix(_rounded(matrices).reshape(-1, 3, 3)).as_rotvec().reshape(poses.shape)
    return DrawnMotion(*_facing_forward(poses, np.cumsum(_rounded(velocity), axis=0) / RATE))


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return gaussian_filter1d(values, _ROUNDED * RATE, axis=0, mode="nearest")


def _facing_forward(
    poses: NDArray[np.floating], transl: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """A motion (n, 24, 3) [rad], (n, 3) [m], turned and moved so that it starts above the origin and faces +z."""
    root = Rotation.from_rotvec(poses[:, 0].astype(np.float64))
    turn = Rotation.from_rotvec(without_heading(poses[0])[0].astype(np.float64)) * root[0].inv()
    turned = poses.astype(np.float32)
    turned[:, 0] = (turn * root).as_rotvec()
    return turned, turn.apply(transl - transl[0] * (1, 0, 1))
