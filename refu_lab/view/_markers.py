"""What markers show: meshes that stay until they are deleted or expire, relative to a fixed origin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from msg_adapters import Marker, decode_marker_array
from msg_adapters.errors import DecodeError
from msg_adapters.markers import ADD, DELETE, DELETE_ALL, TRIANGLE_LIST
from refu_lab.view._film import SceneMesh

_FARTHEST = 1e6
"""Markers with coordinates beyond this aren't drawn [m]."""


@dataclass(frozen=True, eq=False)
class Topology:
    """How the corners of a marker's triangles share vertices."""

    first: NDArray[np.intp]
    """Index of one corner at each vertex, shape (V,)."""
    faces: NDArray[np.int64]
    """Shape (F, 3)."""

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> Topology:
        """The topology of corners [m], shape (3F, 3): those at the same position are one vertex."""
        rows = np.ascontiguousarray(points).view([("", points.dtype)] * 3).ravel()
        _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
        return cls(first, inverse.reshape(-1, 3).astype(np.int64))

    def fits(self, points: NDArray[np.float64]) -> bool:
        """Whether corners, shape (3F, 3), share vertices in this way."""
        return len(points) == self.faces.size and np.array_equal(points[self.first][self.faces.reshape(-1)], points)


def is_mesh(marker: Marker) -> bool:
    """Whether a marker shows triangles."""
    return marker.type == TRIANGLE_LIST and marker.action == ADD and len(marker.points) > 0


def is_drawable(marker: Marker) -> bool:
    """Whether its triangles can be drawn: three corners each, and numbers that are finite and not too large."""
    numbers = np.array([*marker.pose, *marker.scale])
    if len(marker.points) % 3 or not (np.abs(numbers) < _FARTHEST).all():
        return False
    return bool((np.abs(marker.points) < _FARTHEST).all())


_Kept = TypeVar("_Kept")


class MarkerScene(Generic[_Kept]):
    """The markers of several topics that are on show: each stays until it is deleted, or its lifetime is over.

    Faces that don't change from message to message stay the same array. The very first vertex is the origin.
    """

    def __init__(self, keep: Callable[[SceneMesh], _Kept]) -> None:
        """`keep` turns each shape into what is kept of it."""
        self._keep = keep
        self._shown: dict[tuple[str, str, int], tuple[_Kept, float]] = {}
        self._origin: NDArray[np.float64] | None = None
        self._topologies: dict[tuple[str, int], Topology] = {}

    @property
    def topics(self) -> set[str]:
        """Topics that have something on show."""
        return {topic for topic, *_ in self._shown}

    def shown(self, now_ns: float) -> list[_Kept]:
        """What is on show at a time by the receiver's clock [ns]; the rest is forgotten."""
        self._shown = {key: one for key, one in self._shown.items() if now_ns < one[1]}
        return [kept for kept, _ in self._shown.values()]

    def take(self, topic: str, data: bytes, now_ns: int) -> tuple[int, int]:
        """Takes in a message's markers; returns its stamp (0 if it shows no mesh) and how many meshes can't be drawn.

        Raises `DecodeError` if it isn't a message of markers.
        """
        markers = decode_marker_array(data)
        for marker in markers:
            if marker.action == DELETE_ALL:
                self._shown = {key: kept for key, kept in self._shown.items() if key[0] != topic}
            elif marker.action == DELETE:
                self._shown.pop((topic, marker.ns, marker.id), None)
        meshes = [marker for marker in markers if is_mesh(marker)]
        drawable = [marker for marker in meshes if is_drawable(marker)]
        for marker in drawable:
            until_ns = now_ns + marker.lifetime_ns if marker.lifetime_ns > 0 else np.inf
            self._shown[topic, marker.ns, marker.id] = self._keep(self.shape(marker)), until_ns
        return max((marker.stamp_ns or now_ns for marker in drawable), default=0), len(meshes) - len(drawable)

    def shape(self, marker: Marker) -> SceneMesh:
        """The shape of a marker of triangles."""
        key, points = (marker.ns, marker.id), marker.points
        topology = self._topologies.get(key)
        if topology is None or not topology.fits(points):
            topology = self._topologies[key] = Topology.of(points)
        vertices = marker.placed(points[topology.first] * marker.scale)
        if self._origin is None:
            self._origin = vertices[0].copy()
        person, _, name = marker.ns.rpartition("/")
        color = (marker.color[0], marker.color[1], marker.color[2])
        return SceneMesh(name, person, (vertices - self._origin).astype(np.float32), topology.faces, color)


def shows_meshes(data: bytes) -> bool:
    """Whether a message has a mesh that can be drawn."""
    try:
        return any(is_mesh(marker) and is_drawable(marker) for marker in decode_marker_array(data))
    except DecodeError:
        return False
