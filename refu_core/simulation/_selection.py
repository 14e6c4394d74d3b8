"""What may enter a data set: exact checks of a drape against the body and against itself, limits on its stretch."""

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
    """Limits on the drapes that are taken."""

    stretch: float = 1.15
    """Limit on the 99.9th percentile of edge length over the length that the edge reaches freely."""
    speed: float = 0.10
    """Limit on the root mean square speed that is left [m/s]: a faster cloth hasn't settled."""


class Selector:
    """Says why a drape can't be taken, judged as it will be stored."""

    def __init__(self, body_faces: Any, garment_faces: Any, *, settings: SelectionSettings | None = None) -> None:
        """For a garment on a body, faces of the shape (F, 3) each."""
        self.settings = settings or SelectionSettings()
        self._garment_faces = np.ascontiguousarray(garment_faces, dtype=np.int32)
        self._body = CollisionChecker(body_faces)
        self._itself = SheetChecker(garment_faces)

    def cause(self, vertices: F32, body: F32, *, stretch: float = 1.0, speed: float = 0.0) -> str | None:
        """One of `CAUSES`, or None for a drape that can be taken.

        `vertices` (N, 3) are the garment's as they will be read back, `body` (V, 3) those of the body below it [m];
        `stretch` and `speed` are those of `SettledDrape`.
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
