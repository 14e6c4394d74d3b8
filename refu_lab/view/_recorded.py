"""A film of the markers in a bag, of the node or of a replay, as they were recorded."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

import msg_adapters as adapters
from refu_core import RefuError
from refu_lab.view._film import SceneMesh
from refu_lab.view._markers import MarkerScene, shows_meshes

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
        """Warnings for the user."""
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
            msg = f"{path}: nothing to show: no marker of triangles; --dress dresses people whose motion is in it"
            raise RefuError(msg)
        self._frames = [shown for _, shown in moments]
        steps = 1e-9 * np.diff([log_time_ns for log_time_ns, _ in moments])
        self._times = np.append(0.0, np.cumsum(np.clip(steps, 0.0, _LONGEST_PAUSE_S)))
        self._spool.flush()
        self._numbers = np.memmap(self._spool, np.float32, "r")
        self.front = _front(path)

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of the frames, from the first one on [s], shape (T,)."""
        return self._times

    def shapes(self, index: int) -> Sequence[SceneMesh]:
        """What was recorded at a moment."""
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
        first = islice(reader.messages({topic.name for topic in marker_topics(reader)}), _LOOKED_AT)
        return any(shows_meshes(message.data) for message in first)


def _front(path: Path) -> float:
    """Where the person faces at first [rad], by the bag's SMPL parameters (taken in SMPL's axes); else along x."""
    try:
        frame = next((record.frame for record in adapters.iter_smpl_frames(path) if record.frame is not None), None)
    except RefuError:
        return 0.0
    if frame is None:
        return 0.0
    forward = adapters.vertices_ros_from_smpl(Rotation.from_rotvec(frame.pose[0]).apply([0.0, 0.0, 1.0]))
    return float(np.arctan2(forward[1], forward[0]))
