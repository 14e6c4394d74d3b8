"""How wrong an approximate signed distance is (supplement, Sec. A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from refu_core.errors import MeshError

_AT_SURFACE = 1e-4
"""Closer to the skin than this [m], a relative error says nothing."""
MISS = 2e-3
"""An error above this [m] counts as a miss."""


@dataclass(frozen=True)
class SdfErrors:
    """Errors over some points; None where there are none."""

    n_points: int
    """Points that were compared."""
    mean_absolute_mm: float | None
    """Mean of |f - s| [mm] (supplement, Eq. 12)."""
    mean_relative_percent: float | None
    """Mean of |f - s| / |s| [%] (supplement, Eq. 15), over the points more than 0.1 mm from the skin."""
    p99_mm: float | None
    """99th percentile of |f - s| [mm]."""
    missed_percent: float | None
    """Points with |f - s| above 2 mm [%]."""
    hidden_percent: float | None
    """Points more than 2 mm inside, s < -2 mm, that are taken for outside, f ≥ 0 [%]: a collision nobody sees."""

    @staticmethod
    def between(approximate: ArrayLike, accurate: ArrayLike) -> SdfErrors:
        """Compares distances f and s [m], both of shape (P,).

        Raises:
            MeshError: shapes that differ, or values that aren't finite.
        """
        f, s = np.asarray(approximate, np.float64), np.asarray(accurate, np.float64)
        if f.shape != s.shape or f.ndim != 1 or not (np.isfinite(f).all() and np.isfinite(s).all()):
            msg = f"wanted finite distances of one shape (P,), got {f.shape} and {s.shape}"
            raise MeshError(msg)
        error: NDArray[np.float64] = np.abs(f - s)
        off = np.abs(s) > _AT_SURFACE
        if not len(error):
            return SdfErrors(0, None, None, None, None, None)
        return SdfErrors(
            n_points=len(error),
            mean_absolute_mm=1e3 * float(error.mean()),
            mean_relative_percent=100.0 * float((error[off] / np.abs(s[off])).mean()) if off.any() else None,
            p99_mm=1e3 * float(np.percentile(error, 99)),
            missed_percent=100.0 * float((error > MISS).mean()),
            hidden_percent=100.0 * float(((s < -MISS) & (f >= 0)).mean()),
        )
