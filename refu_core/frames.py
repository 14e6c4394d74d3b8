"""The one description of a person that flows through the project."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from refu_core._numbers import NOT_NUMBERS, as_numbers, as_whole
from refu_core.errors import FrameError

N_JOINTS = 24
N_BETAS = 10
N_STYLES = 4
LAGS = (1 / 15, 2 / 15, 4 / 15, 8 / 15)
"""How far back the moments described by `SmplFrame.past` are [s]: cloth comes to rest within half a second, and the
latest motion counts most."""
N_PAST = 9 * N_JOINTS + 3
"""Numbers per lag: those of each joint's rotation, and of the root's place."""
_PAST = (len(LAGS), N_PAST)
# There are two levels of limits. A frame accepts whatever can be computed with, as a study may go beyond real bodies.
# A stream of messages has no such purpose, so a node refuses implausible values (`msg_adapters.check_plausible`): no
# sender means them.
MAX_ANGLE = 1e4
"""Rotation vectors have components up to this [rad]; in float32 larger ones no longer say which way a limb points."""
MAX_COEFFICIENT = 100.0
"""β and γ have components up to this: at 20 standard deviations a shape is no body any more; at 10,000 it is 500 m
long, and a signed distance that searches around it centimetre by centimetre would never end."""
PLAUSIBLE_ANGLE = 1e3
"""[rad]"""
PLAUSIBLE_COEFFICIENT = 20.0  # standard deviations
PLAUSIBLE_TRANSL = 1e9
"""[m]"""
_ABOUT_POSES = {
    63: "the 21 joints of a body without its root: put the root's rotation first, and 6 zeros last",
    66: "the 22 joints of a body without hands: append 6 zeros",
    69: "23 joints without the root: put its rotation first",
    156: "SMPL-H: take the first 66, and append 6 zeros",
    165: "SMPL-X: take the first 66, and append 6 zeros",
    96: "as quaternions? scipy's Rotation.from_quat(q) takes xyzw, then .as_rotvec()",
    144: "as 6D rotations? make them matrices, then scipy's Rotation.from_matrix(R).as_rotvec()",
    216: "as matrices? scipy's Rotation.from_matrix(R).as_rotvec()",
}
"""What arrays of so many numbers are, and what to do with them."""
SET_BACK_NS = 10**9
"""A stamp this much older than the one before tells that time was set back; one less old only comes late [ns]."""


def checked_numbers(
    name: str,
    value: Any,
    shape: tuple[int, ...],
    dtype: type[np.floating[Any]],
    limit: float = np.inf,
    advice: Mapping[int, str] = MappingProxyType({}),
) -> NDArray[Any]:
    """`value` as a read-only array of this shape; it may have it already, or be flat. No number exceeds `limit`.

    Raises `FrameError` for anything else, naming it `name`, with `advice` for an array of so many numbers.
    """
    try:
        array = as_numbers(value).astype(np.float64)
    except NOT_NUMBERS as error:
        raise FrameError(f"{name} must be {shape} numbers, got {type(value).__name__}: {error}") from error
    size = math.prod(shape)
    if array.size != size or array.shape not in (shape, (size,)):
        wanted = dict.fromkeys((shape, (size,)))
        msg = f"{name} must have the shape {' or '.join(map(str, wanted))}, got {array.shape}"
        hint = f"take the first {shape[0]}" if len(shape) == array.ndim == 1 and array.size > shape[0] else ""
        hint = advice.get(array.size, hint)
        msg += f": {hint}" if hint else ""
        raise FrameError(msg)
    largest = float(np.abs(array).max())  # NaN or infinite if any value is
    if not math.isfinite(largest):
        bad = int(np.count_nonzero(~np.isfinite(array)))
        msg = f"{name} has {bad} value{'s' if bad > 1 else ''} that {'are' if bad > 1 else 'is'} NaN or infinite"
        raise FrameError(msg)
    if largest > float(np.finfo(dtype).max):
        raise FrameError(f"{name} has values beyond the range of {np.dtype(dtype)}")
    if largest > limit:
        raise FrameError(f"{name} has magnitudes up to {largest:g}, wanted {limit:g} at most")
    array = array.reshape(shape).astype(dtype)  # always a copy: the frame owns its data
    array.setflags(write=False)
    return array


def _direction(name: str, value: ArrayLike) -> NDArray[np.float32]:
    """`value` as a read-only unit vector, shape (3,)."""
    given = checked_numbers(name, value, (3,), np.float64)
    with np.errstate(over="ignore"):  # an infinite length is no direction, either
        length = float(np.linalg.norm(given))
    if not 1e-6 <= length <= 1e6:
        raise FrameError(f"{name} must be a direction, of a length from 1e-6 to 1e6, got {value!r}")
    return checked_numbers(name, given / length, (3,), np.float32)


def _nanoseconds(name: str, value: Any) -> int:
    """`value` as a whole number."""
    try:
        return as_whole(value)
    except NOT_NUMBERS as error:
        raise FrameError(f"{name} must be a whole number of nanoseconds, got {value!r}") from error


@dataclass(frozen=True, eq=False, init=False)
class SmplFrame:
    """Parameters of one SMPL body at one time; validated, immutable, in SMPL axes (y up, z forward, left = +x).

    The root and `transl` may be in any other right-handed axes, as long as `up` says which way is up there.
    """

    pose: NDArray[np.float32]
    """Rotation vector of each joint relative to its parent, root first [rad], shape (24, 3)."""
    betas: NDArray[np.float32]
    """Shape coefficients in standard deviations, shape (10,)."""
    transl: NDArray[np.float64]
    """Added to the posed vertices [m], shape (3,); float64, so that a body far from the origin loses no precision."""
    style: NDArray[np.float32] | None
    """Garment style γ in standard deviations, shape (4,); None for the wearer's usual one."""
    stamp_ns: int
    """Time of the measurement [ns since the epoch of the sender's clock]."""
    up: NDArray[np.floating]
    """Direction away from the ground, in the axes of the root and `transl`: a unit vector, shape (3,). Cloth hangs the
    other way."""
    past: NDArray[np.float32] | None
    """How the person has moved until now, as `PoseHistory` describes it, shape (4, 219); None for no motion."""

    def __init__(
        self,
        pose: ArrayLike,
        betas: ArrayLike = (0.0,) * N_BETAS,
        transl: ArrayLike = (0.0, 0.0, 0.0),
        style: ArrayLike | None = None,
        stamp_ns: int = 0,
        up: ArrayLike = (0.0, 1.0, 0.0),
        past: ArrayLike | None = None,
    ) -> None:
        """A frame of these numbers, each in its field's shape or flat; `up` of any length from 1e-6 to 1e6.

        Raises `FrameError` when an array has a wrong number of elements, isn't finite, or is out of range.
        """
        vars(self).update(  # a frozen dataclass is filled once, here
            pose=checked_numbers("pose", pose, (N_JOINTS, 3), np.float32, MAX_ANGLE, _ABOUT_POSES),
            betas=checked_numbers("betas", betas, (N_BETAS,), np.float32, MAX_COEFFICIENT),
            transl=checked_numbers("transl", transl, (3,), np.float64),
            style=None if style is None else checked_numbers("style", style, (N_STYLES,), np.float32, MAX_COEFFICIENT),
            stamp_ns=_nanoseconds("stamp_ns", stamp_ns),
            up=_direction("up", up),
            past=None if past is None else checked_numbers("past", past, _PAST, np.float32, MAX_COEFFICIENT),
        )

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Checks a copy and makes it read-only, too: NumPy forgets that when it copies or pickles."""
        SmplFrame.__init__(self, **state)

    def __repr__(self) -> str:
        return f"SmplFrame(transl={self.transl.tolist()}, stamp_ns={self.stamp_ns})"


def pasts_of(frames: Sequence[SmplFrame]) -> NDArray[np.float32]:
    """The frames' pasts, shape (B, 4, 219); people in frames without one stand still."""
    still = np.zeros(_PAST, np.float32)
    return np.stack([still if frame.past is None else frame.past for frame in frames])
