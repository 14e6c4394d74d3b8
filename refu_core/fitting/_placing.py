"""What may be told of a mesh: its unit, its axes, its place and the pose that it was modelled in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from refu_core.errors import GarmentError
from refu_core.fitting._mesh_file import F64
from refu_core.frames import MAX_ANGLE, N_JOINTS, checked_numbers

UNITS: dict[str, float] = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Metres of a unit."""
UP_AXES: tuple[str, ...] = ("y", "z")


@dataclass(frozen=True)
class Placing:
    """What is known about a mesh; None for what is to be found out."""

    unit: float | None = None
    """Metres of the mesh's unit."""
    up: str | None = None
    """`y` or `z`."""
    pose: F64 | None = None
    """The pose that the mesh was modelled in: rotation vectors [rad], shape (24, 3); zeros for the T-pose."""
    is_placed: bool = False
    """Whether the mesh's origin is the body's; otherwise it may be moved."""
    held_at: str | None = None
    """A garment that is held at the `waist` doesn't reach up between the arms."""

    @property
    def is_whole(self) -> bool:
        """Whether nothing is left to find out."""
        return self.is_placed and None not in (self.unit, self.up) and self.pose is not None

    def __post_init__(self) -> None:
        """Raises `GarmentError` for what is no unit or no axis, `FrameError` for what is no pose."""
        is_number = isinstance(self.unit, (int, float, np.floating)) and not isinstance(self.unit, bool)
        is_unit = self.unit is None or (is_number and 0 < self.unit < math.inf)
        if not is_unit or self.up not in (None, *UP_AXES):
            msg = f"wanted a unit in metres (0.01 for cm) and y or z up, got {self.unit!r} and {self.up!r}"
            raise GarmentError(msg)
        if self.pose is not None:
            pose = checked_numbers("the mesh's pose", self.pose, (N_JOINTS, 3), np.float64, MAX_ANGLE)
            vars(self)["pose"] = pose.copy()  # torch warns about read-only arrays
