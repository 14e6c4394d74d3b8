"""What is asked of the arrays that come in."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import MeshError


def as_points(name: str, value: Any, n: int | None = None) -> NDArray[np.float64]:
    """`value` as finite points, float64, shape (n, 3).

    Raises:
        MeshError: it isn't that.
    """
    try:
        points = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:  # the last: a tensor that tracks gradients
        msg = f"{name} must be numbers of the shape ({'N' if n is None else n}, 3), got {type(value).__name__}"
        raise MeshError(msg) from error
    if points.ndim != 2 or points.shape[1] != 3 or (n is not None and len(points) != n):
        msg = f"{name} must have the shape ({'N' if n is None else n}, 3), got {points.shape}"
        raise MeshError(msg)
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(1).sum())
        msg = f"{name} must be finite, got {bad} of {len(points)} with NaN or infinite coordinates"
        raise MeshError(msg)
    return points
