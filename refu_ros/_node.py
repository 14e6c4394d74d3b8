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
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

import msg_adapters as adapters
from refu_core import FrameError, RefuError
from refu_ros._diagnostics import statuses
from refu_ros._interfaces import interface
from refu_ros._loader import PipelineLoader
from refu_ros._parameters import declare_settings
from refu_ros._recorder import Recorder
from refu_ros._scene import Scene, check_plausible
from refu_ros._statistics import Statistics, printable
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


class GarmentNode(LifecycleNode):  # type: ignore[misc]
    """Garments of everybody in the scene. `close` it before it is destroyed.

    Raises `RefuError` for parameters that have no meaning.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(NODE_NAME, **options)
        self.finalized = False
        self.failed = False
        """Whether it ended because its device did."""
        self.settings = declare_settings(self)
        self._statistics = Statistics()
        self._state = "unconfigured"
        self._scene: Scene | None = None
        self._worker: Worker | None = None
        self._loader: PipelineLoader | None = None
        self._pipeline: GarmentPipeline | None = None
        self._recorder: Recorder | None = None
        self._recording_error = ""
        self._closing: list[Recorder] = []
        self._lost = ""
        self._inputs: dict[str, Any] = {}
        self._listening_since: float | None = None
        self._wanted_at = 0.0
        self._garments: Any = None
        self._body: Any = None
        self._decoder = adapters.decoder_for(self.settings.layout)
        self._input_type = adapters.INPUT_TYPES[self.settings.layout]
        self._diagnostics = self.create_publisher(interface(adapters.DIAGNOSTIC_ARRAY), DIAGNOSTICS_TOPIC, 10)
        self.create_service(interface("std_srvs/srv/SetBool"), "~/record", self._on_record)
        self.add_on_set_parameters_callback(self._on_parameters)
        # Steady time: a simulation that stands still must not stop the diagnostics.
        self.create_timer(1.0, self._on_second, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # Lifecycle ------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Loads the garments and offers the topics."""
        try:
            self._pipeline = self.settings.pipeline.load()
            marker_array = interface(adapters.MARKER_ARRAY)
            self._garments, self._body = (
                self.create_lifecycle_publisher(
                    marker_array,
                    topic,
                    _ros_qos(_OUTPUT_QOS),
                    qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                    event_callbacks=PublisherEventCallbacks(matched=lambda _: self._attend()),
                )
                for topic in ("garments", "body")
            )
            interface(self._input_type)
        except Exception as error:  # rclpy would swallow it
            self.get_logger().error(f"can't be configured: {error}")
            return TransitionCallbackReturn.FAILURE
        self._loader = PipelineLoader(self._on_loaded, self._on_not_loaded)
        self._state = "inactive"
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Dresses who sends, as soon as somebody wants that."""
        result = super().on_activate(state)
        assert self._pipeline is not None
        if self.settings.record and not self._recording:
            try:
                self._start_recording(self.settings.record)
            except RefuError as error:  # no reason to leave people undressed
                self._recording_error = printable(error)
        self._scene = Scene(self._statistics)
        self._worker = Worker(self._scene, self._statistics, self, settings=self.settings, pipeline=self._pipeline)
        self._worker.start()
        try:
            self._subscribe()  # in any case: what is wrong with the inputs has to show at the start
        except Exception as error:  # rclpy would swallow it
            self.get_logger().error(f"can't be activated: {error}")
            self.on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        self._state = "active"
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clears the scene, ends a recording, and waits for both."""
        self._deactivate()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Takes the topics back."""
        self._cleanup()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Everything that is queued gets into the file before this returns."""
        self.close()
        self._state = "finalized"
        self.finalized = True
        return super().on_shutdown(state)

    def close(self) -> None:
        """Ends threads and files in the order data flows. May be called more than once."""
        self._deactivate()
        self._cleanup()

    def _deactivate(self) -> None:
        self._unsubscribe()
        if self._worker is not None:
            self._worker.stop()
        self._worker = self._scene = None
        self._stop_recording()
        for recorder in self._closing:
            recorder.close()
        self._closing.clear()
        if self._state == "active":
            self._state = "inactive"

    def _cleanup(self) -> None:
        if self._loader is not None:
            self._loader.close()
        self._loader = self._pipeline = None
        for publisher in filter(None, (self._garments, self._body)):
            self.destroy_lifecycle_publisher(publisher)
        self._garments = self._body = None
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
        for subscription in self._inputs.values():
            self.destroy_subscription(subscription)
        self._inputs.clear()
        self._listening_since = None

    def _listen(self, person: str, topic: str) -> None:
        full_name = self.resolve_topic_name(topic)
        self._inputs[person] = self.create_subscription(
            interface(self._input_type),
            topic,
            lambda data: self._on_input(person, full_name, data),
            _ros_qos(_INPUT_QOS),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            raw=True,
        )

    def _on_input(self, person: str, topic: str, data: bytes) -> None:
        if self._scene is None:
            return
        self._statistics.receive()
        self._record(topic, self._input_type, data, _INPUT_QOS)
        if not (self.watched() or self.body_watched()):
            self._statistics.skip("unwatched")
            return
        try:
            frame = self._decoder.from_bytes(data)
            if frame.stamp_ns == 0:  # the message has no header, or an empty one: when it came is the best there is
                frame = replace(frame, stamp_ns=self.now_ns())
            check_plausible(frame)
        except (adapters.AdapterError, FrameError) as error:
            self._statistics.drop("invalid", str(error))
            self.get_logger().warning(f"{topic}: {printable(error)}", throttle_duration_sec=_LOG_PERIOD_S)
            return
        self._scene.put(person, frame)

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
        return self._recording or self._garments.get_subscription_count() > 0

    def body_watched(self) -> bool:
        """Whether anybody listens to `body`."""
        return bool(self._body.get_subscription_count() > 0)

    def now_ns(self) -> int:
        """ROS time [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def send_garments(self, data: bytes) -> None:
        """Publishes and records."""
        self._garments.publish(data)
        self._record(self._garments.topic_name, adapters.MARKER_ARRAY, data, _OUTPUT_QOS)

    def send_body(self, data: bytes) -> None:
        """Publishes; bodies follow from the recorded inputs."""
        self._body.publish(data)

    def device_lost(self, reason: str) -> None:
        """Goes on on the CPU, or ends, as `on_device_loss` says."""
        self._lost = f"{self.settings.device} has failed ({reason})"
        stops = self.settings.on_device_loss == "stop"
        self._statistics.set_error(f"{self._lost}: {'the node ends' if stops else 'loading for the cpu'}")
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
        try:
            settings = self.settings.changed({parameter.name: parameter.value for parameter in parameters})
            if settings.record != self.settings.record and self._state == "active":
                self._stop_recording()
                if settings.record:
                    self._start_recording(settings.record)
        except RefuError as error:
            return SetParametersResult(successful=False, reason=str(error))
        reload = settings.pipeline != self.settings.pipeline
        if settings.device != self.settings.device:
            self._lost = ""  # the operator knows better
        self.settings = settings
        self._attend()  # a recording may have begun
        if self._worker is not None:
            self._worker.settings = settings
        if reload and self._loader is not None:
            self._loader.request(self._pipeline_key)
        return SetParametersResult(successful=True)

    def _on_loaded(self, pipeline: GarmentPipeline, key: PipelineKey) -> None:
        self._pipeline = pipeline
        if self._worker is not None:
            self._worker.use(pipeline)
        self._statistics.set_error(f"{self._lost}: on the cpu now; set device to try it again" if self._lost else "")
        self.get_logger().info(f"now with {', '.join(key.garments)} ({key.backbone}, {key.sdf}, {key.device})")

    def _on_not_loaded(self, error: Exception, key: PipelineKey) -> None:
        text = f"{', '.join(key.garments)} ({key.backbone}, {key.sdf}, {key.device}) can't be loaded: {error}"
        self._statistics.set_error(text)
        self.get_logger().error(text)

    # Recording ------------------------------------------------------------------------------------

    @property
    def _recording(self) -> bool:
        return self._recorder is not None and self._recorder.running

    def _start_recording(self, path: str) -> None:
        self._recorder = Recorder(path)
        self._recording_error = ""
        self.get_logger().info(f"recording to {self._recorder.path}")

    def _stop_recording(self) -> None:
        self._recording_error = ""
        if self._recorder is not None:
            self._recorder.stop()
            self._closing.append(self._recorder)
            self._recorder = None

    def _record(self, topic: str, message_type: str, data: bytes, qos: adapters.QosProfile) -> None:
        recorder = self._recorder
        if recorder is not None:
            recorder.put(topic, message_type, data, time_ns=time.time_ns(), qos=qos)

    def _on_record(self, request: Any, response: Any) -> Any:
        response.success, response.message = self._switch_recording(on=request.data)
        return response

    def _switch_recording(self, *, on: bool) -> tuple[bool, str]:
        if not on:
            recorder = self._recorder
            self._stop_recording()
            return (False, "nothing is recorded") if recorder is None else (True, f"{recorder.path} is being closed")
        if self._state != "active":
            return False, f"the node is {self._state}: activate it first"
        if self._recording and self._recorder is not None:
            return False, f"already recording to {self._recorder.path}"
        if not self.settings.record:
            return False, "no directory: set the parameter record to one, which also starts the recording"
        try:
            self._stop_recording()
            self._start_recording(self.settings.record)
        except RefuError as error:
            return False, str(error)
        assert self._recorder is not None
        self._attend()
        return True, f"recording to {self._recorder.path}"

    # Once a second --------------------------------------------------------------------------------

    def _on_second(self) -> None:
        self._attend()
        if self._listening_since is not None and self.settings.follow_humans:
            self._follow_humans()
        self._closing = [recorder for recorder in self._closing if not recorder.finished]
        report = self._statistics.report()
        recording = None if self._recorder is None else self._recorder.state()
        error = recording.error if recording is not None else self._recording_error
        if error:
            self.get_logger().error(f"not recording: {error}", throttle_duration_sec=60.0)
        if report.recent["drop.failed"]:
            self.get_logger().error(report.reasons["failed"], throttle_duration_sec=_LOG_PERIOD_S)
        data = adapters.encode_diagnostics(
            statuses(
                report,
                self.settings,
                node=self.get_name(),
                state=self._state,
                persons=() if self._scene is None else self._scene.persons,
                recording=recording,
                recording_error=error,
                listening_for=None if self._listening_since is None else time.monotonic() - self._listening_since,
                device="cpu" if self._lost else "",
                n_namesakes=self._count_namesakes(),
            ),
            stamp_ns=self.now_ns(),
        )
        self._diagnostics.publish(data)
        self._record(DIAGNOSTICS_TOPIC, adapters.DIAGNOSTIC_ARRAY, data, _OUTPUT_QOS)

    def _count_namesakes(self) -> int:
        """Other nodes of this name: they answer each other's parameters and services, and mix on their topics."""
        own = (self.get_name(), self.get_namespace())
        count = max(0, list(self.get_node_names_and_namespaces()).count(own) - 1)
        if count:
            self.get_logger().warning(f"{count + 1} nodes are called {own[0]}", throttle_duration_sec=60.0)
        return count


def _ros_qos(profile: adapters.QosProfile) -> QoSProfile:
    reliability = ReliabilityPolicy.RELIABLE if profile.reliability == "reliable" else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=profile.depth, reliability=reliability)
