"""Meshes of markers: triangles that share corners, seen from an origin that stays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters import Marker
from msg_adapters.markers import ADD, TRIANGLE_LIST
from refu_lab.view._film import Shape


@dataclass(frozen=True, eq=False)
class Topology:
    """How the corners of a marker's triangles share vertices."""

    first: NDArray[np.intp]
    """A corner of each vertex, shape (V,)."""
    faces: NDArray[np.int64]
    """Shape (F, 3)."""

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> Topology:
        """Of corners [m], shape (3F, 3): those in one place are one vertex."""
        rows = np.ascontiguousarray(points).view([("", points.dtype)] * 3).ravel()
        _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
        return cls(first, inverse.reshape(-1, 3).astype(np.int64))

    def fits(self, points: NDArray[np.float64]) -> bool:
        """Whether corners, shape (3F, 3), share their vertices in this way."""
        return len(points) == self.faces.size and np.array_equal(points[self.first][self.faces.reshape(-1)], points)


class MarkerShapes:
    """Shapes of one marker after the other: what doesn't change stays one array, and the first vertex is the origin."""

    def __init__(self) -> None:
        self._origin: NDArray[np.float64] | None = None
        self._topologies: dict[tuple[str, int], Topology] = {}

    def shape(self, marker: Marker) -> Shape:
        """A marker of triangles as a shape."""
        key, points = (marker.ns, marker.id), marker.points
        topology = self._topologies.get(key)
        if topology is None or not topology.fits(points):
            topology = self._topologies[key] = Topology.of(points)
        vertices = points[topology.first] * marker.scale
        if marker.pose != (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0):
            vertices = Rotation.from_quat(marker.pose[3:]).apply(vertices) + marker.pose[:3]
        if self._origin is None:
            self._origin = vertices[0].copy()
        person, _, name = marker.ns.rpartition("/")
        color = (marker.color[0], marker.color[1], marker.color[2])
        return Shape(name, person, (vertices - self._origin).astype(np.float32), topology.faces, color)


def meshes_of(markers: Iterable[Marker]) -> list[Marker]:
    """Those that are triangles to show."""
    return [one for one in markers if one.type == TRIANGLE_LIST and one.action == ADD and len(one.points)]
