"""The one description of a person that flows through the project."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import FrameError

N_JOINTS = 24
N_BETAS = 10
N_STYLES = 4
LAGS = (1 / 15, 2 / 15, 4 / 15, 8 / 15)
"""How far back the moments described by `SmplFrame.past` are [s]: cloth comes to rest within half a second, and the
latest motion counts most."""
N_PAST = 9 * N_JOINTS + 3
"""Numbers per lag: those of each joint's rotation, and of the root's place."""
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
PLAUSIBLE_COEFFICIENT = 20.0
PLAUSIBLE_TRANSL = 1e9
"""[m]"""


def checked_numbers(
    name: str, value: Any, shape: tuple[int, ...], dtype: type[np.floating[Any]], limit: float = np.inf
) -> NDArray[Any]:
    """`value` as a read-only array of numbers up to `limit`; accepts any layout with the right number of elements."""
    try:
        given = np.ma.asanyarray(value) if isinstance(value, np.ma.MaskedArray) else np.asarray(value)
        if given.dtype.kind not in "iufO":  # NumPy also turns booleans, text, dates and complex ones into numbers
            msg = f"values of the type {given.dtype}"
            raise TypeError(msg)
        array = np.ma.filled(given.astype(np.float64), np.nan)
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: a tensor that tracks gradients
        msg = f"{name} must be {shape} numbers, got {type(value).__name__}: {error}"
        raise FrameError(msg) from error
    size = math.prod(shape)
    if array.size != size or array.shape not in (shape, (size,)):
        wanted = dict.fromkeys((shape, (size,)))
        msg = f"{name} must have the shape {' or '.join(map(str, wanted))}, got {array.shape}"
        msg += f": take the first {shape[0]}" if len(shape) == array.ndim == 1 and array.size > shape[0] else ""
        raise FrameError(msg)
    largest = float(np.abs(array).max())  # NaN or infinite if any value is
    if not math.isfinite(largest):
        bad = int(np.count_nonzero(~np.isfinite(array)))
        msg = f"{name} has {bad} value{'s' if bad > 1 else ''} that {'are' if bad > 1 else 'is'} NaN or infinite"
        raise FrameError(msg)
    if largest > float(np.finfo(dtype).max):
        msg = f"{name} has values beyond the range of {np.dtype(dtype)}"
        raise FrameError(msg)
    if largest > limit:
        msg = f"{name} has magnitudes up to {largest:g}, wanted {limit:g} at most"
        raise FrameError(msg)
    array = array.reshape(shape).astype(dtype)  # always a copy: the frame owns its data
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class SmplFrame:
    """Parameters of one SMPL body at one time; validated, immutable, in SMPL axes (y up, z forward, left = +x).

    The root and `transl` may be in any other right-handed axes, as long as `up` says which way is up there.

    Raises `FrameError` when an array has a wrong number of elements, isn't finite, or is out of range.
    """

    pose: NDArray[np.float32]
    """Rotation vector of each joint relative to its parent, root first [rad], shape (24, 3) (or flat, (72,))."""
    betas: NDArray[np.float32] = field(default_factory=lambda: np.zeros(N_BETAS, np.float32))
    """Shape coefficients in standard deviations, shape (10,)."""
    transl: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """Added to the posed vertices [m], shape (3,); float64, so that a body far from the origin loses no precision."""
    style: NDArray[np.float32] | None = None
    """Garment style γ in standard deviations, shape (4,); None for the wearer's usual one."""
    stamp_ns: int = 0
    """Time of the measurement [ns since the epoch of the sender's clock]."""
    up: NDArray[np.floating] = field(default_factory=lambda: np.array([0, 1, 0], np.float32))
    """Direction away from the ground, in the axes of the root and `transl`, shape (3,); of a length from 1e-6 to
    1e6, kept as a unit vector. Cloth hangs the other way."""
    past: NDArray[np.float32] | None = None
    """How the person has moved until now, as `PoseHistory` describes it, shape (4, 219); None for no motion."""

    def __post_init__(self) -> None:
        # A frozen dataclass is normalised through object.__setattr__, once, here.
        object.__setattr__(self, "pose", checked_numbers("pose", self.pose, (N_JOINTS, 3), np.float32, MAX_ANGLE))
        object.__setattr__(self, "betas", checked_numbers("betas", self.betas, (N_BETAS,), np.float32, MAX_COEFFICIENT))
        object.__setattr__(self, "transl", checked_numbers("transl", self.transl, (3,), np.float64))
        if self.style is not None:
            object.__setattr__(
                self, "style", checked_numbers("style", self.style, (N_STYLES,), np.float32, MAX_COEFFICIENT)
            )
        up = checked_numbers("up", self.up, (3,), np.float64)
        with np.errstate(over="ignore"):  # an infinite length is no direction, either
            length = float(np.linalg.norm(up))
        if not 1e-6 <= length <= 1e6:
            msg = f"up must be a direction, of a length from 1e-6 to 1e6, got {self.up!r}"
            raise FrameError(msg)
        object.__setattr__(self, "up", checked_numbers("up", up / length, (3,), np.float32))
        if self.past is not None:
            past = checked_numbers("past", self.past, (len(LAGS), N_PAST), np.float32, MAX_COEFFICIENT)
            object.__setattr__(self, "past", past)
        try:
            object.__setattr__(self, "stamp_ns", int(self.stamp_ns))
        except (TypeError, ValueError, OverflowError) as error:
            msg = f"stamp_ns must be a whole number of nanoseconds, got {self.stamp_ns!r}"
            raise FrameError(msg) from error

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Checks a copy and makes it read-only, too: NumPy forgets that when it copies or pickles."""
        self.__dict__.update(state)
        self.__post_init__()
