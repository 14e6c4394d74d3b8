"""The inference thread: frames of all persons in, one checked MarkerArray out, and nothing done that nobody needs."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from msg_adapters import Placement
from msg_adapters.axes import SMPL_COLUMNS
from msg_adapters.outputs import Moment, Output, make_outputs
from refu_core import GarmentPipeline, RefuError, SmplFrame
from refu_core._device import is_device_loss
from refu_core.modes import BetasSource
from refu_core.outputs import Dressed, Fittings
from refu_core.realtime import PipelineOutput
from refu_ros._scene import Arrival, Scene
from refu_ros._settings import NodeSettings
from refu_ros._statistics import Statistics

_IDLE_S = 0.1
"""How often the thread looks for persons who have left when nobody sends [s]."""
_EMPTY_S = 2.0
"""The same when nobody is there [s]; a new person wakes the thread at once."""


class Outlet(Protocol):
    """Where the messages go."""

    def is_watched(self) -> bool:
        """Whether anybody wants anything."""

    def watchers(self, topic: str) -> int:
        """How many want a topic."""

    def now_ns(self) -> int:
        """ROS time [ns]."""

    def send(self, topic: str, data: bytes) -> None:
        """A message for a topic."""

    def device_lost(self, reason: str) -> None:
        """The pipeline's device has failed: nothing comes before there is another pipeline."""


@dataclass(frozen=True, eq=False)
class _Known:
    """A person as last computed, without the translation."""

    inputs: bytes
    """What the result depends on."""
    output: PipelineOutput


class Worker:
    """Takes the newest frames from the scene and sends garments, in a thread of its own.

    `settings` may be replaced at any time; a tick sees one version of it.
    """

    def __init__(
        self,
        scene: Scene,
        statistics: Statistics,
        outlet: Outlet,
        *,
        settings: NodeSettings,
        pipeline: GarmentPipeline,
        outputs: Sequence[Output] | None = None,
    ) -> None:
        self.settings = settings
        self._scene = scene
        self._statistics = statistics
        self._outlet = outlet
        self._next_pipeline = self._pipeline = pipeline
        self._dressed: dict[str, _Known] = {}
        self._outputs = make_outputs() if outputs is None else outputs
        self._fittings = Fittings(pipeline, weights=settings.weights or None)
        self._here: set[str] = set()
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
        self._remove([*self._here])

    def use(self, pipeline: GarmentPipeline) -> None:
        """Another pipeline from the next tick on."""
        self._next_pipeline = pipeline

    def _run(self) -> None:
        torch.set_num_threads(1)  # the robot's other nodes want their cores, too
        last = -1e9
        while not self._stopping.is_set():
            period = 1.0 / self.settings.max_rate if self.settings.max_rate else 0.0
            idle = _IDLE_S if self._here or self._scene.persons else _EMPTY_S
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
            self._fittings = Fittings(self._pipeline, weights=settings.weights or None)
            for output in self._outputs:
                output.forget()
        if settings.margin != self._pipeline.margin:
            self._pipeline.margin = settings.margin
            self._dressed.clear()
        self._remove(self._scene.leave(settings.person_timeout))
        arrivals = self._near(arrivals, settings)
        if not arrivals:
            return
        if not self._outlet.is_watched():
            for _ in arrivals:
                self._statistics.count("skip.unwatched")
            return
        frames = {person: with_settings(arrival.frame, settings) for person, arrival in arrivals.items()}
        found, unresolved = self._dress(frames)
        dressed = {person: frame for person, frame in frames.items() if person in self._dressed}
        if not dressed:
            return
        self._send(dressed, arrivals, settings)
        done = time.monotonic()
        latencies = [1e3 * (done - arrivals[person].received) for person in dressed]
        self._statistics.publish(latencies, found=found, unresolved=unresolved)

    def _near(self, arrivals: Mapping[str, Arrival], settings: NodeSettings) -> dict[str, Arrival]:
        near = {}
        for person, arrival in arrivals.items():
            place = arrival.placement.rotation @ arrival.frame.transl + arrival.placement.translation
            if settings.max_distance and np.linalg.norm(place) > settings.max_distance:
                self._statistics.count("skip.distance")
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
                self._statistics.count("skip.unchanged")
            else:
                todo[person] = frame
                self._dressed.pop(person, None)
        found = unresolved = 0
        for person, output in self._infer(todo).items():
            if not all(np.isfinite(mesh.local).all() for mesh in output.values()):
                self._statistics.drop("not_finite", f"{person or 'the person'}: a garment isn't finite")
                continue
            self._dressed[person] = _Known(_inputs(todo[person]), output)
            found += sum(stats.n_inside for stats in output.stats.garments.values())
            unresolved += sum(stats.n_unresolved for stats in output.stats.garments.values())
            self._statistics.shift(output.stats.shift.largest)
            if not output.stats.within_promise:
                self._statistics.count("beyond_promise")
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

    def _send(self, frames: Mapping[str, SmplFrame], arrivals: Mapping[str, Arrival], settings: NodeSettings) -> None:
        """What anybody wants to know of these people."""
        axes = Placement(np.eye(3)[list(SMPL_COLUMNS[settings.axes])])
        worn = []
        for person, frame in frames.items():
            arrival, output = arrivals[person], self._dressed[person].output
            there = arrival.placement.after(axes)
            offset = there.rotation @ frame.transl + there.translation
            worn.append(Dressed(person, frame, output, self._fittings, there.rotation, offset, arrival.camera))
        self._here.update(frames)
        moment = self._moment(settings)
        for row in self._outputs:
            self._publish(row.messages(worn, moment))

    def _publish(self, messages: Iterable[tuple[str, bytes]]) -> None:
        try:
            for topic, data in messages:
                self._outlet.send(topic, data)
        except RefuError as error:
            self._statistics.drop("not_finite", str(error))

    def _remove(self, persons: Iterable[str]) -> None:
        """Takes persons out of viewers' scenes."""
        everyone = [*persons]
        for person in everyone:
            self._dressed.pop(person, None)
        gone = [person for person in everyone if person in self._here]
        self._here -= {*gone}
        moment = self._moment(self.settings)
        for output in self._outputs if gone else ():
            self._publish(output.gone(gone, moment))

    def _moment(self, settings: NodeSettings) -> Moment:
        return Moment(settings, self._outlet.watchers, self._outlet.now_ns())


def with_settings(frame: SmplFrame, settings: NodeSettings) -> SmplFrame:
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
