"""What may enter a data set: exact checks of a drape against the body and against itself, limits of its stretch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import as_warp
from refu_core.metrics._collisions import CollisionChecker
from refu_core.metrics._intersect import crossings

if TYPE_CHECKING:
    from refu_core.simulation._cloth import F32
    from refu_core.simulation._drape import SettledDrape

CAUSES = ("body_collision", "self_intersection", "stretch", "unsettled")
"""Why a sample isn't taken, in the order of the checks."""


class SelfIntersection:
    """Exact triangle-triangle check of a garment against itself."""

    device = torch.device("cpu")

    def __init__(self, faces: Any) -> None:
        """For a garment of these faces, shape (F, 3)."""
        self._faces = np.ascontiguousarray(faces, dtype=np.int32)
        self._flat = torch.from_numpy(self._faces.reshape(-1).copy())
        self._mesh: Any = None

    @property
    def mesh_id(self) -> int:
        """Warp's handle of the mesh being checked."""
        return int(self._mesh.id)

    def pairs(self, vertices: F32) -> NDArray[np.int32]:
        """The pairs of faces that intersect, shape (K, 2); neighbours may meet at an edge or vertex."""
        points = torch.from_numpy(np.ascontiguousarray(vertices, dtype=np.float32))
        self._mesh = wp.Mesh(as_warp(points, wp.vec3), as_warp(self._flat, wp.int32))
        found = crossings(self, points.numpy(), self._faces, is_body=True)  # type: ignore[arg-type]
        return found.pairs


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
        self._itself = SelfIntersection(garment_faces)

    def cause(self, vertices: F32, body: F32, drape: SettledDrape | None = None) -> str | None:
        """One of `CAUSES`, or None for a drape with nothing against it.

        Args:
            vertices: the garment as it will be read back [m], shape (N, 3).
            body: the vertices of what it lies on [m], shape (V, 3).
            drape: how it settled; without it only collisions are looked for.
        """
        self._body.update(body)
        if not self._body.check(vertices, self._garment_faces).is_free:
            return "body_collision"
        if len(self._itself.pairs(vertices)):
            return "self_intersection"
        if drape is not None and drape.stretch > self.settings.stretch:
            return "stretch"
        if drape is not None and drape.speed > self.settings.speed:
            return "unsettled"
        return None
