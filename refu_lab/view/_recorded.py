"""What markers show, and a film of those in a bag, of the node or of a replay, as they were recorded."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import msg_adapters as adapters
from msg_adapters import Marker, decode_marker_array
from msg_adapters.markers import ADD, DELETE, DELETE_ALL, TRIANGLE_LIST
from refu_core import RefuError
from refu_lab.view._film import SceneMesh

_FARTHEST = 1e6
"""Markers with coordinates beyond this aren't drawn [m]."""
_MOST_SHOWN = 500
"""Meshes on show; of more, those that came first are forgotten. Without a lifetime they would stay for ever."""


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
        here = {key[1:] for key in self._shown}
        self._topologies = {key: one for key, one in self._topologies.items() if key in here}
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
        for key in [*self._shown][:-_MOST_SHOWN]:
            del self._shown[key]
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


_LONGEST_PAUSE_S = 1.0
"""Longer pauses, as between the runs in a bag, are cut to this [s]."""
_LOOKED_AT = 100
"""Number of marker messages that are searched for a mesh."""


_Stored = tuple[SceneMesh, slice]
"""A mesh without its vertices, and where in the temporary file their coordinates are."""


class RecordedFilm:
    """Garments and bodies in a bag. Their vertices are in a temporary file, so long bags don't take more memory.

    Raises `RefuError` for a bag that can't be read, or without a triangle list.
    """

    def __init__(self, path: Path, *, progress: bool = False) -> None:
        self.title = path.name
        self.notes: list[str] = []
        self._spool = tempfile.TemporaryFile()  # noqa: SIM115  (as long as the film)
        self._size = 0
        scene: MarkerScene[_Stored] = MarkerScene(self._store)
        moments: list[tuple[int, list[_Stored]]] = []
        stamp_ns = n_bad = n_odd = 0
        with adapters.BagReader(path) as reader:
            topics = {topic.name: topic.message_count for topic in marker_topics(reader)}
            total = sum(topics.values())
            for message in tqdm(
                reader.messages(topics), total=total, unit="message", desc="reading", disable=None if progress else True
            ):
                try:
                    stamp, n = scene.take(message.topic, message.data, message.log_time_ns)
                except adapters.DecodeError:
                    n_bad += 1
                    continue
                n_odd += n
                if stamp == stamp_ns and moments:
                    moments.pop()  # the node's topics of one moment follow each other with the same stamp
                stamp_ns = stamp or stamp_ns
                moments.append((message.log_time_ns, scene.shown(message.log_time_ns)))
            self.notes += reader.warnings
        if n_bad:
            self.notes.append(f"{path}: {n_bad} messages are no markers and are left out")
        if n_odd:
            self.notes.append(f"{path}: {n_odd} meshes can't be drawn: their numbers are none, or make no triangles")
        while moments and not moments[0][1]:
            moments.pop(0)
        if not moments:
            raise RefuError(f"{path}: nothing to show: no marker of triangles; --dress dresses who moves in it")
        self._frames = [shown for _, shown in moments]
        steps = 1e-9 * np.diff([log_time_ns for log_time_ns, _ in moments])
        self.times = np.append(0.0, np.cumsum(np.clip(steps, 0.0, _LONGEST_PAUSE_S)))
        """Times of the frames, from the first one on [s], shape (T,)."""
        self._spool.flush()
        self._numbers = np.memmap(self._spool, np.float32, "r")
        self.front = _front(path)

    def shapes(self, index: int) -> Sequence[SceneMesh]:
        stored = self._frames[index]
        return [replace(shape, vertices=np.array(self._numbers[place]).reshape(-1, 3)) for shape, place in stored]

    def facts(self, index: int) -> list[str]:
        """The number of meshes: nothing else is known."""
        return [f"{len(self._frames[index])} meshes, as recorded"]

    def close(self) -> None:
        """Deletes the temporary file."""
        self._spool.close()

    def _store(self, shape: SceneMesh) -> _Stored:
        try:
            self._spool.write(shape.vertices.tobytes())
        except OSError as error:
            msg = f"{tempfile.gettempdir()}: no room for what is shown ({error.strerror}); TMPDIR names another folder"
            raise RefuError(msg) from error
        place = slice(self._size, self._size + shape.vertices.size)
        self._size = place.stop
        return replace(shape, vertices=shape.vertices[:0]), place


def marker_topics(reader: adapters.BagReader) -> list[adapters.TopicInfo]:
    """A bag's topics of markers, usually garments and bodies."""
    return [topic for topic in reader.topics if topic.message_type == adapters.MARKER_ARRAY and topic.message_count]


def has_meshes(path: Path) -> bool:
    """Whether a bag's markers show meshes, as those of garments do. Raises `BagError` if it isn't a bag."""
    with adapters.BagReader(path) as reader:
        for message in islice(reader.messages({topic.name for topic in marker_topics(reader)}), _LOOKED_AT):
            with suppress(adapters.DecodeError):
                if any(is_mesh(marker) and is_drawable(marker) for marker in decode_marker_array(message.data)):
                    return True
    return False


def _front(path: Path) -> float:
    """Where the person faces at first [rad], by the bag's SMPL parameters (taken in SMPL's axes); else along x."""
    with suppress(RefuError, StopIteration):
        frame = next(record.frame for record in adapters.iter_smpl_frames(path) if record.frame is not None)
        forward = adapters.vertices_ros_from_smpl(Rotation.from_rotvec(frame.pose[0]).apply([0.0, 0.0, 1.0]))
        return float(np.arctan2(forward[1], forward[0]))
    return 0.0
