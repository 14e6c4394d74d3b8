"""What a viewer shows: meshes of a moment, from any film."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BODY, SKIN = "body", "skin"
"""Names of shapes that aren't garments: the collider, and the posed body as it is."""


@dataclass(frozen=True, eq=False)
class SceneMesh:
    """A mesh of one person in one frame."""

    name: str
    """Name of the garment, or `BODY` or `SKIN`."""
    person: str
    """Name of the person; empty if there is only one."""
    vertices: NDArray[np.float32]
    """[m], shape (V, 3): z up, relative to a fixed origin near the people, so that precision isn't lost."""
    faces: NDArray[np.int64]
    """Counter-clockwise from outside, shape (F, 3)."""
    color: tuple[float, float, float]
    """sRGB, 0 to 1."""

    @property
    def is_garment(self) -> bool:
        return self.name not in (BODY, SKIN)
