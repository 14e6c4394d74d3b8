"""Recorded motion as AMASS keeps it: an `.npz` with `poses`, `trans`, `betas`, a frame rate and a gender.

AMASS's own files have z up: encode their garments with `axes="frame"`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_adapters.cdr import NS_PER_S
from msg_adapters.errors import MotionFileError
from msg_adapters.rotations import quaternion_from_rotvec, rotvec_from_quaternion, slerp
from refu_core._npz import read_npz
from refu_core.frames import N_BETAS, N_JOINTS, SmplFrame

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_POSE_COLUMNS = (72, 156, 165)  # SMPL, SMPL-H, SMPL-X
_BODY_JOINTS = 22  # what the three models share; SMPL's two hand joints have no counterpart in the others
_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")
_KEYS = ("poses", "trans", "betas", "gender", *_RATE_KEYS)
_MAX_FPS = 10_000.0


@dataclass(frozen=True, eq=False)
class Motion:
    """One person moving, sampled evenly."""

    poses: NDArray[np.float32]
    """Rotation vectors of SMPL's joints [rad], shape (T, 24, 3)."""
    transl: NDArray[np.float64]
    """Translations [m], shape (T, 3)."""
    betas: NDArray[np.float32]
    """Shape coefficients, shape (10,)."""
    fps: float
    """Frames a second."""
    gender: str = "neutral"

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.poses)

    def frame(self, index: int, *, start_ns: int = 0) -> SmplFrame:
        """Frame `index`, stamped from `start_ns` on [ns].

        Raises `FrameError` (of `refu_core`) when its values aren't finite: recordings do have such frames.
        """
        stamp_ns = start_ns + round(index * NS_PER_S / self.fps)
        return SmplFrame(self.poses[index], betas=self.betas, transl=self.transl[index], stamp_ns=stamp_ns)

    def frames(self, *, start_ns: int = 0) -> Iterator[SmplFrame]:
        """All frames in order; raises as `frame` does."""
        return (self.frame(i, start_ns=start_ns) for i in range(len(self)))

    def resampled(self, fps: float) -> Motion:
        """The motion at another frame rate: rotations on the shorter arc, translations along straight lines.

        Components of rotation vectors aren't interpolated: they may jump by 2 pi between frames.
        Raises `MotionFileError` for a rate outside (0, 10000], and where a frame isn't finite.
        """
        _check_fps(fps, "resampled motion")
        bad = np.flatnonzero(~(np.isfinite(self.poses).all(axis=(1, 2)) & np.isfinite(self.transl).all(axis=1)))
        if bad.size:
            msg = (
                f"{bad.size} of {len(self)} frames aren't finite (the first: {bad[0]}); cut them out, or don't resample"
            )
            raise MotionFileError(msg)
        count = int(np.floor((len(self) - 1) / self.fps * fps + 1e-9)) + 1
        at = np.minimum(np.arange(count) * (self.fps / fps), len(self) - 1)
        before = np.minimum(at.astype(np.intp), max(len(self) - 2, 0))
        after = np.minimum(before + 1, len(self) - 1)
        fraction = at - before
        quaternions = quaternion_from_rotvec(self.poses)
        poses = rotvec_from_quaternion(slerp(quaternions[before], quaternions[after], fraction[:, None]))
        transl = self.transl[before] + fraction[:, None] * (self.transl[after] - self.transl[before])
        return Motion(poses.astype(np.float32), transl, self.betas, float(fps), self.gender)


def _check_fps(fps: float, path: Path | str) -> None:
    if not 0 < fps <= _MAX_FPS:
        msg = f"{path}: wanted a frame rate in (0, {_MAX_FPS:g}], got {fps:g}"
        raise MotionFileError(msg)


def _numbers(arrays: dict[str, NDArray[Any]], key: str, path: Path) -> NDArray[Any]:
    array = arrays[key]
    if not (np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)):
        msg = f"{path}: {key} must be numbers, got {array.dtype}"
        raise MotionFileError(msg)
    return array


def _smpl_poses(poses: NDArray[Any], path: Path) -> NDArray[np.float32]:
    """SMPL's 24 joints of any of the three layouts; hands of SMPL-H and SMPL-X are left at rest."""
    if poses.ndim != 2 or poses.shape[1] not in _POSE_COLUMNS or not len(poses):
        msg = f"{path}: poses must be (T, {' | '.join(map(str, _POSE_COLUMNS))}) with T > 0, got {poses.shape}"
        raise MotionFileError(msg)
    n = N_JOINTS if poses.shape[1] == N_JOINTS * 3 else _BODY_JOINTS
    result = np.zeros((len(poses), N_JOINTS, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # becomes inf or NaN, which the frame refuses
        result[:, :n] = poses[:, : n * 3].reshape(len(poses), n, 3)
    return result


def _betas(arrays: dict[str, NDArray[Any]], path: Path) -> NDArray[np.float32]:
    """The first 10 coefficients; the mean shape's zeros where there are fewer."""
    betas = np.zeros(N_BETAS, np.float32)
    if "betas" in arrays:
        given = np.atleast_1d(_numbers(arrays, "betas", path))
        if given.ndim != 1:
            msg = f"{path}: betas must be one row of coefficients, got {given.shape}"
            raise MotionFileError(msg)
        given = given[:N_BETAS]
        if not np.isfinite(given).all():
            msg = f"{path}: betas has values that are NaN or infinite"
            raise MotionFileError(msg)
        betas[: len(given)] = given
    return betas


def read_motion(path: str | Path, *, max_frames: int = 1_000_000) -> Motion:
    """Read an AMASS-style `.npz`.

    `poses` (T, 72 | 156 | 165) [rad] is SMPL's, SMPL-H's or SMPL-X's: of the last two the 22 body joints are taken and
    SMPL's two hand joints stay at rest. `trans` (T, 3) [m] and `betas` are optional; the frame rate isn't.

    Raises `MotionFileError` for a file that can't be read, or whose arrays are of other shapes.
    """
    path = Path(path)
    arrays = read_npz(path, keys=_KEYS, error=MotionFileError)
    if "poses" not in arrays:
        msg = f"{path}: no array 'poses'; wanted an AMASS-style file with poses, trans, betas, mocap_framerate"
        raise MotionFileError(msg)
    poses = _smpl_poses(_numbers(arrays, "poses", path), path)
    if len(poses) > max_frames:
        msg = f"{path}: {len(poses)} frames, at most {max_frames} are read; cut the clip"
        raise MotionFileError(msg)
    transl = np.zeros((len(poses), 3))
    if "trans" in arrays:
        transl = _numbers(arrays, "trans", path).astype(np.float64)
    if transl.shape != (len(poses), 3):
        msg = f"{path}: trans must be ({len(poses)}, 3) like poses, got {transl.shape}"
        raise MotionFileError(msg)
    rate_key = next((key for key in _RATE_KEYS if key in arrays), None)
    if rate_key is None or _numbers(arrays, rate_key, path).size != 1:
        msg = f"{path}: no frame rate; wanted one number mocap_framerate"
        raise MotionFileError(msg)
    fps = float(arrays[rate_key].reshape(-1)[0])
    _check_fps(fps, path)
    gender = arrays["gender"].reshape(-1)[:1].tolist() if "gender" in arrays else []
    name = (
        gender[0].decode("utf-8", "replace") if gender and isinstance(gender[0], bytes) else (gender or ["neutral"])[0]
    )
    return Motion(poses, transl, _betas(arrays, path), fps, str(name))
