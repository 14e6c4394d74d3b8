"""What the arrays beside a pose mean: a place, a shape, a frame rate, words."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import N_BETAS
from refu_core.recordings import _layouts as table
from refu_core.recordings._containers import Content

GENDERS = {"m": "male", "male": "male", "f": "female", "female": "female", "n": "neutral", "neutral": "neutral"}
_STEADY = 1e-3  # betas that differ by less between frames are one shape
_SAY_IT = "say it, as in --fps 30 (in Python: fps=30)"


def transl_of(array: NDArray[Any] | None, layout: table.Layout, n: int, notes: list[str]) -> NDArray[np.float64]:
    """A translation for each frame [m], shape (n, 3); zeros if there is none. Raises `ValueError` for another shape."""
    names = " or ".join(name for name in layout.transl if name not in table.ROOT_PLACES)
    if array is None:
        notes.append(f"no translation ({names}): the person stays in one place")
        return np.zeros((n, 3))
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{names} must be numbers, got {array.dtype} {array.shape}")
    if array.shape not in ((n, 3), (n, 1, 3), (1, n, 3)) and (n, *array.shape) != (1, 3):
        raise ValueError(f"{names} must be ({n}, 3) like the pose, got {array.shape}")
    return array.reshape(n, 3).astype(np.float64)


def betas_of(array: NDArray[Any] | None, n: int, notes: list[str], *, has_age: bool = False) -> NDArray[np.float32]:
    """The first 10 coefficients, with the mean shape's zeros for missing ones. A person has one shape: the median.

    `has_age` says that an eleventh is SMPL+A's, between an adult (0) and a child (1): it is left out, which is noted.

    Raises `ValueError` for an array of another shape, and for numbers that aren't finite.
    """
    betas = np.zeros(N_BETAS, np.float32)
    if array is None or not array.size:
        notes.append("no betas: the mean shape, unless betas are given")
        return betas
    if array.dtype.kind not in "iuf" or array.ndim > 3 or (array.ndim > 1 and len(array) not in (1, n)):
        msg = f"betas must be one row of coefficients, or a row for each of {n} frames, got {array.dtype} {array.shape}"
        raise ValueError(msg)
    rows = np.atleast_1d(array).astype(np.float64)
    rows = rows.reshape(-1, rows.shape[-1])
    if has_age and rows.shape[1] == N_BETAS + 1 and len(rows) and np.any(rows[:, -1]):
        age = float(np.median(rows[:, -1]))
        notes.append(f"the eleventh beta, a child's share of the shape ({age:.2g}), is left out: an adult's body")
    rows = rows[:, :N_BETAS]
    with np.errstate(over="ignore", invalid="ignore"):  # becomes inf or NaN, which is refused below
        spread = float(np.ptp(rows, axis=0).max(initial=0.0)) if len(rows) else 0.0
        betas[: rows.shape[1]] = np.median(rows, axis=0) if len(rows) else 0.0
    if spread > _STEADY:
        notes.append(f"betas differ by up to {spread:.2g} between frames: a person has one shape, the median")
    if not np.isfinite(betas).all():
        raise ValueError("betas has values that are NaN or infinite, or too large for float32")
    return betas


def fps_of(content: Content, value: Any) -> float:
    """Frames a second. Raises `ValueError` if there is no such number."""
    if value is None:
        raise ValueError(f"no frame rate in the file: {_SAY_IT}")
    array = np.asarray(value) if isinstance(value, (int, float, str)) else content.array(value)
    if array.size == 1 and array.dtype.kind in "iufUS":
        with contextlib.suppress(ValueError):
            return float(word_of(content, array))
    got = f"{table.RATES[0]} must be one number, got {array.dtype} {array.shape}"
    raise ValueError(f"no frame rate: {got}; {_SAY_IT}")


def word_of(content: Content, value: Any, which: int = 0) -> str:
    """A word of text, in any form in which files hold it."""
    if isinstance(value, (list, tuple)) and value:
        value = value[min(which, len(value) - 1)]
    if value is not None and not isinstance(value, (str, bytes)):
        try:
            found = content.array(value).reshape(-1)[:1].tolist()
        except ValueError:
            found = []
        value = found[0] if found else ""
    word = value.decode("utf-8", "replace") if isinstance(value, bytes) else str("" if value is None else value)
    return word.strip().removeprefix("b'").removesuffix("'").lower()


def gender_of(word: str, notes: list[str]) -> str:
    """`male`, `female` or `neutral`; an unknown word is neutral, too."""
    if word and word not in GENDERS:
        notes.append(f"the gender {word[:20]!r} isn't known: neutral")
    return GENDERS.get(word, "neutral")
