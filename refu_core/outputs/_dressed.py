"""A dressed person in the axes that somebody wants, each part computed when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core.outputs._normals import VertexNormals
from refu_core.outputs._openings import Opening, Openings
from refu_core.outputs._planner import PlannerMesh

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from refu_core.garments import GarmentTemplate


class Fittings:
    """What is found once of garments, when it is asked for first."""

    def __init__(self, garments: Mapping[str, GarmentTemplate], body_faces: NDArray[np.integer[Any]], n_body: int):
        """For garments by name, and the body of `n_body` vertices that wears them."""
        self.garments = garments
        self.names = tuple(garments)
        self.faces = {name: garment.faces.cpu().numpy() for name, garment in garments.items()}
        """Of each garment, shape (F, 3)."""
        self.counts = {name: garment.n_vertices for name, garment in garments.items()}
        """Vertices of each garment."""
        self.colors = {name: (*garment.card.color, 1.0) for name, garment in garments.items()}
        self.body = body_faces, n_body
        """The body's faces, and how many vertices it has."""
        self._known: dict[tuple[Any, str], Any] = {}

    def _once(self, make: Any, name: str, *arguments: Any) -> Any:
        if (make, name) not in self._known:
            self._known[make, name] = make(*arguments)
        return self._known[make, name]

    def openings(self, name: str) -> Openings:
        """Of a garment."""
        found: Openings = self._once(Openings, name, self.garments[name])
        return found

    def planner(self, name: str) -> PlannerMesh:
        """A garment's; takes a second or two when it is made for the first time ever."""
        found: PlannerMesh = self._once(PlannerMesh, name, self.garments[name])
        return found

    def normals(self, name: str) -> VertexNormals:
        """Of a garment."""
        found: VertexNormals = self._once(VertexNormals, name, self.faces[name], self.counts[name])
        return found


@dataclass(frozen=True, eq=False)
class Dressed:
    """One person in one frame; everything is relative to `offset`, in the axes that `rotation` leads to."""

    person: str
    stamp_ns: int
    local: Mapping[str, NDArray[np.float32]]
    """Vertices of each garment relative to the body's own origin, SMPL axes [m], shape (V, 3)."""
    posed_body: Callable[[], NDArray[np.float32]]
    """Makes the body's, likewise."""
    fittings: Fittings
    rotation: NDArray[np.float64]
    """From SMPL's axes, shape (3, 3)."""
    offset: NDArray[np.float64]
    """Where the body's own origin is [m], shape (3,); float64, so that a body far away loses no precision."""

    def _turned(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        turned: NDArray[np.float32] = points @ self.rotation.T.astype(np.float32)
        return turned

    @cached_property
    def vertices(self) -> dict[str, NDArray[np.float32]]:
        """Of each garment [m], shape (V, 3)."""
        return {name: self._turned(points) for name, points in self.local.items()}

    @cached_property
    def body(self) -> NDArray[np.float32]:
        """Vertices of the body [m], shape (V, 3)."""
        return self._turned(self.posed_body())

    @cached_property
    def openings(self) -> dict[str, tuple[Opening, ...]]:
        """Of each garment."""
        return {name: self.fittings.openings(name).frames(points) for name, points in self.vertices.items()}

    def normals(self, name: str) -> NDArray[np.float32]:
        """At the vertices of a garment, shape (V, 3)."""
        return self.fittings.normals(name)(self.vertices[name])

    def solid(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """A garment as planners take it: vertices [m] and faces."""
        planner = self.fittings.planner(name)
        return planner.solid(self.vertices[name]), planner.faces
