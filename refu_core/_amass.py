"""Recorded motion as AMASS keeps it: an `.npz` with `poses`, `trans`, `betas`, a frame rate and a gender."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from refu_core._npz import read_npz
from refu_core.frames import N_BETAS, N_JOINTS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from refu_core.errors import RefuError

FPS_RANGE = (1e-3, 10_000.0)
"""Frames a second that anything is recorded or sampled at: a frame in a quarter of an hour, and ten a millisecond."""
MAX_FRAMES = 1_000_000
"""Of a clip: nine hours at 30 Hz."""
_POSE_COLUMNS = (72, 156, 165)  # SMPL, SMPL-H, SMPL-X
_BODY_JOINTS = 22  # what the three models share; SMPL's two hand joints have no counterpart in the others
_RATES = ("mocap_framerate", "mocap_frame_rate")
_WANTED = "an AMASS-style .npz with poses, trans, betas, mocap_framerate"


class AmassRecording(NamedTuple):
    """One person moving, sampled evenly."""

    poses: NDArray[np.float32]
    """Rotation vectors of SMPL's joints [rad], shape (T, 24, 3); recordings do have frames that aren't finite."""
    transl: NDArray[np.float64]
    """Translations [m], shape (T, 3)."""
    betas: NDArray[np.float32]
    """Shape coefficients, shape (10,)."""
    fps: float
    """Frames a second."""
    gender: str


def read_recording(path: str | Path, *, error: type[RefuError]) -> AmassRecording:
    """Reads the motion of a file.

    `poses` (T, 72 | 156 | 165) [rad] is SMPL's, SMPL-H's or SMPL-X's: of the last two the 22 body joints are taken and
    SMPL's two hand joints stay at rest. `trans` (T, 3) [m] and `betas` are optional; the frame rate isn't.

    Raises:
        error: the file can't be read, or its arrays are of other shapes or types.
    """
    path = Path(path)
    arrays = read_npz(path, keys=("poses", "trans", "betas", "gender", *_RATES), error=error, wanted=_WANTED)
    try:
        poses = _poses(arrays)
        return AmassRecording(poses, _transl(arrays, len(poses)), _betas(arrays), _fps(arrays), _gender(arrays))
    except ValueError as cause:
        msg = f"{path}: {cause}"
        raise error(msg) from cause


def check_fps(fps: float) -> float:
    """The frame rate. Raises `ValueError` for one outside `FPS_RANGE`."""
    low, high = FPS_RANGE
    if not low <= fps <= high:
        msg = f"wanted a frame rate (mocap_framerate) in [{low:g}, {high:g}], got {fps:g}"
        raise ValueError(msg)
    return float(fps)


def n_resampled(n: int, fps: float, wanted: float) -> int:
    """Frames that `n` frames at `fps` become at the rate `wanted`. Raises `ValueError` for more than `MAX_FRAMES`."""
    count = int((n - 1) / fps * check_fps(wanted) + 1e-9) + 1
    if count > MAX_FRAMES:
        msg = f"{n} frames at {fps:g} Hz are {count} at {wanted:g} Hz, at most {MAX_FRAMES} are made; cut the clip"
        raise ValueError(msg)
    return count


def _numbers(arrays: Mapping[str, NDArray[Any]], key: str, kinds: str = "iuf") -> NDArray[Any]:
    array = arrays[key]
    if array.dtype.kind not in kinds:
        msg = f"{key} must be numbers{' with a fraction' if kinds == 'f' else ''}, got {array.dtype} {array.shape}"
        raise ValueError(msg)
    return array


def _poses(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """SMPL's 24 joints of any of the three layouts."""
    if "poses" not in arrays:
        msg = f"no poses, that is no array 'poses'; wanted {_WANTED}"
        raise ValueError(msg)
    poses = arrays["poses"]
    if poses.ndim != 2 or poses.shape[1] not in _POSE_COLUMNS or not len(poses):
        columns = " | ".join(map(str, _POSE_COLUMNS))
        msg = f"poses must be (T, {columns}) with T > 0, got {poses.shape}"
        raise ValueError(msg)
    poses = _numbers(arrays, "poses", "f")
    n = N_JOINTS if poses.shape[1] == N_JOINTS * 3 else _BODY_JOINTS
    result = np.zeros((len(poses), N_JOINTS, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # becomes inf or NaN, which the frame refuses
        result[:, :n] = poses[:, : n * 3].reshape(len(poses), n, 3)
    return result


def _transl(arrays: Mapping[str, NDArray[Any]], n: int) -> NDArray[np.float64]:
    if "trans" not in arrays:
        return np.zeros((n, 3))
    transl = _numbers(arrays, "trans")
    if transl.shape != (n, 3):
        msg = f"trans must be ({n}, 3) like poses, got {transl.shape}"
        raise ValueError(msg)
    return transl.astype(np.float64)


def _betas(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """The first 10 coefficients; the mean shape's zeros where there are fewer."""
    betas = np.zeros(N_BETAS, np.float32)
    if "betas" in arrays:
        given = np.atleast_1d(_numbers(arrays, "betas"))
        if given.ndim != 1:
            msg = f"betas must be one row of coefficients, got {given.shape}"
            raise ValueError(msg)
        with np.errstate(over="ignore"):
            betas[: len(given)] = given[:N_BETAS]
        if not np.isfinite(betas).all():
            msg = "betas has values that are NaN or infinite, or too large for float32"
            raise ValueError(msg)
    return betas


def _fps(arrays: Mapping[str, NDArray[Any]]) -> float:
    key = next((key for key in _RATES if key in arrays), None)
    if key is None or _numbers(arrays, key).size != 1:
        msg = f"no frame rate; wanted one number {_RATES[0]}"
        raise ValueError(msg)
    return check_fps(arrays[key].item())


def _gender(arrays: Mapping[str, NDArray[Any]]) -> str:
    gender = arrays["gender"].reshape(-1)[:1].tolist() if "gender" in arrays else []
    word = gender[0] if gender else "neutral"
    return word.decode("utf-8", "replace") if isinstance(word, bytes) else str(word)
