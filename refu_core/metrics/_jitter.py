"""How much a garment trembles from frame to frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from refu_core.errors import MeshError


def temporal_jitter(before: ArrayLike, now: ArrayLike, after: ArrayLike) -> float:
    """Mean over the vertices of |x(t+1) - 2 x(t) + x(t-1)|, in millimetres a frame squared.

    Three consecutive frames of a garment [m], each of shape (N, 3). A moving body accelerates too, so the figure means
    something beside that of a garment skinned to the same motion at the same frame rate, and not on its own.

    Raises:
        MeshError: arrays of other or differing shapes.
    """
    frames = [np.asarray(frame, np.float64) for frame in (before, now, after)]
    if frames[0].ndim != 2 or frames[0].shape[1] != 3 or len({frame.shape for frame in frames}) > 1:
        msg = f"wanted three frames of one shape (N, 3), got {', '.join(str(frame.shape) for frame in frames)}"
        raise MeshError(msg)
    acceleration = frames[2] - 2 * frames[1] + frames[0]
    return 1e3 * float(np.linalg.norm(acceleration, axis=1).mean()) if len(acceleration) else 0.0
