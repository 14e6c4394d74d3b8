"""The node's input: subscriptions that last while somebody wants the output, and where each message's frame is."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

import msg_adapters as adapters
from msg_adapters.axes import up_of_sender
from msg_adapters.scene import Scene
from refu_core import FrameError, RefuError
from refu_core.errors import printable
from refu_core.keypoints import MOST_PEOPLE
from refu_ros._guard import LOG_PERIOD_S
from refu_ros._interfaces import interface, ros_qos
from refu_ros._settings import NodeSettings

if TYPE_CHECKING:
    from refu_core import SmplBody, SmplFrame
    from refu_core.outputs import PinholeCamera
    from refu_ros._node import GarmentNode

INPUT_QOS = adapters.QosProfile(reliability="best_effort", depth=5)
_HUMANS = re.compile(r"/humans/bodies/([A-Za-z][A-Za-z0-9_]{0,99})/joint_states")
_TRACKED, _CAMERA = "/humans/bodies/tracked", "/camera"
_GRACE_S = 5.0
"""How long the inputs stay subscribed to after the last viewer has left: many viewers are only restarted [s]."""
_TF, _TF_STATIC = "/tf", "/tf_static"
_TF_DEPTH = 100
TURN_S = 0.005
"""How long transforms are taken, or publishers made, before it is another's turn [s]: of a crowd there are many."""
_RETRY_S = 0.02
"""How often it is looked whose wait for a transform is over, when neither inputs nor transforms come [s]."""


