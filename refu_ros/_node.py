"""The lifecycle node: topics, parameters, service and diagnostics around the inference thread and the recorder."""

from __future__ import annotations

import math
import time
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import SetParametersResult

import msg_adapters as adapters
from msg_adapters.bags import RunningRecording
from msg_adapters.outputs import GARMENTS, make_outputs
from msg_adapters.scene import Scene
from refu_core import RefuError
from refu_core.errors import printable
from refu_core.options import PIPELINE_OPTIONS, PipelineOptions, specs_of
from refu_ros._bank import QOS, Bank
from refu_ros._beside import PipelineLoader, load
from refu_ros._diagnostics import Situation, statuses
from refu_ros._guard import LOG_PERIOD_S, GuardedNode, transition
from refu_ros._interfaces import interface
from refu_ros._listener import TURN_S, Listener
from refu_ros._requests import Requests
from refu_ros._settings import NodeSettings, declare, parameter

if TYPE_CHECKING:
    from refu_core.outputs import Fittings
    from refu_ros._worker import Worker

NODE_NAME = "garment_node"
DIAGNOSTICS_TOPIC = "/diagnostics"
_BEAT_S = 1.0
"""How often the node reports how it is, and looks for people who came or left unnoticed [s]."""
_LAST_WORDS_S = 0.3
"""Time for the answer to a shutdown request to be sent [s]."""


