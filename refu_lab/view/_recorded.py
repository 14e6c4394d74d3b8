"""A film of what a bag has recorded: markers of the node or of a replay, as they are."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import msg_adapters as adapters
from refu_core import RefuError
from refu_lab.view._film import Cache, Shape
from refu_lab.view._markers import MarkerShapes, meshes_of


@dataclass(frozen=True)
class _Stored:
    name: str
    person: str
    color: tuple[float, float, float]
    faces: NDArray[np.int64]
    n_vertices: int
    offset: int


class RecordedFilm:
    """Garments and bodies of a bag. Vertices lie in a temporary file: however long the bag, memory doesn't grow.

    Raises `RefuError` for a bag that can't be read, or without a triangle list.
    """

    def __init__(self, path: Path, *, progress: bool = False) -> None:
        self.title = path.name
        self.notes: list[str] = []
        """What there is to warn of, for people."""
        self._spool = tempfile.TemporaryFile()  # noqa: SIM115  (as long as the film)
        self._size = 0
        self._markers = MarkerShapes()
        frames: dict[int, list[_Stored]] = {}
        n_bad = 0
        with adapters.BagReader(path) as reader:
            topics = {topic.name: topic.message_count for topic in marker_topics(reader)}
            total = sum(topics.values())
            for message in tqdm(
                reader.messages(topics), total=total, unit="message", desc="reading", disable=None if progress else True
            ):
                shown = _triangles(message.data)
                n_bad += shown is None
                if shown:
                    # The node's topics of one moment are written one after the other, with one stamp.
                    stamp = max(marker.stamp_ns for marker in shown) or message.log_time_ns
                    frames.setdefault(stamp, []).extend(map(self._store, shown))
            self.notes += reader.warnings
        if n_bad:
            self.notes.append(f"{path}: {n_bad} messages are no markers and are left out")
        if not frames:
            msg = f"{path}: nothing to show: no marker of triangles"
            raise RefuError(msg)
        stamps = sorted(frames)
        self._frames = [frames[stamp] for stamp in stamps]
        self._times = np.array([1e-9 * (stamp - stamps[0]) for stamp in stamps])
        self._cache = Cache()
        self.front = _front(path)

    @property
    def times(self) -> NDArray[np.float64]:
        """From the first frame on [s], shape (T,)."""
        return self._times

    def shapes(self, index: int) -> Sequence[Shape]:
        """What was recorded of a moment."""
        return self._cache.get(index, self._read)

    def facts(self, index: int) -> list[str]:
        """Nothing but what is seen is known."""
        return [f"{len(self._frames[index])} meshes, as recorded"]

    def close(self) -> None:
        """Gives the temporary file back."""
        self._spool.close()

    def _store(self, marker: adapters.Marker) -> _Stored:
        shape = self._markers.shape(marker)
        stored = _Stored(shape.name, shape.person, shape.color, shape.faces, len(shape.vertices), self._size)
        data = shape.vertices.tobytes()
        self._spool.write(data)
        self._size += len(data)
        return stored

    def _read(self, index: int) -> Sequence[Shape]:
        self._spool.flush()
        found = []
        for one in self._frames[index]:
            data = os.pread(self._spool.fileno(), 12 * one.n_vertices, one.offset)
            vertices = np.frombuffer(data, np.float32).reshape(-1, 3).copy()
            found.append(Shape(one.name, one.person, vertices, one.faces, one.color))
        return found


def marker_topics(reader: adapters.BagReader) -> list[adapters.TopicInfo]:
    """Topics of a bag that carry markers: garments and bodies, as a rule."""
    return [topic for topic in reader.topics if topic.message_type == adapters.MARKER_ARRAY and topic.message_count]


def has_markers(path: Path) -> bool:
    """Whether a bag carries garments. Raises `BagError` for what is no bag."""
    with adapters.BagReader(path) as reader:
        return bool(marker_topics(reader))


def _triangles(data: bytes) -> list[adapters.Marker] | None:
    """The meshes of a message; None for one that can't be decoded."""
    try:
        markers = adapters.decode_marker_array(data)
    except adapters.DecodeError:
        return None
    return meshes_of(markers)


def _front(path: Path) -> float:
    """Where the person faces at the beginning, if the bag has SMPL parameters in SMPL's axes; along x where not."""
    try:
        frame = next((record.frame for record in adapters.iter_smpl_frames(path) if record.frame is not None), None)
    except RefuError:
        return 0.0
    if frame is None:
        return 0.0
    forward = adapters.vertices_ros_from_smpl(Rotation.from_rotvec(frame.pose[0]).apply([0.0, 0.0, 1.0]))
    return float(np.arctan2(forward[1], forward[0]))
