"""The inference thread: frames of all persons in, one checked MarkerArray out, and nothing done that nobody needs."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from msg_adapters import EncodeError, MarkerArrayEncoder, MarkerMesh, encode_delete, garment_namespace
from msg_adapters.markers import SKIN
from refu_core._device import is_device_loss
from refu_core.modes import BetasSource

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from refu_core import GarmentPipeline, SmplFrame
    from refu_core.realtime import PipelineOutput
    from refu_ros._scene import Arrival, Scene
    from refu_ros._settings import NodeSettings
    from refu_ros._statistics import Statistics

_IDLE_S = 0.1
"""How often the thread looks for persons who have left when nobody sends [s]."""
_EMPTY_S = 2.0
"""The same when nobody is there [s]; a new person wakes the thread at once."""
_MAX_ENCODERS = 16
"""Sets of persons whose message layout is kept; making one takes a millisecond."""


class Outlet(Protocol):
    """Where the messages go."""

    def watched(self) -> bool:
        """Whether anybody wants garments."""

    def body_watched(self) -> bool:
        """Whether anybody wants bodies."""

    def now_ns(self) -> int:
        """ROS time [ns]."""

    def send_garments(self, data: bytes) -> None:
        """A MarkerArray for `garments`."""

    def send_body(self, data: bytes) -> None:
        """A MarkerArray for `body`."""

    def device_lost(self, reason: str) -> None:
        """The pipeline's device has failed: nothing comes before there is another pipeline."""


@dataclass(frozen=True, eq=False)
class _Dressed:
    """A person as last computed, without the translation."""

    inputs: bytes
    """What the result depends on."""
    output: PipelineOutput


