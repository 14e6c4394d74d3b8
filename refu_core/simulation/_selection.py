"""What may enter a data set: exact checks of a drape against the body and against itself, limits of its stretch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.simulation._cloth import F32

CAUSES = ("body_collision", "self_intersection", "stretch", "unsettled")
"""Why a sample isn't taken, in the order of the checks."""


@dataclass(frozen=True)
class SelectionSettings:
    """Limits of what is taken."""

    stretch: float = 1.15
    """Of the 99.9th percentile of an edge's length over its rest length."""
    speed: float = 0.10
    """Of the root mean square speed that is left [m/s]: a faster cloth hasn't settled."""


class Selector:
    """Says of a drape, as it will be stored, why it can't be taken."""

    def __init__(self, body_faces: Any, garment_faces: Any, *, settings: SelectionSettings | None = None) -> None:
        """For a garment on a body, faces of the shape (F, 3) each."""
        self.settings = settings or SelectionSettings()
        self._garment_faces = np.ascontiguousarray(garment_faces, dtype=np.int32)
        self._body = CollisionChecker(body_faces)
        self._itself = SheetChecker(garment_faces)

    def cause(self, vertices: F32, body: F32, *, stretch: float = 1.0, speed: float = 0.0) -> str | None:
        """One of `CAUSES`, or None for a drape with nothing against it.

        `vertices` (N, 3) are the garment's as they will be read back, `body` (V, 3) those of what it lies on [m];
        `stretch` and `speed` are what `SettledDrape` calls so.
        """
        self._body.update(body)
        if not self._body.check(vertices, self._garment_faces).is_free:
            return "body_collision"
        self._itself.update(vertices)
        if len(self._itself.with_itself()):
            return "self_intersection"
        if stretch > self.settings.stretch:
            return "stretch"
        return "unsettled" if speed > self.settings.speed else None
