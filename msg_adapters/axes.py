"""SMPL axes (x left, y up, z forward) and ROS axes (REP-103: x forward, y left, z up)."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatT = TypeVar("FloatT", bound=np.floating[Any])

InputAxes = Literal["smpl", "frame"]
"""What a sender's root orientation and translation are expressed in.

`smpl`: SMPL's world, y up; vertices are permuted into ROS axes. `frame`: the axes of `frame_id` already, as pose
estimators do with a camera's optical frame (and AMASS with its z-up world); vertices go out as they are.
"""

SMPL_COLUMNS: dict[InputAxes, tuple[int, int, int]] = {"smpl": (2, 0, 1), "frame": (0, 1, 2)}
"""Column of SMPL that becomes the message's x, y and z."""


def vertices_ros_from_smpl(vertices: NDArray[FloatT]) -> NDArray[FloatT]:
    """(x, y, z)_ros = (z, x, y)_smpl of points [m], shape (..., 3)."""
    return np.roll(vertices, 1, axis=-1)


def vertices_smpl_from_ros(vertices: NDArray[FloatT]) -> NDArray[FloatT]:
    """The inverse of `vertices_ros_from_smpl`: points [m], shape (..., 3)."""
    return np.roll(vertices, -1, axis=-1)
