"""How numbers of a caller are read: one rule for frames, points, keypoints and messages."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

NOT_NUMBERS = (TypeError, ValueError, RuntimeError, OverflowError)
"""What `as_numbers` raises; a RuntimeError for a tensor that tracks gradients."""


def as_numbers(value: Any, *, also: str = "") -> NDArray[Any]:
    """`value` as an array of real numbers in its own type, or of what else NumPy's kinds `also` allow.

    What a mask covers wasn't measured, so it is NaN. Booleans, text, dates and complex numbers are none, though NumPy
    would turn them into some. Raises one of `NOT_NUMBERS` for anything else.
    """
    if value is None:  # NumPy takes it for one NaN
        raise TypeError("nothing")
    given = np.ma.asanyarray(value) if isinstance(value, np.ma.MaskedArray) else np.asarray(value)
    if given.dtype.kind not in "iufO" + also:
        raise TypeError(f"values of the type {given.dtype}")
    if np.ma.is_masked(given):
        is_fine = given.dtype.kind == "f"
        return np.asarray(np.ma.filled(given if is_fine else given.astype(np.float64), np.nan))
    return np.asarray(given)


def as_whole(value: Any) -> int:
    """A count, or a time [ns], as Python's own whole number: NumPy's wrap around, and YAML and struct don't know them.

    Raises one of `NOT_NUMBERS` for anything else, such as seconds, which have a fraction.
    """
    if isinstance(value, (str, bytes, bytearray)):
        raise TypeError("text")
    whole = int(value)
    if isinstance(value, Real) and whole != value:  # seconds, most likely
        raise ValueError("a fraction")
    return whole