class Listener:
    """Subscribes to the inputs and fills the scene, on the executor's thread; `clock` is a steady one."""

    def __init__(self, node: GarmentNode, clock: Any) -> None:
        self._node = node
        self.stream, self.doubts = adapters.InputStream(node.settings.input_type), adapters.Doubts()
        self.room = max(MOST_PEOPLE, len(node.settings.persons))
        """How many people may be here at once."""
        self.scene: Scene | None = None
        """Where the frames of people go; None while nobody is dressed."""
        self.since: float | None = None
        """When the inputs were subscribed to, on the steady clock [s]; None while they aren't."""
        self._wanted_at, self._latest_ns = 0.0, 0
        self._inputs: dict[str, Any] = {}
        self._frames: dict[str, str] = {}
        self._heard: dict[str, float] = {}
        """When somebody's message came last, on the steady clock [s]; of the same people as `_frames`."""
        self._tracked: set[str] | None = None
        self.expected: dict[str, float] = {}
        """Who is here by what others tell (`""`: anybody), and since when, on the steady clock [s]; of humans."""
        self._topics: list[Any] = []
        """All that there were when they could last be named: rclpy can't while a peer has one that isn't UTF-8."""
        self._name_topics = node.guarded("names of topics", node.get_topic_names_and_types, lambda _: self._topics)
        self._tf, self._waiting = adapters.TransformBuffer(), adapters.MessageFilter(node.statistics, most=self.room)
        self._tf_asked_at: float | None = None
        self.is_untransformed = False
        """Whether people are shown as if their frame were that of the messages: there is no tf2_msgs."""
        self._retry = node.create_timer(_RETRY_S, node.guarded("transforms", self._place), clock=clock)
        self._retry.cancel()
        self._turns: dict[str, deque[bytes]] = {}
        """The newest messages of each input that waits; whose turn it is comes first."""
        self._next_turn = node.create_timer(0.0, node.guarded("inputs", self._take_turn), clock=clock)
        self._next_turn.cancel()
        self._camera: adapters.Camera | None = None

    @property
    def _settings(self) -> NodeSettings:
        return self._node.settings

    @property
    def is_steady(self) -> bool:
        """Whether frames come from `predict`, at a rate of their own, and not with the messages."""
        return self.stream.is_of_keypoints and self._settings.keypoint_rate > 0

    def follow(self, body: SmplBody) -> None:
        """Takes over other settings or another body; keypoints are taken to be of somebody with its proportions."""
        settings = self._settings
        betas, smoothing = settings.known_betas, settings.keypoint_smoothing
        self.stream.follow(body, settings.keypoints, betas=betas, smoothing=smoothing)

    @property
    def input_frame(self) -> str:
        """The frame of somebody who sends, where it isn't that of the messages."""
        since = time.monotonic() - max(self._settings.person_timeout, _GRACE_S)
        sent = (frame_id for name, frame_id in self._frames.items() if self._heard[name] > since)
        return next((one for one in sent if one not in ("", self._settings.frame_id)), "")

    @property
    def doubted(self) -> str:
        """Doubts about the people who are here, or about topics with several senders; empty if there are none."""
        here = () if self.scene is None else self.scene.persons
        found = [text for person in here if (text := self.doubts.of_senders.get(person))]
        senders = self._node.guarded("names of topics", self._node.get_publishers_info_by_topic, lambda *_: [])
        for topic in [one.topic_name for name, one in self._inputs.items() if not name.startswith("/")]:
            kinds, kind = [one.topic_type for one in senders(topic)], self.stream.message_type
            others = sorted({*kinds} - {kind})
            found += [f"{topic} is sent as {one}, but input_type wants {kind}: change one of them" for one in others]
            if (n := kinds.count(kind)) > 1:
                found.append(f"{n} publishers on {topic}: who leaps may be two people")
        return "; ".join(found)

    @property
    def persons(self) -> list[str]:
        """Everybody who may come, as far as that is known."""
        named = [*self._bodies()] if self._settings.follow_humans else self._settings.persons
        return [*dict.fromkeys([*named, *(self.scene.persons if self.scene is not None else ())])]

    def attend(self, *, is_wanted: bool) -> None:
        """Listens while somebody wants the output, and some seconds longer.

        Called whenever that may have changed, and once a second in case an event was missed.
        """
        now = time.monotonic()
        if is_wanted or not self._settings.lazy:
            self._wanted_at = now
            if self.since is None:
                self.subscribe()
        elif self.since is not None and now > self._wanted_at + _GRACE_S:
            self.unsubscribe()
        if self.since is not None and self._settings.follow_humans:
            self._follow_humans()

    def subscribe(self) -> None:
        self.since = self._wanted_at = time.monotonic()
        if self._settings.follow_humans:
            self._listen_to_tracked()
            self._follow_humans()
        else:
            for person in self._settings.persons:
                self._listen(person, f"{person}/{adapters.SMPL_TOPIC}" if person else adapters.SMPL_TOPIC)
        if topic := self._settings.camera_info:
            self._hear(_CAMERA, adapters.CAMERA_INFO, topic, self._on_camera, ros_qos(INPUT_QOS))

    def unsubscribe(self) -> None:
        if self._inputs:
            self._node.get_logger().info("listening to nobody")
        for name, subscription in self._inputs.items():
            self._node.destroy_subscription(subscription)
            self.doubts.forget(name)
        self._inputs.clear()
        self._turns.clear()
        self._frames.clear()
        self.expected.clear()
        self.since = self._tracked = self._tf_asked_at = self._camera = None
        self._waiting, self.is_untransformed = adapters.MessageFilter(self._node.statistics, most=self.room), False

    def _listen(self, person: str, topic: str) -> None:
        full_name = self._node.resolve_topic_name(topic)
        # Logs are kept, and overrides are parameters, which are never removed: topics that come and go have neither.
        overrides = None if self._settings.follow_humans else QoSOverridingOptions.with_default_policies()
        if overrides is not None:
            self._node.get_logger().info(f"listening to {full_name} ({self.stream.message_type})")
        take = partial(self._come, person, full_name)
        self._hear(person, self.stream.message_type, topic, take, ros_qos(INPUT_QOS), qos_overriding_options=overrides)

    def _hear(
        self, name: str, kind: str, topic: str, take: Callable[[bytes], object], qos: QoSProfile, **options: Any
    ) -> None:
        """Subscribes; names that aren't a person's begin with a slash. Raises `RefuError`."""

        def come(data: bytes) -> None:
            if name in self._inputs:  # else the executor had taken it before nobody listened
                take(data)

        message_class, where = interface(kind), topic
        try:
            where = self._node.resolve_topic_name(topic)
            self._inputs[name] = self._node.create_subscription(message_class, topic, come, qos, raw=True, **options)
        except Exception as error:  # rclpy's own say nothing of it
            why = f"is it remapped to a topic of another type, or no name of one? ({error})"
            raise RefuError(f"can't subscribe to {where} as {kind}: {why}") from error

    def _come(self, person: str, topic: str, data: bytes) -> None:
        """Records a message and lets it wait for its turn.

        The executor does one after another all that is ready. If each message were worked on as it comes, timers and
        requests would wait behind those of everybody: for seconds, where a crowd's come faster than they are followed.
        """
        node = self._node
        if self.scene is None:
            return
        node.statistics.receive()
        node.recording.put(topic, self.stream.message_type, data, INPUT_QOS)
        self._queue(person, data, most=INPUT_QOS.depth, cause="stale")

    def _queue(self, name: str, data: bytes, *, most: int, cause: str) -> None:
        waiting = self._turns.setdefault(name, deque(maxlen=most))
        if len(waiting) == most:
            self._node.statistics.drop(cause)
        waiting.append(data)
        if self._next_turn.is_canceled():
            self._next_turn.reset()

    def _take_turn(self) -> None:
        """Works on the oldest message of whose turn it is; others of theirs wait until everybody has had a turn."""
        if self._turns:
            name = next(iter(self._turns))
            topic, waiting = self._inputs[name].topic_name, self._turns.pop(name)
            if name in (_TF, _TF_STATIC):
                self._node.guarded(topic, self._on_transforms)(waiting, is_static=name == _TF_STATIC)
            else:
                self._node.guarded(topic, self._on_input)(name, topic, waiting.popleft())
            if waiting and name in self._inputs:
                self._turns[name] = waiting
        if not self._turns:
            self._next_turn.cancel()

    def _on_input(self, person: str, topic: str, data: bytes) -> None:
        node = self._node
        if self.scene is None:
            return
        if not node.is_watched():
            node.statistics.count("skip.unwatched")
            return
        try:
            frames, frame_ids = self.stream.frames(data, node.now_ns(), sender=person)
        except (adapters.AdapterError, FrameError) as error:
            self._refuse(topic, error)
            return
        given = {name: printable(frame_id.lstrip("/")) for name, frame_id in frame_ids.items()}
        axes, target = self._settings.axes, self._settings.frame_id
        # Keypoints' betas are measured on the body that is dressed, and their axes are those of `frame_id`.
        for name, frame in () if self.stream.is_of_keypoints else frames.items():
            up = up_of_sender(axes, target, np.eye(3)) if axes == "smpl" or given[name] in ("", target) else None
            for doubt in self.doubts.of(person, frame, self._settings, up=up):  # None: a transform will tell
                node.get_logger().warning(f"{topic}: {doubt}")
        for frame_id in given.values():
            self._need_transforms(topic, frame_id)
        known = {name: frame_id for name, frame_id in self._frames.items() if name not in given}
        # A tracker's names may never come again: the oldest are forgotten.
        self._frames = dict([*known.items(), *given.items()][-self.room :])
        came = self._heard | dict.fromkeys(given, time.monotonic())
        self._heard = {name: came[name] for name in self._frames}
        if not self.is_steady:
            self._put(frames, topic)

    def _refuse(self, source: str, error: Exception) -> None:
        self._node.statistics.drop("invalid", str(error))
        self._node.get_logger().warning(f"{source}: {printable(error)}", throttle_duration_sec=LOG_PERIOD_S)

    def predict(self) -> None:
        """Puts predicted frames of everybody whose keypoints are followed into the scene."""
        if self.scene is not None and self._node.is_watched():
            # Where ROS time stands still nobody's keypoints grow old, whoever sends them may have gone all the same.
            since, found = time.monotonic() - self._settings.person_timeout, self.stream.predicted(self._node.now_ns())
            here = {name: frame for name, frame in found.items() if self._heard.get(name, since) > since}
            self._put(here, "predicted")

    def _put(self, frames: dict[str, SmplFrame], source: str) -> None:
        for person, frame in frames.items():
            try:
                adapters.check_plausible(frame)
            except FrameError as error:
                self._refuse(source, error)
                continue
            given = "" if self.is_untransformed else self._frames.get(person)
            self._waiting.put(adapters.Held(person, frame, given or self._settings.frame_id, self._node.now_ns()))
        self._place()

    def _now_ns(self) -> int:
        """ROS time [ns]; if it has gone back, transforms are forgotten. A clock that is only corrected costs none."""
        now = self._node.now_ns()
        if now < self._latest_ns - self._settings.tolerance_ns:
            self._tf.rewind()
        self._latest_ns = now
        return now

    def _place(self) -> None:
        """Puts those who wait no longer for their transform into the scene."""
        axes, target, now = self._settings.axes, self._settings.frame_id, self._now_ns()
        for one, placement in self._waiting.ready(self._tf, target, now, self._settings.tolerance_ns):
            seen_in = self._frames.get(one.person) if self.is_untransformed else ""
            up = up_of_sender(axes, seen_in or target, placement.rotation).astype(np.float32)
            frame = one.frame if np.array_equal(one.frame.up, up) else replace(one.frame, up=up)
            assert self.scene is not None
            self.scene.put(one.person, frame, placement, self._camera_at(one.person, frame.stamp_ns), (target, axes))
        if bool(self._waiting) == self._retry.is_canceled():
            self._retry.reset() if self._waiting else self._retry.cancel()

    # Frames ---------------------------------------------------------------------------------------

    def _camera_at(self, person: str, stamp_ns: int) -> PinholeCamera | None:
        """The camera where it was when this person was seen; None if there is none, or no transform of it."""
        settings, camera = self._settings, self._camera
        if camera is None or not self._node.count_publishers(self._inputs[_CAMERA].topic_name):
            return None
        is_theirs = camera.frame_id == self._frames.get(person) and (self.is_untransformed or not camera.frame_id)
        given, tolerance = settings.frame_id if is_theirs else camera.frame_id, settings.tolerance_ns
        try:
            way = self._tf.lookup(given, settings.frame_id, stamp_ns, tolerance_ns=tolerance)
        except adapters.TransformError:
            self._node.statistics.count("skip.camera_without_transform")
            return None
        from refu_core.outputs import PinholeCamera  # loads torch

        return PinholeCamera(camera.width, camera.height, camera.focal, camera.centre, way.rotation, way.translation)

    def _on_camera(self, data: bytes) -> None:
        self._camera = adapters.decode_camera_info(data)
        self._need_transforms("the camera", printable(self._camera.frame_id))

    def _need_transforms(self, who: str, given: str) -> None:
        """Subscribes to transforms once a frame isn't that of the messages."""
        target = self._settings.frame_id
        if given not in ("", target) and self._tf_asked_at is None and not self.is_untransformed:
            try:
                self._listen_to_tf()
            except RefuError as error:
                self.is_untransformed = True
                text = f"{who} is in {given}, the garments are in {target}, nothing is transformed ({error})"
                self._node.get_logger().warning(f"{text}: set frame_id to {given} if they are the same place")

    def _listen_to_tf(self) -> None:
        for topic, durability in ((_TF, DurabilityPolicy.VOLATILE), (_TF_STATIC, DurabilityPolicy.TRANSIENT_LOCAL)):
            take = partial(self._queue, topic, most=_TF_DEPTH, cause="stale_transforms")
            self._hear(topic, adapters.TF_MESSAGE, topic, take, QoSProfile(depth=_TF_DEPTH, durability=durability))
        self._tf, self._tf_asked_at = adapters.TransformBuffer(), time.monotonic()

    def _on_transforms(self, waiting: deque[bytes], *, is_static: bool) -> None:
        refused, last = list[str](), time.monotonic() + TURN_S
        self._now_ns()
        try:
            while waiting and time.monotonic() < last:
                refused += self._tf.put(waiting.popleft(), is_static=is_static)
        finally:
            self._place()
        if refused:
            raise RefuError(f"{len(refused)} transforms left out, the first: {refused[0]}")

    # Humans (REP-155) -----------------------------------------------------------------------------

    def _bodies(self) -> dict[str, str]:
        """The topic of each body that there is: of those announced as tracked, or of all if nothing is announced."""
        self._topics, count = self._name_topics(), self._node.count_publishers
        tells = count(self._node.resolve_topic_name(_TRACKED))
        tracked = self._tracked if tells else None  # who announced people and has gone doesn't know who comes
        found = ((match[1], topic) for topic, _ in self._topics if (match := _HUMANS.fullmatch(topic)))
        bodies = [one for one in found if (tracked is None or one[0] in tracked) and count(one[1])]
        if len(bodies) > self.room:
            self._node.statistics.drop("crowd", f"{len(bodies)} bodies, up to {self.room} are dressed")
            bodies.sort(key=lambda one: one[0] not in self._inputs)
        here = tracked if tracked is not None else [one[0] for one in bodies] or [""] * (not tells)
        self.expected = {one: self.expected.get(one, time.monotonic()) for one in map(printable, [*here][: self.room])}
        return dict(bodies[: self.room])

    def _listen_to_tracked(self) -> None:
        def take(data: bytes) -> None:
            self._tracked = {*adapters.decode_ids(data)}  # followed once a second, however often that is sent

        with suppress(RefuError):  # without this message type, everybody with a topic counts as there
            self._hear(_TRACKED, adapters.IDS_LIST, _TRACKED, take, QoSProfile(depth=1))

    def _follow_humans(self) -> None:
        """Listens to bodies that have come, and no longer to those that have gone."""
        bodies = self._bodies()
        for person in [person for person in self._inputs if not person.startswith("/") and person not in bodies]:
            self._node.destroy_subscription(self._inputs.pop(person))
            self._turns.pop(person, None)
            self.doubts.forget(person)
        for person, topic in bodies.items():
            if person not in self._inputs:
                self._listen(person, topic)
