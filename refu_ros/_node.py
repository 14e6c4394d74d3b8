"""The lifecycle node: topics, parameters, service and diagnostics around the inference thread and the recorder."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import SetParametersResult
from rclpy.qos_overriding_options import QoSOverridingOptions

import msg_adapters as adapters
from refu_core import FrameError, RefuError
from refu_core.errors import printable
from refu_ros._decoding import InputDecoder
from refu_ros._diagnostics import statuses
from refu_ros._guard import GuardedNode, answer_no, transition
from refu_ros._interfaces import interface, ros_qos
from refu_ros._loader import PipelineLoader
from refu_ros._parameters import declare_settings
from refu_ros._recording import Recording
from refu_ros._scene import Scene
from refu_ros._settings import specs
from refu_ros._worker import Worker

if TYPE_CHECKING:
    from refu_core import GarmentPipeline
    from refu_ros._settings import PipelineKey

NODE_NAME = "garment_node"
DIAGNOSTICS_TOPIC = "/diagnostics"
_HUMANS = re.compile(r"/humans/bodies/([A-Za-z0-9_]+)/joint_states")
_LOG_PERIOD_S = 5.0
_GRACE_S = 5.0
"""How long the inputs stay subscribed to when nobody is left: many a viewer is only restarted [s]."""
_INPUT_QOS = adapters.QosProfile(reliability="best_effort", depth=1)
_OUTPUT_QOS = adapters.QosProfile(reliability="reliable", depth=5)
_OVERRIDABLE = QoSOverridingOptions.with_default_policies()


class GarmentNode(GuardedNode, LifecycleNode):  # type: ignore[misc]
    """Garments of everybody in the scene. `close` it before it is destroyed.

    Raises `RefuError` for parameters that have no meaning.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(NODE_NAME, **options)
        self.finalized = False
        self.failed = False
        """Whether it ended because its device did."""
        self.settings = declare_settings(self)
        self.recording = Recording(self.get_logger().info, sync_period=self.settings.record_sync_period)
        self._state = "unconfigured"
        self._scene: Scene | None = None
        self._worker: Worker | None = None
        self._loader: PipelineLoader | None = None
        self._pipeline: GarmentPipeline | None = None
        self._in_use: PipelineKey | None = None
        self._lost = ""
        self._inputs: dict[str, Any] = {}
        self._input_frame = ""
        self._listening_since: float | None = None
        self._wanted_at = 0.0
        self._has_sent = False
        self._decoder = InputDecoder(self.settings)
        # These live as long as the node: who looks stays connected while it is configured anew.
        self._garments, self._body = (
            self.create_lifecycle_publisher(
                interface(adapters.MARKER_ARRAY),
                topic,
                ros_qos(_OUTPUT_QOS),
                qos_overriding_options=_OVERRIDABLE,
                event_callbacks=PublisherEventCallbacks(matched=lambda _: self._attend()),
            )
            for topic in ("garments", "body")
        )
        self._diagnostics = self.create_publisher(interface(adapters.DIAGNOSTIC_ARRAY), DIAGNOSTICS_TOPIC, 10)
        switch = self.guarded("record", self._on_record, answer_no)
        self.create_service(interface("std_srvs/srv/SetBool"), "~/record", switch)
        self.add_on_set_parameters_callback(self._on_parameters)
        # Steady time: a simulation that stands still must not stop the diagnostics.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self.guarded("each second", self._on_second), clock=steady)
        if self._decoder.is_steady:
            self.create_timer(1 / self.settings.keypoint_rate, self.guarded("predict", self._on_due), clock=steady)

    # Lifecycle ------------------------------------------------------------------------------------

    @transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Loads the garments."""
        try:
            interface(self._decoder.message_type)
            self._take(self.settings.pipeline.load(), self.settings.pipeline)
        except RefuError as error:
            self.get_logger().error(f"can't be configured: {printable(error)}")
            return TransitionCallbackReturn.FAILURE
        self._loader = PipelineLoader(self._on_loaded, self._on_not_loaded)
        self._state = "inactive"
        self.get_logger().info(f"configured with {self._in_use}")
        return super().on_configure(state)

    @transition
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Dresses who sends, as soon as somebody wants that."""
        assert self._pipeline is not None
        self.recording.try_start(self.settings.record)  # where it can't: no reason to leave people undressed
        result = super().on_activate(state)
        self._scene = Scene(self.statistics)
        self._worker = Worker(self._scene, self.statistics, self, settings=self.settings, pipeline=self._pipeline)
        self._worker.start()
        self._has_sent = False
        self._state = "active"
        try:
            self._subscribe()  # in any case: what is wrong with the inputs has to show at the start
        except Exception as error:
            self.get_logger().error(f"can't be activated: {printable(error)}")
            self.on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        self.get_logger().info(f"active: publishes {self._garments.topic_name} and {self._body.topic_name}")
        return result

    @transition
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clears the scene, ends a recording, and waits for both."""
        self._deactivate()
        return super().on_deactivate(state)

    @transition
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forgets the garments."""
        self._cleanup()
        return super().on_cleanup(state)

    @transition
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Everything that is queued gets into the file before this returns. The node ends: it was told to."""
        self.finalized = True
        self.close()
        self._state = "finalized"
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a transition that raised: begins anew."""
        self.guarded("on_error", self.close)()
        return super().on_error(state)

    def close(self) -> None:
        """Ends threads and files in the order data flows. May be called more than once."""
        self._deactivate()
        self._cleanup()

    def _deactivate(self) -> None:
        self._unsubscribe()
        if self._worker is not None:
            self._worker.stop()
        self._worker = self._scene = None
        self.recording.close()
        if self._state == "active":
            self._state = "inactive"
            self.get_logger().info("not active any more")

    def _cleanup(self) -> None:
        if self._loader is not None:
            self._loader.close()
        self._loader = self._pipeline = self._in_use = None
        self._state = "unconfigured"

    # Input ----------------------------------------------------------------------------------------

    def _attend(self) -> None:
        """Listens while somebody wants what comes of it, and some seconds longer.

        Called on the executor's thread whenever that may have changed, and once a second in case an event was missed.
        """
        if self._state != "active":
            return
        now = time.monotonic()
        if not self.settings.lazy or self.watched() or self.body_watched():
            self._wanted_at = now
            if self._listening_since is None:
                self._subscribe()
        elif self._listening_since is not None and now > self._wanted_at + _GRACE_S:
            self._unsubscribe()

    def _subscribe(self) -> None:
        self._listening_since = self._wanted_at = time.monotonic()
        if self.settings.follow_humans:
            self._follow_humans()
        else:
            for person in self.settings.persons:
                self._listen(person, f"{person}/smpl_params" if person else "smpl_params")

    def _unsubscribe(self) -> None:
        if self._inputs:
            self.get_logger().info("listening to nobody")
        for subscription in self._inputs.values():
            self.destroy_subscription(subscription)
        self._inputs.clear()
        self._listening_since = None

    def _listen(self, person: str, topic: str) -> None:
        full_name = self.resolve_topic_name(topic)
        self.get_logger().info(f"listening to {full_name} ({self._decoder.message_type})")
        self._inputs[person] = self.create_subscription(
            interface(self._decoder.message_type),
            topic,
            lambda data: self._on_input(person, full_name, data),
            ros_qos(_INPUT_QOS),
            # Overrides are parameters, which never go: only topics that don't come and go have them.
            qos_overriding_options=None if self.settings.follow_humans else _OVERRIDABLE,
            raw=True,
        )

    def _on_input(self, person: str, topic: str, data: bytes) -> None:
        if self._scene is None:
            return
        self.statistics.receive()
        self.recording.put(topic, self._decoder.message_type, data, _INPUT_QOS)
        if not (self.watched() or self.body_watched()):
            self.statistics.skip("unwatched")
            return
        try:
            frames, given = self._decoder.frames(person, data, self.now_ns())
        except (adapters.AdapterError, FrameError) as error:
            self.statistics.drop("invalid", str(error))
            self.get_logger().warning(f"{topic}: {printable(error)}", throttle_duration_sec=_LOG_PERIOD_S)
            return
        self._compare_frames(topic, printable(given))
        if doubt := self._decoder.doubt(frames.values()):
            self.get_logger().warning(f"{topic}: {doubt}")
        for name, frame in frames.items() if not self._decoder.is_steady else ():
            self._scene.put(name, frame)

    def _on_due(self) -> None:
        if self._scene is not None and (self.watched() or self.body_watched()):
            for name, frame in self._decoder.predicted(self.now_ns()).items():
                self._scene.put(name, frame)

    def _compare_frames(self, topic: str, given: str) -> None:
        """Says, once, that the sender's frame isn't the garments', where the sender names one."""
        differs = given not in ("", self.settings.frame_id)
        if differs and not self._input_frame:
            self.get_logger().warning(
                f"{topic} is in the frame {given}, the garments are in {self.settings.frame_id}, and nothing is "
                "transformed: set frame_id to the sender's frame if they are the same place"
            )
        self._input_frame = given if differs else ""

    def _follow_humans(self) -> None:
        """Listens to bodies that have come and no longer to those that have gone (REP-155)."""
        bodies = {
            match[1]: topic for topic, _ in self.get_topic_names_and_types() if (match := _HUMANS.fullmatch(topic))
        }
        for person, topic in bodies.items():
            if person not in self._inputs and self.count_publishers(topic):
                self._listen(person, topic)
        for person in [person for person in self._inputs if not self.count_publishers(bodies.get(person, "/none"))]:
            self.destroy_subscription(self._inputs.pop(person))

    # Output: what the inference thread calls ------------------------------------------------------

    def watched(self) -> bool:
        """Whether anybody listens to `garments` or they are recorded."""
        return self.recording.running or self._garments.get_subscription_count() > 0

    def body_watched(self) -> bool:
        """Whether anybody listens to `body`."""
        return bool(self._body.get_subscription_count() > 0)

    def now_ns(self) -> int:
        """ROS time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def send_garments(self, data: bytes) -> None:
        """Publishes and records."""
        self._garments.publish(data)
        self.recording.put(self._garments.topic_name, adapters.MARKER_ARRAY, data, _OUTPUT_QOS)
        if not self._has_sent:
            self._has_sent = True
            self.get_logger().info("the first garments are out")

    def send_body(self, data: bytes) -> None:
        """Publishes; bodies follow from the recorded inputs."""
        self._body.publish(data)

    def device_lost(self, reason: str) -> None:
        """Goes on on the CPU, or ends, as `on_device_loss` says."""
        self._lost = f"{self.settings.device} has failed ({reason})"
        stops = self.settings.on_device_loss == "stop"
        self.statistics.set_error(f"{self._lost}: {'the node ends' if stops else 'loading for the cpu'}")
        self.get_logger().error(f"{self._lost}: {'the node ends' if stops else 'the cpu takes over'}")
        if stops:
            self.failed = self.finalized = True
        elif self._loader is not None:
            self._loader.request(self._pipeline_key)

    @property
    def _pipeline_key(self) -> PipelineKey:
        """What is to be loaded: for the CPU once the device has failed."""
        key = self.settings.pipeline
        return replace(key, device="cpu") if self._lost else key

    # Parameters -----------------------------------------------------------------------------------

    def _on_parameters(self, parameters: list[Any]) -> SetParametersResult:
        values = {parameter.name: parameter.value for parameter in parameters if parameter.name in specs()}
        if not values:  # rclpy's own, the QoS of a topic for instance
            return SetParametersResult(successful=True)
        try:
            settings = self.settings.changed(values)
            if reload := settings.pipeline != self.settings.pipeline:
                settings.pipeline.check()
            if settings.record != self.settings.record and self._state == "active":
                self.recording.start(settings.record)
        except RefuError as error:
            self.statistics.fault("refused parameters", printable(error))
            return SetParametersResult(successful=False, reason=printable(error))
        if settings.device != self.settings.device:
            self._lost = ""  # the operator knows better
        self.settings = settings
        self._attend()  # a recording may have begun
        if self._pipeline is not None:
            self._decoder.use(settings, self._pipeline.body)
        if self._worker is not None:
            self._worker.settings = settings
        if reload and self._loader is not None:
            self._loader.request(self._pipeline_key)
        return SetParametersResult(successful=True)

    def _take(self, pipeline: GarmentPipeline, key: PipelineKey) -> None:
        self._pipeline, self._in_use = pipeline, key
        self._decoder.use(self.settings, pipeline.body)
        for text in pipeline.warnings:
            self.get_logger().warning(text)

    def _on_loaded(self, pipeline: GarmentPipeline, key: PipelineKey) -> None:
        self._take(pipeline, key)
        if self._worker is not None:
            self._worker.use(pipeline)
        self.statistics.set_error(f"{self._lost}: on the cpu now; set device to try it again" if self._lost else "")
        self.get_logger().info(f"now with {key}")

    def _on_not_loaded(self, error: Exception, key: PipelineKey) -> None:
        text = printable(f"{key} can't be loaded, {self._in_use} stays: {error}")
        self.statistics.set_error(text)
        self.get_logger().error(text)

    def _on_record(self, request: Any, response: Any) -> Any:
        refusal = "" if self._state == "active" else f"the node is {self._state}: activate it first"
        done = self.recording.switch(self.settings.record, on=request.data, refusal=refusal)
        response.success, response.message = done
        self._attend()
        return response

    # Once a second --------------------------------------------------------------------------------

    def _on_second(self) -> None:
        self._attend()
        if self._listening_since is not None and self.settings.follow_humans:
            self._follow_humans()
        self.recording.tell_closed()
        report = self.statistics.report()
        recording, error = self.recording.state()
        if error:
            self.get_logger().error(f"not recording: {error}", throttle_duration_sec=60.0)
        if report.recent["drop.failed"]:
            self.get_logger().error(report.reasons["failed"], throttle_duration_sec=_LOG_PERIOD_S)
        data = adapters.encode_diagnostics(
            statuses(
                report,
                self.settings,
                node=self.get_fully_qualified_name().lstrip("/"),
                state=self._state,
                in_use=self._in_use,
                input_frame=self._input_frame,
                has_foreign_betas=self._decoder.has_foreign_betas,
                persons=() if self._scene is None else self._scene.persons,
                recording=recording,
                recording_error=error,
                listening_for=None if self._listening_since is None else time.monotonic() - self._listening_since,
                n_namesakes=self._count_namesakes(),
            ),
            stamp_ns=self.now_ns(),
        )
        self._diagnostics.publish(data)
        self.recording.put(DIAGNOSTICS_TOPIC, adapters.DIAGNOSTIC_ARRAY, data, _OUTPUT_QOS)

    def _count_namesakes(self) -> int:
        """Other nodes of this name: they answer each other's parameters and services, and mix on their topics."""
        own = (self.get_name(), self.get_namespace())
        count = max(0, list(self.get_node_names_and_namespaces()).count(own) - 1)
        if count:
            self.get_logger().warning(f"{count + 1} nodes are called {own[0]}", throttle_duration_sec=60.0)
        return count
