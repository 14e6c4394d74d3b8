"""The inference threads: frames of all persons in, one checked MarkerArray out, and nothing done that nobody needs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from msg_adapters import Placement
from msg_adapters.axes import ros_from_sender
from msg_adapters.outputs import Moment, make_outputs
from msg_adapters.scene import Arrival, Scene
from msg_adapters.statistics import COARSE_M, Statistics
from refu_core import RefuError, SmplFrame
from refu_core._device import is_device_loss
from refu_core.history import PoseHistory
from refu_core.outputs import DressedPerson, Fittings
from refu_core.realtime import PipelineOutput
from refu_ros._settings import NodeSettings

if TYPE_CHECKING:
    from refu_ros._node import GarmentNode

_IDLE_S = 0.1
"""How often the thread looks for persons who have left when nobody sends [s]."""
_EMPTY_S = 2.0
"""The same when nobody is there [s]; a new person wakes the thread at once."""


class _Known(NamedTuple):
    """A person as last computed, without the translation."""

    inputs: tuple[object, ...]
    """What the result depends on."""
    output: PipelineOutput


@dataclass(frozen=True, eq=False)
class _Batch:
    """One frame of each of some persons, from when they are taken until their garments are sent."""

    turn: int
    settings: NodeSettings
    fittings: Fittings
    arrivals: Mapping[str, Arrival]
    frames: Mapping[str, SmplFrame]
    known: Mapping[str, _Known]
    """Results of those for whom nothing has changed but their position."""
    gone: list[str]

    def inputs(self, frame: SmplFrame) -> tuple[object, ...]:
        """All that a garment relative to the root depends on."""
        style = b"" if frame.style is None else frame.style.tobytes()
        past = b"" if frame.past is None else frame.past.tobytes()
        up = frame.up.tobytes()
        return self.fittings, self.settings.margin, frame.pose.tobytes() + frame.betas.tobytes() + style, up, past


def _there(arrival: Arrival, settings: NodeSettings) -> Placement:
    """The placement from the axes of the sender's roots to those of the messages."""
    return arrival.placement.after(Placement(ros_from_sender(settings.axes)))


