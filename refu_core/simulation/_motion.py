"""Continuous motion for sequences: stretches of recorded clips, and room for the cloth that comes and goes smoothly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from refu_core.simulation._errors import SimulationError
from refu_core.simulation._poses import mirrored, without_heading

if TYPE_CHECKING:
    from refu_core.simulation._poses import Clip, RoomMaker

FPS = 30
"""Frames of a sequence [1/s]."""
STEPS = 2
"""Simulated frames a frame of the sequence."""
_ROOM_EVERY = 2 * STEPS  # simulated frames between two looks for room
_ROOM_REACH = 20  # simulated frames before and after a narrow place in which a limb moves aside and back
_SMOOTH = 2.0  # simulated frames: standard deviation of the low-pass on recorded translations, which jitter
_MOST_ACCELERATION = 20.0  # [m/s²]: what a jump has; more is a fault of the recording


@dataclass(frozen=True, eq=False)
class DrawnMotion:
    """A stretch of a clip, at `STEPS` simulated frames a frame: n of them."""

    poses: NDArray[np.float32]
    """Rotation vectors [rad], shape (n, 24, 3); the first one faces +z."""
    transl: NDArray[np.float64]
    """Translations [m], shape (n, 3); x and z start at 0."""
    clip: int
    """Number of the clip."""
    start: float
    """Where in the clip it starts [s]."""
    mirrored: bool
    """Left and right are exchanged."""

    def acceleration(self) -> NDArray[np.float64]:
        """Of the root [m/s²], shape (n, 3)."""
        if len(self.transl) < 3:
            return np.zeros_like(self.transl)
        smooth = gaussian_filter1d(self.transl, _SMOOTH, axis=0, mode="nearest")
        second = np.gradient(np.gradient(smooth, axis=0), axis=0) * (FPS * STEPS) ** 2
        size = np.linalg.norm(second, axis=1, keepdims=True)
        limited: NDArray[np.float64] = second * np.minimum(1, _MOST_ACCELERATION / np.maximum(size, 1e-9))
        return limited


def n_steps(n_frames: int) -> int:
    """Simulated frames of a sequence of `n_frames`: its frames and what lies between them."""
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


def make_room_for(
    room: RoomMaker, poses: NDArray[np.float32], betas: NDArray[np.floating], style: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]:
    """Holds limbs back through a motion (n, 24, 3), smoothly.

    Looked for frame by frame alone, room would come and go in steps, and the limbs with it. So each limb gets the
    smallest share of its way within a third of a second, low-passed by a window no longer than that: nowhere is it more
    than the frame has room for.

    Returns:
        The poses (n, 24, 3), the share of the most held-back limb (n,), and where there is no room all the same (n,).
    """
    shares, none = [], []
    share = np.ones(room.n_limbs)
    for pose in poses[::_ROOM_EVERY]:
        # From one look to the next a limb may come back by one step: to start anew at 1 would be slow, and jump.
        found = room.shares(pose, betas, style, start=np.minimum(1, share + room.settings.step))
        none.append(found is None)
        share = share if found is None else found
        shares.append(share)
    n = len(poses)
    window = np.hanning(2 * _ROOM_REACH + 3)[1:-1]
    each = np.repeat(np.stack(shares), _ROOM_EVERY, axis=0)[:n]
    least = minimum_filter1d(each, 2 * (_ROOM_REACH + _ROOM_EVERY) + 1, axis=0, mode="nearest")
    smooth = convolve1d(least, window / window.sum(), axis=0, mode="nearest")
    held = np.stack([room.held_back(pose, s) for pose, s in zip(poses, smooth, strict=True)])
    return held, smooth.min(1), np.repeat(none, _ROOM_EVERY)[:n]
