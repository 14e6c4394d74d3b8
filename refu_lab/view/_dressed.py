"""A film of recorded motion that is dressed while you look."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import msg_adapters as adapters
from refu_core import RefuError, SmplFrame
from refu_core.garments import BUILTIN_GARMENTS, load_garment
from refu_core.history import PoseHistory
from refu_core.realtime import PipelineOutput
from refu_core.recordings import SUFFIXES, upright_turn
from refu_lab.commands.replay import RecordingOptions
from refu_lab.export import numbered
from refu_lab.render import SKIN as SKIN_COLOUR
from refu_lab.sources import open_source
from refu_lab.view._film import BODY, SKIN, SceneMesh

_CACHE_BYTES = 512 << 20
"""Of frames that are kept, once dressed."""
_AWAY_S = 0.25
"""A person whose nearest frame is farther off in time isn't shown [s]."""


@dataclass(frozen=True, eq=False)
class PersonMotion:
    person: str
    frames: list[SmplFrame]
    times: NDArray[np.float64]
    """Times of the frames [s], shape (T,), in rising order."""
    turn: NDArray[np.float64]
    """Rotation from the frames' axes to z up, shape (3, 3)."""

    def at(self, moment: float) -> SmplFrame | None:
        """The frame nearest to a time [s]; None if none is near."""
        after = int(np.searchsorted(self.times, moment))
        index = min((max(after - 1, 0), min(after, len(self.times) - 1)), key=lambda i: abs(self.times[i] - moment))
        return self.frames[index] if abs(self.times[index] - moment) <= _AWAY_S else None