class Worker:
    """Takes the newest frames from the scene and sends garments, in threads of its own.

    While one thread computes, others take what has come since, up to the pipeline's `threads` at once. They send in the
    order in which they took frames, so nobody sees a frame after a later one. `settings` may be replaced at any time; a
    tick sees one version of it. `outlet` is the node, to which messages go.
    """

    def __init__(
        self, scene: Scene, statistics: Statistics, outlet: GarmentNode, *, settings: NodeSettings, fittings: Fittings
    ) -> None:
        self.settings, self._scene, self._statistics, self._outlet = settings, scene, statistics, outlet
        self.fittings = self._planned_with = self._sent_with = fittings
        """The pipeline, and what is known of its garments; others may be put here at any time, for the next tick."""
        self._dressed: dict[str, _Known] = {}
        self._history, self._told_in = PoseHistory(), (settings.frame_id, settings.axes)
        self._outputs = make_outputs(tf=settings.publish_tf)  # they remember what was worn
        self._here: set[str] = set()
        self._is_lost = False
        self._stopping = threading.Event()
        self._last = -1e9
        self._taking = threading.Lock()
        """Guards what is decided when frames are taken."""
        self._in_order = threading.Condition()
        """Guards what is done in the order of turns: sending, and what is known of the people sent."""
        self._n_taken = self._n_done = 0
        self._threads = [threading.Thread(target=self._run, name=f"inference {i}") for i in range(settings.threads)]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ends the threads after the ticks under way, and removes everybody from viewers' scenes."""
        self._stopping.set()
        self._scene.wake()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        self._remove([*self._here])

    def _run(self) -> None:
        torch.set_num_threads(1)  # the robot's other nodes want their cores, too
        while not self._stopping.is_set():
            try:
                self.tick(self._take)
            except Exception as error:  # noqa: PERF203 - whatever one frame brings up, the next may be good
                self._fail(error, "")

    def _take(self) -> Mapping[str, Arrival]:
        """The newest frames, as soon as there are some, a thread of the pipeline is free, and the rate allows it."""
        with self._in_order:
            self._in_order.wait_for(lambda: self._n_taken - self._n_done < self.fittings.pipeline.threads)
        period = 1.0 / self.settings.max_rate if self.settings.max_rate else 0.0
        idle = _IDLE_S if self._here or self._scene.persons else _EMPTY_S
        arrivals = self._scene.take(not_before=self._last + period, timeout=idle)
        now = time.monotonic()
        if arrivals:  # on the grid of the rate as long as the frames keep up with it
            self._last = self._last + period if now < self._last + 2 * period else now
        return arrivals

    def tick(self, take: Callable[[], Mapping[str, Arrival]]) -> None:
        """Works on one frame each of some persons: those that `take` gives."""
        with self._taking:  # first who has gone, then who is taken: nobody is dressed whose leaving was told before
            batch = self._plan(self._scene.leave(self.settings.person_timeout), take())
        outputs: dict[str, PipelineOutput] = {}
        try:
            new = {person: frame for person, frame in batch.frames.items() if person not in batch.known}
            outputs = self._infer(batch, new)
        finally:  # the others would wait forever for a turn that is left out
            with self._in_order:
                self._in_order.wait_for(lambda: self._n_done == batch.turn)
                try:
                    self._finish(batch, outputs)
                finally:
                    self._n_done += 1
                    self._in_order.notify_all()

    def _plan(self, gone: list[str], arrivals: Mapping[str, Arrival]) -> _Batch:
        """What there is to do for these people, and with what."""
        settings, fittings = self.settings, self.fittings
        if fittings is not self._planned_with:
            self._planned_with, self._is_lost = fittings, False
        if self._told_in != (settings.frame_id, settings.axes):  # nobody has moved: they are only described anew
            self._history, self._told_in = PoseHistory(), (settings.frame_id, settings.axes)
        near = self._near(arrivals, settings)
        gone = gone + [person for person in arrivals if person not in near]
        for person in gone:
            self._history.forget(person)
        if near and not self._outlet.is_watched():
            for _ in near:
                self._statistics.count("skip.unwatched")
            near = {}
        frames = {person: settings.applied(arrival.frame) for person, arrival in near.items()}
        if fittings.pipeline.heeds_past:
            places = {person: _there(arrival, settings) for person, arrival in near.items()}
            frames = {person: self._told(frame, person, places[person]) for person, frame in frames.items()}
        known: dict[str, _Known] = {}
        batch = _Batch(self._n_taken, settings, fittings, near, frames, known, gone)
        for person, frame in frames.items():
            last = self._dressed.get(person)
            if last is not None and last.inputs == batch.inputs(frame):
                self._statistics.count("skip.unchanged")
                known[person] = last
        self._n_taken += 1
        return batch

    def _told(self, frame: SmplFrame, person: str, there: Placement) -> SmplFrame:
        """A frame with its past in the messages' frame, where what moves only for a moving camera stands still."""
        body = self._planned_with.pipeline.body
        pelvis = body.rest_joints(torch.tensor(frame.betas[None], device=body.device))[0, 0].cpu().double().numpy()
        pose = frame.pose.copy()
        pose[0] = Rotation.from_matrix(there.rotation @ Rotation.from_rotvec(pose[0]).as_matrix()).as_rotvec()
        place = there.rotation @ (frame.transl + pelvis) + there.translation
        return replace(frame, past=self._history(replace(frame, pose=pose, transl=place), person).past)

    def _finish(self, batch: _Batch, outputs: Mapping[str, PipelineOutput]) -> None:
        self._remove(batch.gone)
        found, unresolved = self._remember(batch, outputs)
        dressed = {person: frame for person, frame in batch.frames.items() if person in self._dressed}
        if not dressed:
            return
        self._send(batch, dressed)
        done = time.monotonic()
        latencies = [1e3 * (done - batch.arrivals[person].received) for person in dressed]
        self._statistics.publish(latencies, found=found, unresolved=unresolved)

    def _near(self, arrivals: Mapping[str, Arrival], settings: NodeSettings) -> dict[str, Arrival]:
        near = {}
        for person, arrival in arrivals.items():
            there = _there(arrival, settings)
            place = there.rotation @ arrival.frame.transl + there.translation
            if arrival.told_in not in (None, self._told_in):  # placed before a parameter said where anew
                self._statistics.count("skip.superseded")
            elif settings.max_distance and np.linalg.norm(place) > settings.max_distance:
                self._statistics.count("skip.distance")
            else:
                near[person] = arrival
        return near

    def _remember(self, batch: _Batch, outputs: Mapping[str, PipelineOutput]) -> tuple[int, int]:
        """Brings `_dressed` up to date; returns how many vertices were inside, and still are."""
        found = unresolved = 0
        for person, frame in batch.frames.items():
            self._dressed.pop(person, None)
            if person in batch.known:
                self._dressed[person] = batch.known[person]
            elif (output := outputs.get(person)) is not None:
                if not all(np.isfinite(mesh.local).all() for mesh in output.values()):
                    self._statistics.drop("not_finite", f"{person or 'the person'}: a garment isn't finite")
                    continue
                self._dressed[person] = _Known(batch.inputs(frame), output)
                found += sum(stats.n_inside for stats in output.stats.garments.values())
                unresolved += sum(stats.n_unresolved for stats in output.stats.garments.values())
                self._statistics.shift(output.stats.shift.largest)
                if not output.stats.within_promise:
                    self._statistics.count("beyond_promise")
        return found, unresolved

    def _infer(self, batch: _Batch, frames: Mapping[str, SmplFrame]) -> dict[str, PipelineOutput]:
        """All persons in one batch; where that fails, one by one, so that one failure affects nobody else."""
        try:
            outputs = batch.fittings.pipeline([*frames.values()], margin=batch.settings.margin) if frames else []
            return dict(zip(frames, outputs, strict=True))
        except Exception as error:
            if len(frames) == 1:
                self._fail(error, f"{next(iter(frames)) or 'the person'}: ")
                return {}
        alone = [self._infer(batch, {person: frame}) for person, frame in frames.items()]
        return {person: output for found in alone for person, output in found.items()}

    def _fail(self, error: Exception, who: str) -> None:
        """Counts what a frame was lost to; a device that has failed is reported once."""
        if not is_device_loss(error):
            self._statistics.drop("failed", f"{who}{type(error).__name__}: {error}")
            return
        self._statistics.drop("device", f"{who}the device has failed: {error}")
        if not self._is_lost:
            self._is_lost = True
            self._outlet.device_lost(str(error))

    def _send(self, batch: _Batch, frames: Mapping[str, SmplFrame]) -> None:
        """Sends what anybody wants to know of these people."""
        if batch.fittings is not self._sent_with:
            self._sent_with = batch.fittings
            for row in self._outputs:
                row.forget()
        worn = []
        for person, frame in sorted(frames.items()):  # the same people's messages are laid out once
            arrival, output = batch.arrivals[person], self._dressed[person].output
            there = _there(arrival, batch.settings)
            offset = there.rotation @ frame.transl + there.translation
            if np.abs(offset).max() >= COARSE_M:
                self._statistics.count("coarse")
            worn.append(DressedPerson(person, frame, output, batch.fittings, there.rotation, offset, arrival.camera))
        self._here.update(frames)
        for row in self._outputs:
            self._publish(row.messages(worn, self._moment(batch.settings)))

    def _publish(self, messages: Iterable[tuple[str, bytes]]) -> None:
        try:
            for topic, data in messages:
                self._outlet.send(topic, data)
        except RefuError as error:
            self._statistics.drop("not_finite", str(error))

    def _remove(self, persons: list[str]) -> None:
        """Takes persons out of viewers' scenes."""
        for person in persons:
            self._dressed.pop(person, None)
        gone = [person for person in persons if person in self._here]
        self._here -= {*gone}
        for row in self._outputs if gone else ():
            self._publish(row.gone(gone, self._moment(self.settings)))

    def _moment(self, settings: NodeSettings) -> Moment:
        told = settings.frame_id, settings.lifetime_ns, settings.points_fields, settings.planner_rate
        return Moment(*told, self._outlet.watchers, self._outlet.now_ns())