class Worker:
    """Takes the newest frames from the scene and sends garments, in a thread of its own.

    `settings` may be replaced at any time; a tick sees one version of it.
    """

    def __init__(
        self, scene: Scene, statistics: Statistics, outlet: Outlet, *, settings: NodeSettings, pipeline: GarmentPipeline
    ) -> None:
        self.settings = settings
        self._scene = scene
        self._statistics = statistics
        self._outlet = outlet
        self._next_pipeline = self._pipeline = pipeline
        self._dressed: dict[str, _Dressed] = {}
        self._encoders: dict[tuple[object, ...], MarkerArrayEncoder] = {}
        self._shown: dict[str, tuple[str, ...]] = {}
        self._bodies_shown: set[str] = set()
        self._is_lost = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="inference")

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread after the tick under way and clears the scene of viewers."""
        self._stopping.set()
        self._scene.wake()
        if self._thread.ident is not None:
            self._thread.join()
        self._remove([*self._shown])

    def use(self, pipeline: GarmentPipeline) -> None:
        """Another pipeline from the next tick on."""
        self._next_pipeline = pipeline

    def _run(self) -> None:
        torch.set_num_threads(1)  # the robot's other nodes want their cores, too
        last = -1e9
        while not self._stopping.is_set():
            period = 1.0 / self.settings.max_rate if self.settings.max_rate else 0.0
            idle = _IDLE_S if self._shown or self._scene.persons else _EMPTY_S
            arrivals = self._scene.take(not_before=last + period, timeout=idle)
            now = time.monotonic()
            if arrivals:  # on the grid of the rate as long as the frames keep up with it
                last = last + period if now < last + 2 * period else now
            try:
                self.tick(arrivals)
            except Exception as error:  # whatever one frame brings up, the next may be good
                self._fail(error, "")

    def tick(self, arrivals: Mapping[str, Arrival]) -> None:
        """Works on one frame each of some persons."""
        settings = self.settings
        if self._next_pipeline is not self._pipeline:
            self._pipeline = self._next_pipeline
            self._is_lost = False
            self._dressed.clear()
            self._encoders.clear()
        if settings.margin != self._pipeline.margin:
            self._pipeline.margin = settings.margin
            self._dressed.clear()
        self._remove(self._scene.leave(settings.person_timeout))
        arrivals = self._near(arrivals, settings)
        if not arrivals:
            return
        if not (self._outlet.watched() or self._outlet.body_watched()):
            for _ in arrivals:
                self._statistics.skip("unwatched")
            return
        frames = {person: _with_settings(arrival.frame, settings) for person, arrival in arrivals.items()}
        found, unresolved = self._dress(frames)
        dressed = {person: frame for person, frame in frames.items() if person in self._dressed}
        if not dressed:
            return
        self._send(dressed, settings)
        done = time.monotonic()
        latencies = [1e3 * (done - arrivals[person].received) for person in dressed]
        self._statistics.publish(latencies, found=found, unresolved=unresolved)

    def _near(self, arrivals: Mapping[str, Arrival], settings: NodeSettings) -> dict[str, Arrival]:
        near = {}
        for person, arrival in arrivals.items():
            if settings.max_distance and np.linalg.norm(arrival.frame.transl) > settings.max_distance:
                self._statistics.skip("distance")
                self._remove([person])
            else:
                near[person] = arrival
        return near

    def _dress(self, frames: Mapping[str, SmplFrame]) -> tuple[int, int]:
        """Brings `_dressed` up to date; returns how many vertices were inside, and still are."""
        todo: dict[str, SmplFrame] = {}
        for person, frame in frames.items():
            known = self._dressed.get(person)
            if known is not None and known.inputs == _inputs(frame):
                self._statistics.skip("unchanged")
            else:
                todo[person] = frame
                self._dressed.pop(person, None)
        found = unresolved = 0
        for person, output in self._infer(todo).items():
            if not all(np.isfinite(mesh.local).all() for mesh in output.values()):
                self._statistics.drop("not_finite", f"{person or 'the person'}: a garment isn't finite")
                continue
            self._dressed[person] = _Dressed(_inputs(todo[person]), output)
            found += sum(stats.n_inside for stats in output.stats.garments.values())
            unresolved += sum(stats.n_unresolved for stats in output.stats.garments.values())
            self._statistics.shift(output.stats.shift.largest)
            if not output.stats.within_promise:
                self._statistics.beyond_promise()
        return found, unresolved

    def _infer(self, frames: Mapping[str, SmplFrame]) -> dict[str, PipelineOutput]:
        """All persons in one batch; where that fails, one by one, so that one's failure is nobody else's."""
        try:
            return dict(zip(frames, self._pipeline(list(frames.values())), strict=True))
        except Exception as error:
            if len(frames) == 1:
                (person,) = frames
                self._fail(error, f"{person or 'the person'}: ")
                return {}
        outputs: dict[str, PipelineOutput] = {}
        for person, frame in frames.items():
            outputs |= self._infer({person: frame})
        return outputs

    def _fail(self, error: Exception, who: str) -> None:
        """Counts what a frame was lost to; a device that has failed is reported once."""
        if not is_device_loss(error):
            self._statistics.drop("failed", f"{who}{type(error).__name__}: {error}")
            return
        self._statistics.drop("device", f"{who}the device has failed: {error}")
        if not self._is_lost:
            self._is_lost = True
            self._outlet.device_lost(str(error))

    def _send(self, frames: Mapping[str, SmplFrame], settings: NodeSettings) -> None:
        """One message with these persons, each marker with the stamp of its person's frame."""
        persons = tuple(frames)
        names = tuple(self._pipeline.garments)
        try:
            data = self._encoder("garments", persons, settings).encode(
                [self._dressed[person].output[name].local for person in persons for name in names],
                stamp_ns=[frames[person].stamp_ns for person in persons for _ in names],
                transl=[frames[person].transl for person in persons for _ in names],
            )
        except EncodeError as error:
            self._statistics.drop("not_finite", str(error))
            return
        self._outlet.send_garments(data)
        for person in persons:
            shown = tuple(garment_namespace(name, person) for name in names)
            left = set(self._shown.get(person, ())) - set(shown)
            self._shown[person] = shown
            if left:
                self._outlet.send_garments(self._deletion(sorted(left)))
        if self._outlet.body_watched():
            data = self._encoder("body", persons, settings).encode(
                [self._dressed[person].output.body for person in persons],
                stamp_ns=[frames[person].stamp_ns for person in persons],
                transl=[frames[person].transl for person in persons],
            )
            self._outlet.send_body(data)
            self._bodies_shown.update(persons)

    def _encoder(self, kind: str, persons: tuple[str, ...], settings: NodeSettings) -> MarkerArrayEncoder:
        placed: dict[str, Any] = {
            "frame_id": settings.frame_id,
            "axes": settings.axes,
            "lifetime_ns": settings.lifetime_ns,
        }
        key = (kind, persons, *placed.values())
        if key not in self._encoders:
            if len(self._encoders) >= _MAX_ENCODERS:
                self._encoders.clear()
            meshes = [
                mesh
                for person in persons
                for mesh in (self._garment_meshes if kind == "garments" else self._body_mesh)(person)
            ]
            self._encoders[key] = MarkerArrayEncoder(meshes, **placed)
        return self._encoders[key]

    def _garment_meshes(self, person: str) -> list[MarkerMesh]:
        return [
            MarkerMesh(
                ns=garment_namespace(name, person),
                faces=garment.faces.cpu().numpy(),
                n_vertices=garment.n_vertices,
                color=(*garment.card.color, 1.0),
            )
            for name, garment in self._pipeline.garments.items()
        ]

    def _body_mesh(self, person: str) -> list[MarkerMesh]:
        body = self._pipeline.body
        name = garment_namespace("body", person)
        return [MarkerMesh(name, body.faces.cpu().numpy(), len(body.v_template), color=SKIN)]

    def _remove(self, persons: Iterable[str]) -> None:
        """Takes persons out of viewers' scenes."""
        for person in persons:
            self._dressed.pop(person, None)
            shown = self._shown.pop(person, ())
            if shown:
                self._outlet.send_garments(self._deletion(shown))
            if person in self._bodies_shown:
                self._bodies_shown.remove(person)
                self._outlet.send_body(self._deletion([garment_namespace("body", person)]))

    def _deletion(self, namespaces: Iterable[str]) -> bytes:
        keys = [(namespace, 0) for namespace in namespaces]
        return encode_delete(keys, stamp_ns=self._outlet.now_ns(), frame_id=self.settings.frame_id)


def _with_settings(frame: SmplFrame, settings: NodeSettings) -> SmplFrame:
    """The frame with the shape and style that the parameters ask for."""
    if settings.betas_source == BetasSource.FIXED:
        frame = replace(frame, betas=np.array(settings.betas))
    if frame.style is None and any(settings.style):
        frame = replace(frame, style=np.array(settings.style))
    return frame


def _inputs(frame: SmplFrame) -> bytes:
    """All that a garment relative to the root depends on."""
    style = b"" if frame.style is None else frame.style.tobytes()
    return frame.pose.tobytes() + frame.betas.tobytes() + style
