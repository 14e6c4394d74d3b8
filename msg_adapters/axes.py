"""SMPL axes (x left, y up, z forward) and ROS axes (REP-103: x forward, y left, z up)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

WORLD_FRAME = "map"
"""The frame of anything that names no other (REP-105)."""

InputAxes = Literal["smpl", "frame"]
"""What a sender's root orientation and translation are expressed in.

`smpl`: SMPL's world, y up; vertices are permuted into ROS axes. `frame`: the axes of `frame_id` already, as pose
estimators send (a camera's optical frame) and AMASS has (its z-up world); vertices go out unchanged.
"""

SMPL_COLUMNS: dict[InputAxes, tuple[int, int, int]] = {"smpl": (2, 0, 1), "frame": (0, 1, 2)}
"""SMPL's columns that become the message's x, y and z."""


def ros_from_sender(axes: InputAxes) -> NDArray[np.float64]:
    """The rotation (3, 3) from the axes of a sender's roots to those of the message's frame."""
    return np.eye(3)[list(SMPL_COLUMNS[axes])]


def up_of(frame_id: str) -> NDArray[np.float64]:
    """Which way is up in a frame, shape (3,), following REP-103: -y in a camera's optical frame, z in any other."""
    return np.array([0.0, -1.0, 0.0] if "optical" in frame_id.rsplit("/", maxsplit=1)[-1] else [0.0, 0.0, 1.0])


def up_of_sender(axes: InputAxes, frame_id: str, turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Which way is up in the axes of a sender's roots, shape (3,); `turn` (3, 3) leads from its frame to `frame_id`.

    If `turn` is the identity, SMPL's axes have y up whatever the frame is called.
    """
    if axes == "smpl" and (turn == np.eye(3)).all():
        return np.array([0.0, 1.0, 0.0])
    up: NDArray[np.float64] = (turn @ ros_from_sender(axes)).T @ up_of(frame_id)
    return up


def vertices_ros_from_smpl(vertices: NDArray[Any]) -> NDArray[Any]:
    """(x, y, z)_ros = (z, x, y)_smpl of points [m], shape (..., 3)."""
    return np.roll(vertices, 1, axis=-1)


def vertices_smpl_from_ros(vertices: NDArray[Any]) -> NDArray[Any]:
    """The inverse of `vertices_ros_from_smpl`: points [m], shape (..., 3)."""
    return np.roll(vertices, -1, axis=-1)
