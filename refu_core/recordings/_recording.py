"""One person's recorded motion, and the limits of its frame rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

FPS_RANGE = (1e-3, 10_000.0)
"""Lowest and highest frame rate of recordings and samples [1/s]: one in a quarter of an hour, and ten a millisecond."""
MAX_FRAMES = 1_000_000
"""Most frames of a clip: nine hours at 30 Hz."""
FASTEST, _FARTHEST = 12.0, 50.0
"""The fastest that people run [m/s], and the farthest they get from a recording's origin [m]. Translations in
centimetres exceed it."""
_JUMP = 0.75
"""A step of a frame that is farther and faster than people run is a jump [m]; trackers lose people there, too."""
_OF_OTHERS = "several people's rows? say whose each is in a column, track_id; or the tracker lost the person there"


@dataclass(frozen=True, eq=False)
class Recording:
    """One person moving, sampled evenly, in SMPL's axes (y up) unless the reader was told to keep the file's axes."""

    poses: NDArray[np.float32]
    """Rotation vectors of SMPL's joints [rad], shape (T, 24, 3); real recordings have frames that aren't finite."""
    transl: NDArray[np.float64]
    """Translations [m], shape (T, 3)."""
    betas: NDArray[np.float32]
    """Shape coefficients, shape (10,)."""
    fps: float
    """Frames a second."""
    gender: str = "neutral"
    """male, female or neutral: which shape space the betas belong to."""
    notes: tuple[str, ...] = ()
    """What was assumed, left out or turned: one sentence each, to be shown to whoever supplied the file."""
    is_fitted: bool = False
    """Whether the betas were fitted to the body that will be dressed, and so are in its own shape space."""


def check_fps(fps: float) -> float:
    """The frame rate. Raises `ValueError` for one outside `FPS_RANGE`."""
    low, high = FPS_RANGE
    if not low <= fps <= high:
        raise ValueError(f"wanted a frame rate in [{low:g}, {high:g}], got {fps:g}; --fps says it otherwise")
    return float(fps)


def n_resampled(n: int, fps: float, wanted: float) -> int:
    """How many frames `n` at `fps` become at the rate `wanted`. Raises `ValueError` for more than `MAX_FRAMES`."""
    count = int((n - 1) / fps * check_fps(wanted) + 1e-9) + 1
    if count > MAX_FRAMES:
        msg = f"{n} frames at {fps:g} Hz are {count} at {wanted:g} Hz, at most {MAX_FRAMES} are made; cut the clip"
        raise ValueError(msg)
    return count


def interpolated(
    poses: NDArray[np.floating], transl: NDArray[np.floating], at: NDArray[Any], wanted: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Motion at the `wanted` times (N,), between the ascending times `at` (T,) for which it is known.

    Poses (T, J, 3) [rad] are interpolated on the shorter arc, and transl (T, 3) [m] along straight lines. Components of
    rotation vectors aren't interpolated one by one: they may jump by 2 pi between frames.
    """
    if len(at) == 1:
        n = len(wanted)
        return np.repeat(poses.astype(np.float64), n, axis=0), np.repeat(transl.astype(np.float64), n, axis=0)
    joints = [Slerp(at, Rotation.from_rotvec(joint))(wanted).as_rotvec() for joint in poses.swapaxes(0, 1)]
    return np.stack(joints, 1), np.stack([np.interp(wanted, at, along) for along in transl.T], 1)


def not_finite(poses: NDArray[np.floating], transl: NDArray[np.floating]) -> NDArray[np.intp]:
    """The numbers of the frames in which poses (T, J, 3) or transl (T, 3) have NaN or infinity."""
    return np.flatnonzero(~(np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(transl).all(axis=1)))


def tell_pace(transl: NDArray[np.float64], rate: float, notes: list[str], *, has_unit: bool = False) -> None:
    """Adds a note if translations (T, 3) [m], at `rate` frames a second, can't be one person's in metres.

    Whose legs have shown the unit (`has_unit`) may be anywhere.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        steps, away = np.linalg.norm(np.diff(transl, axis=0), axis=1), np.linalg.norm(transl, axis=1)
    is_known, away = np.isfinite(steps), away[np.isfinite(away)]
    pace = rate * float(np.median(steps[is_known])) if is_known.any() else 0.0
    far = float(np.median(away)) if len(away) else 0.0
    jumps = np.flatnonzero(is_known & (steps > max(_JUMP, FASTEST / rate)))
    if pace > FASTEST and far <= _FARTHEST and _is_to_and_fro(transl, pace / rate):
        notes.append(f"the person jumps to and fro by {pace / rate:.1f} m: {_OF_OTHERS}")
    elif has_unit and pace > FASTEST:
        notes.append(f"the person moves by {pace:.1f} m/s: is it {rate:g} frames a second?")
    elif not has_unit and (pace > FASTEST or far > _FARTHEST):
        notes.append(
            f"the person moves by {pace:.1f} m/s, {far:.0f} m from the origin: divide the translation by 100 or 1000 "
            "if it is in cm or mm"
        )
    elif len(jumps):
        often = f" and {len(jumps) - 1} times later" if len(jumps) > 1 else ""
        notes.append(f"the person jumps by {steps[jumps[0]]:.1f} m after frame {jumps[0]}{often}: {_OF_OTHERS}")


def _is_to_and_fro(transl: NDArray[np.float64], step: float) -> bool:
    """Whether two frames lead about as far as one, a `step` [m]: a person who walks gets twice as far."""
    with np.errstate(over="ignore", invalid="ignore"):
        twice = np.linalg.norm(transl[2:] - transl[:-2], axis=1)
    twice = twice[np.isfinite(twice)]
    return bool(len(twice)) and float(np.median(twice)) < 1.5 * step