class GarmentNode(GuardedNode, LifecycleNode):  # type: ignore[misc]
    """Garments of everybody in the scene. `close` it before it is destroyed.

    Raises `RefuError` for parameters that have no meaning.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(NODE_NAME, **options)
        self.ends_at = math.inf
        """When the node ends, on the steady clock [s], because it was told to or can't go on."""
        self.failed = False
        """Whether the node ended because its device failed."""
        self.settings = declare(self, NodeSettings)
        self.recording = RunningRecording(self.get_logger(), sync_period=self.settings.record_sync_period)
        self._state = "unconfigured"
        self._worker: Worker | None = None
        self._loader: PipelineLoader | None = None
        self._loaded: deque[tuple[Fittings, PipelineOptions]] = deque(maxlen=1)
        """What the loader has loaded and the executor's thread hasn't taken over yet."""
        self._fittings: Fittings | None = None
        self._in_use: PipelineOptions | None = None
        self._refused: PipelineOptions | None = None
        self._lost = ""
        self._has_sent = False
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # a simulation that stands still must not stop the diagnostics
        self._listener = Listener(self, steady)
        self._outputs = make_outputs(tf=self.settings.publish_tf)
        self._bank = Bank(self, self._attend)
        # These live as long as the node: viewers stay connected while it is configured anew.
        lasting = {topic: one.message_type for one in self._outputs for topic in one.topics((), None)}
        self._bank.hold(lasting, lasting=True)
        self._diagnostics = self.create_publisher(interface(adapters.DIAGNOSTIC_ARRAY), DIAGNOSTICS_TOPIC, 10)
        self._requests = Requests(self)
        self.add_on_set_parameters_callback(self._on_parameters)
        for beat in (self._look_after, self._report):  # what fails in one must not keep the other from its work
            self.create_timer(_BEAT_S, self.guarded("each second", beat), clock=steady)
        self._hold_later = self.create_timer(0.0, self.guarded("topics", self._hold_topics), clock=steady)
        self._hold_later.cancel()
        if self._listener.is_steady:
            predict = self.guarded("predict", self._listener.predict)
            self.create_timer(1 / self.settings.keypoint_rate, predict, clock=steady)

    @property
    def is_active(self) -> bool:
        return self._state == "active"

    # Lifecycle ------------------------------------------------------------------------------------

    @transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            interface(self._listener.stream.message_type)
            self._take(load(self.settings, threads=self.settings.threads), self.settings.pipeline)
            self._lost = ""  # the device is tried anew
            self.statistics.set_error("")
        except RefuError as error:
            self.get_logger().error(f"can't be configured: {printable(error)}")
            return TransitionCallbackReturn.FAILURE
        self._loader = PipelineLoader(self._on_loaded, self._on_not_loaded, threads=self.settings.threads)
        self._state = "inactive"
        self.get_logger().info(f"configured with {self._in_use}")
        return super().on_configure(state)

    @transition
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Dresses everybody who sends, as soon as somebody wants that."""
        assert self._fittings is not None
        if self.settings.record:
            self.recording.try_start(self.settings.record)  # if it can't, people are dressed all the same
        result = super().on_activate(state)
        scene = self._listener.scene = Scene(self.statistics, most=self._listener.room)
        from refu_ros._worker import Worker  # loads torch

        self._worker = Worker(scene, self.statistics, self, settings=self.settings, fittings=self._fittings)
        self._worker.start()
        self._has_sent = False
        self._state = "active"
        self._hold_topics()
        try:
            self._listener.subscribe()  # even if nobody listens: wrong inputs have to show at the start
        except Exception as error:
            self.get_logger().error(f"can't be activated: {printable(error)}")
            self.on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        self.get_logger().info(f"active: publishes {self._bank.name(GARMENTS)} and what else somebody subscribes to")
        return result

    @transition
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clears the scene, ends a recording, and waits for both."""
        self._deactivate()
        return super().on_deactivate(state)

    @transition
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._cleanup()
        return super().on_cleanup(state)

    @transition
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Ends the node; everything that is queued gets into the file before this returns."""
        self.close()
        self._state = "finalized"
        self.ends_at = time.monotonic() + _LAST_WORDS_S
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begins anew after a transition that raised."""
        self.guarded("on_error", self.close)()
        return super().on_error(state)

    def close(self) -> None:
        """Ends threads and files in the order data flows. May be called more than once."""
        self._requests.close()
        self._deactivate()
        self._cleanup()

    def _deactivate(self) -> None:
        self._listener.unsubscribe()
        if self._worker is not None:
            self._worker.stop()
        self._worker = self._listener.scene = None
        self.recording.close()
        if self._state == "active":
            self._state = "inactive"
            self.get_logger().info("not active any more")

    def _cleanup(self) -> None:
        if self._loader is not None:
            self._loader.close()
        self._loaded.clear()
        self._loader = self._fittings = self._in_use = None
        self._state = "unconfigured"

    def _attend(self) -> None:
        """To be called on the executor's thread when somebody may have begun or ceased to want the output."""
        if self._state == "active":
            self._listener.attend(is_wanted=self.is_watched())

    # Output: what the inference thread calls ------------------------------------------------------

    def is_watched(self) -> bool:
        """Whether anybody listens to anything, or garments are recorded."""
        return self.recording.running or self._bank.is_watched()

    def watchers(self, topic: str) -> int:
        """How many listen to a topic; a recording counts as a listener to garments."""
        return self._bank.watchers(topic) + (topic == GARMENTS and self.recording.running)

    def now_ns(self) -> int:
        """ROS time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def send(self, topic: str, data: bytes) -> None:
        """Publishes, and records garments: the rest follows from the recorded inputs."""
        self._bank.send(topic, data)
        if topic != GARMENTS:
            return
        self.recording.put(self._bank.name(topic), adapters.MARKER_ARRAY, data, QOS)
        if not self._has_sent:
            self._has_sent = True
            self.get_logger().info("the first garments are out")

    def _hold_topics(self) -> None:
        """Keeps the publishers for everybody who may come, in what they wear."""
        self._hold_later.cancel()
        if self._worker is None:  # it was deactivated meanwhile
            return
        persons, fittings = self._listener.persons, self._worker.fittings
        wanted = {topic: one.message_type for one in self._outputs for topic in one.topics(persons, fittings)}
        if not self._bank.hold(wanted, until=time.monotonic() + TURN_S):
            self._hold_later.reset()

    def device_lost(self, reason: str) -> None:
        """Goes on on the CPU, or ends, as `on_device_loss` says."""
        self._lost = f"{self.settings.device} has failed ({reason})"
        stops = self.settings.on_device_loss == "stop"
        self.statistics.set_error(f"{self._lost}: {'the node ends' if stops else 'loading for the cpu'}")
        self.get_logger().error(f"{self._lost}: {'the node ends' if stops else 'the cpu takes over'}")
        if stops:
            self.failed, self.ends_at = True, time.monotonic()
        elif self._loader is not None:
            self._loader.request(self._pipeline_key)

    @property
    def _pipeline_key(self) -> PipelineOptions:
        """What is to be loaded: for the CPU once the device has failed."""
        key = self.settings.pipeline
        return replace(key, device="cpu") if self._lost else key

    # Parameters -----------------------------------------------------------------------------------

    def _on_parameters(self, parameters: list[Any]) -> SetParametersResult:
        own = specs_of(NodeSettings)
        values = {parameter.name: parameter.value for parameter in parameters if parameter.name in own}
        if not values:  # rclpy's own, the QoS of a topic for instance
            return SetParametersResult(successful=True)
        try:
            settings = self.settings.changed(values)
            # A repeated request is carried out again, if it has failed or was ended meanwhile.
            known = self.settings.pipeline == self._in_use == settings.pipeline
            if reload := not known and not values.keys().isdisjoint(PIPELINE_OPTIONS):
                settings.pipeline.check_files()
            recorded = settings.record == self.recording.asked and self.recording.running
            if self._state == "active" and "record" in values and not recorded:
                self.recording.start(settings.record) if settings.record else self.recording.end()
        except RefuError as error:
            self.statistics.fault("refused parameters", printable(error))
            return SetParametersResult(successful=False, reason=printable(error))
        if settings.device != self.settings.device:
            self._lost = ""  # the operator knows better
        self.settings = settings
        self._attend()  # a recording may have begun
        if self._fittings is not None:
            self._listener.follow(self._fittings.pipeline.body)
        if self._worker is not None:
            self._worker.settings = settings
        if reload and self._loader is not None:
            self._loader.request(self._pipeline_key)
        return SetParametersResult(successful=True)

    def _take(self, fittings: Fittings, key: PipelineOptions) -> None:
        self._fittings, self._in_use = fittings, key
        self._listener.follow(fittings.pipeline.body)
        for text in fittings.pipeline.warnings:
            self.get_logger().warning(text)

    def _on_loaded(self, *new: Any) -> None:
        self._loaded.append(new)
        if (executor := self.executor) is not None:  # it has none before it spins, nor after
            executor.create_task(self.guarded("loaded", self._take_over))

    def _take_over(self) -> None:
        if not self._loaded:
            return
        fittings, key = self._loaded.popleft()
        self._take(fittings, key)
        if self._worker is not None:
            self._worker.fittings = fittings
        self.statistics.set_error(f"{self._lost}: on the cpu now; set device to try it again" if self._lost else "")
        self.get_logger().info(f"now with {key}")

    def _on_not_loaded(self, error: Exception, key: PipelineOptions) -> None:
        text = printable(f"{key} can't be loaded, {self._in_use} stays: {error}")
        self.statistics.set_error(text)
        self.get_logger().error(text)
        self._refused = key

    def _take_back(self) -> None:
        """Sets the parameters back to the pipeline in use, if the one they ask for can't be loaded.

        If it has been asked for again meanwhile, it is tried again.
        """
        refused, self._refused = self._refused, None
        is_newest = self._loader is not None and refused is self._loader.wanted
        if is_newest and self._in_use is not None and refused == self.settings.pipeline:
            used = {name: getattr(self._in_use, name) for name in PIPELINE_OPTIONS}
            changed = {name: value for name, value in used.items() if value != getattr(refused, name)}
            self.set_parameters([parameter(name, value) for name, value in changed.items()])

    def record(self, *, on: bool, path: str = "") -> tuple[str, str]:
        """Starts or stops a recording, by default to the parameter's path; returns what has been done, and the bag.

        Raises `RefuError` where it can't.
        """
        if on and self._state != "active":
            raise RefuError(f"the node is {self._state}: activate it first")
        done = self.recording.switch(path or self.settings.record, on=on)
        self._attend()
        return done

    # Once a second --------------------------------------------------------------------------------

    def _look_after(self) -> None:
        """Notices what no event has told of."""
        self._take_over()
        self._take_back()
        self._attend()
        if self._worker is not None:
            self._hold_topics()
            for name, reason in [*self._worker.fittings.without_planner.items()]:  # a thread adds to them
                text = f"planners aren't sent {name}: {printable(reason)}"
                self.get_logger().warning(text, throttle_duration_sec=60.0)

    def _report(self) -> None:
        report = self.statistics.report()
        recording, error = self.recording.state()
        scene, since = self._listener.scene, self._listener.since
        if error:
            self.get_logger().error(f"not recording: {error}", throttle_duration_sec=60.0)
        if report.recent["drop.transform"]:
            self.get_logger().warning(report.reasons["transform"], throttle_duration_sec=LOG_PERIOD_S)
        if report.recent["drop.failed"]:
            self.get_logger().error(report.reasons["failed"], throttle_duration_sec=LOG_PERIOD_S)
        now = Situation(
            node=self.get_fully_qualified_name().lstrip("/"),
            state=self._state,
            in_use=self._in_use,
            expected=self._listener.expected,
            input_frame=self._listener.input_frame,
            is_untransformed=self._listener.is_untransformed,
            has_foreign_betas=self._listener.doubts.has_foreign_betas and not self.settings.betas_are_told,
            doubted=self._listener.doubted,
            has_no_clock=bool(self.get_parameter("use_sim_time").value) and not self.now_ns(),
            persons=() if scene is None else scene.persons,
            recording=recording,
            recording_error=error,
            listening_for=None if since is None else time.monotonic() - since,
            n_namesakes=self._count_namesakes(),
        )
        data = adapters.encode_diagnostics(statuses(report, self.settings, now), stamp_ns=self.now_ns())
        self._diagnostics.publish(data)
        self.recording.put(self._diagnostics.topic_name, adapters.DIAGNOSTIC_ARRAY, data, QOS)

    def _count_namesakes(self) -> int:
        """How many other nodes have this name: they answer each other's requests, and their topics mix."""
        own = (self.get_name(), self.get_namespace())
        names = self.guarded("names of nodes", self.get_node_names_and_namespaces, lambda _: [])  # a peer's isn't UTF-8
        count = max(0, [*names()].count(own) - 1)
        if count:
            self.get_logger().warning(f"{count + 1} nodes are called {own[0]}", throttle_duration_sec=60.0)
        return count