class DressedFilm:
    """People from motion files and bags of SMPL parameters, in garments that can be changed.

    Raises `RefuError` for inputs that can't be read, and options that make no pipeline.
    """

    def __init__(self, inputs: Sequence[Path], options: RecordingOptions) -> None:
        self._options = options
        self._pipeline = options.load_pipeline()
        self._given = dict(zip(self.garments, options.garments, strict=True))
        """What each garment was asked for by: some are files."""
        self.notes: list[str] = []
        names = numbered([path.stem for path in inputs], mark="-") if len(inputs) > 1 else [""]
        self._tracks = [track for path, name in zip(inputs, names, strict=True) for track in self._read(path, name)]
        longest = max(self._tracks, key=lambda track: len(track.frames))
        self._moments = longest.times
        self.times = self._moments - self._moments[0]
        """Times of the frames of the person who has the most, from the first one on [s], shape (T,)."""
        first = self._tracks[0]
        self._origin = first.turn @ first.frames[0].transl
        self._begin()
        self.title = ", ".join(path.name for path in inputs)

    @property
    def front(self) -> float:
        """Where the first person faces at the beginning: the angle from x towards y [rad]."""
        track = self._tracks[0]
        forward = track.turn @ Rotation.from_rotvec(track.frames[0].pose[0]).apply([0.0, 0.0, 1.0])
        return float(np.arctan2(forward[1], forward[0]))

    @property
    def garments(self) -> tuple[str, ...]:
        return tuple(self._pipeline.garments)

    @property
    def sdf(self) -> str:
        return str(self._options.sdf)

    @property
    def wardrobe(self) -> tuple[str, ...]:
        """Garments that can be worn: those asked for, and those made for this body; all, if a body was named."""
        body = self._options.body or self._pipeline.body.name
        fitting = [name for name in BUILTIN_GARMENTS if self._options.body or load_garment(name).body == body]
        return tuple(dict.fromkeys((*fitting, *self._given)))

    def wear(self, garments: Sequence[str], sdf: str) -> None:
        """Changes the garments and the signed distance. Raises `RefuError` and then changes nothing."""
        names = tuple(self._given.get(name, name) for name in garments)
        options = replace(self._options, garments=names, sdf=sdf)
        self._pipeline, self._options = options.load_pipeline(), options
        self._begin()

    def _begin(self) -> None:
        """Forgets what was dressed by another pipeline."""
        self._body_faces = self._pipeline.body.faces.cpu().numpy()  # one array: drawing compares identities
        n_vertices = 2 * self._pipeline.body.n_vertices
        n_vertices += sum(one.n_vertices for one in self._pipeline.garments.values())
        frame_bytes = 12 * n_vertices * len(self._tracks)
        self._dressed = lru_cache(max(1, _CACHE_BYTES // frame_bytes))(self._dress)

    def shapes(self, index: int) -> Sequence[SceneMesh]:
        """All persons in a frame, dressed. Raises `RefuError`."""
        return self._dressed(index)[0]

    def facts(self, index: int) -> list[str]:
        """What collision handling reports of a frame, and how long it took."""
        return self._dressed(index)[1]

    def _dress(self, index: int) -> tuple[list[SceneMesh], list[str]]:
        present = [(track, frame) for track in self._tracks if (frame := track.at(self._moments[index])) is not None]
        begun = time.perf_counter()
        outputs = self._pipeline([frame for _, frame in present])
        facts = [f"dressed in {1e3 * (time.perf_counter() - begun):.0f} ms"]
        for name in self.garments:
            stats = [output.stats.garments[name] for output in outputs]
            inside, left = sum(one.n_inside for one in stats), sum(one.n_unresolved for one in stats)
            found = f"{inside} vertices inside, {left} afterwards" if self.sdf != "none" else "as the network says"
            facts.append(f"{name}: {found}")
        people = zip(present, outputs, strict=True)
        return [shape for (track, _), output in people for shape in self._of(track, output)], facts

    def _of(self, track: PersonMotion, output: PipelineOutput) -> Iterator[SceneMesh]:
        shift, turn = (track.turn @ output.transl - self._origin).astype(np.float32), track.turn.astype(np.float32)
        for name, vertices in ((BODY, output.body), (SKIN, output.skin)):
            yield SceneMesh(name, track.person, vertices @ turn.T + shift, self._body_faces, SKIN_COLOUR)
        for name, mesh in output.items():
            color = self._pipeline.garments[name].card.color
            yield SceneMesh(name, track.person, mesh.local @ turn.T + shift, mesh.faces, color)

    def _read(self, path: Path, name: str) -> list[PersonMotion]:
        """All persons in a file; their names begin with `name`, which is empty for a single file."""
        options = replace(self._options, input=path)
        topics = _topics_of_people(path) if options.topic is None and options.input_type is None else []
        found = {name: self._frames(options)} if len(topics) < 2 else {}
        for topic in topics if len(topics) > 1 else ():
            person = topic.strip("/").removesuffix(adapters.SMPL_TOPIC).rstrip("/") or "person"
            found[f"{name}/{person}" if name else person] = self._frames(replace(options, topic=topic))
        start = min(frames[0].stamp_ns for frames in found.values())  # each file begins at zero
        tracks = []
        for person, frames in found.items():
            times = np.array([1e-9 * (frame.stamp_ns - start) for frame in frames])
            tracks.append(PersonMotion(person, frames, times, _turn(options, frames)))
        return tracks

    def _frames(self, options: RecordingOptions) -> list[SmplFrame]:
        """At least one frame, in the order of their stamps."""
        source = open_source(options, self._pipeline)
        source.history = PoseHistory()  # garments that are put on later may heed it
        records, frames = list(source.records), []
        for record in records:
            with suppress(RefuError):
                frames.append(source.frame_of(record))
        n_bad = len(records) - len(frames)
        self.notes += source.warnings()
        if n_bad:
            self.notes.append(f"{options.input}: {n_bad} messages are no frame and are left out")
        if not frames:
            raise RefuError(f"{options.input}: no frame that can be shown")
        return sorted(frames, key=lambda frame: frame.stamp_ns)


def _topics_of_people(path: Path) -> list[str]:
    """A bag's topics of persons: `<person>/smpl_params`."""
    if path.suffix.lower() in SUFFIXES:
        return []
    with adapters.BagReader(path) as reader:
        return [
            topic.name
            for topic in reader.topics
            if topic.message_type in adapters.INPUT_TYPES.values()
            and topic.message_count
            and topic.name.rsplit("/", maxsplit=1)[-1] == adapters.SMPL_TOPIC
        ]


def _turn(options: RecordingOptions, frames: Sequence[SmplFrame]) -> NDArray[np.float64]:
    """Rotation from the frames' axes to z up, as for markers; with axes `frame`, people are turned upright first."""
    to_ros = np.roll(np.eye(3), 1, axis=0)
    if options.axes != "frame":
        return to_ros
    return to_ros @ upright_turn(np.array([frame.pose[0] for frame in frames], np.float64))
