"""Inputs are subscribed to while somebody wants the output: who comes, who goes, and who does both at once."""

from __future__ import annotations

import gc
import math
import threading
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from harness import CHEAP, GARMENTS, ROOT, NodeHere, NodeProcess, Peer, frame
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray

from msg_adapters import BagReader
from refu_ros._program import make_executor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


class Stage(NodeHere):
    """A node in this process, which forgets at once who has gone, and a peer."""

    def __init__(self, make_executor: Callable[[], Any], **parameters: Any) -> None:
        super().__init__(executor=make_executor(), **(CHEAP | parameters))

    def heard(self) -> int:
        """How many subscriptions the sender has."""
        return int(self.peer.listeners())

    def rests(self) -> None:
        """Until the input isn't subscribed to."""
        self.until(lambda: self.heard() == 0, "the node rests")

    def dresses(self, i: int = 0) -> None:
        """Until the frame comes back as a garment."""

        def came() -> bool:
            self.peer.send(frame(i))
            return self.peer.seen(frame(i).stamp_ns) is not None

        self.peer.garments.clear()
        self.until(came, "the frame is dressed")

    def reports(self, times: int = 2) -> tuple[int, str, dict[str, str]]:
        """The input's status after so many more words of the node."""
        self.peer.forget_reports()
        self.until(lambda: len(self.peer.diagnostics) >= times, "the node says how it is")
        return self.peer.status("input")


@pytest.fixture
def stage(ros: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Stage]]:  # noqa: ARG001
    """Makes stages."""
    monkeypatch.setattr("refu_ros._listener._GRACE_S", 0.0)
    monkeypatch.setattr("refu_ros._node._BEAT_S", 0.2)
    made: list[Stage] = []

    def make(make_executor: Callable[[], Any] = make_executor, **parameters: Any) -> Stage:
        gc.collect()  # nodes of other tests that nothing holds
        made.append(one := Stage(make_executor, **parameters))
        one.until(lambda: not one.node._count_namesakes(), "programs of the tests before are gone")
        return one

    yield make
    for one in made:
        one.close()


@pytest.mark.parametrize("make_executor", [make_executor, SingleThreadedExecutor], ids=["events", "single"])
def test_viewers_come_and_go_and_leave_nothing_behind(
    stage: Callable[..., Stage], make_executor: Callable[[], Any]
) -> None:
    """With the executor of the program, and with the one it has where rclpy is older."""
    scene = stage(make_executor)

    def held() -> tuple[int, int, int]:
        return len(list(scene.node.subscriptions)), len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    for i in range(25):
        scene.rests()
        if i == 5:  # everything that is made once has been made
            before = held()
        scene.peer.watch()
        if i % 3 == 2:  # gone before the node has seen it
            scene.peer.unwatch()
            continue
        scene.dresses(i)
        scene.peer.unwatch()
        if i % 3 == 1:  # and back before the node has seen it go
            scene.peer.watch()
            scene.dresses(i + 1000)
            scene.peer.unwatch()
    scene.rests()
    # What the middleware holds for a moment is none of it; what each viewer leaves behind would be a dozen by now.
    scene.until(
        lambda: all(now <= then for now, then in zip(held(), before, strict=True)), f"nothing is left: {before}"
    )
    scene.peer.watch()
    scene.dresses(2000)


@pytest.mark.parametrize("missing", ["event", "timer"])
def test_an_event_or_the_second_is_enough(
    stage: Callable[..., Stage], monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    if missing == "event":
        monkeypatch.setattr("refu_ros._bank.PublisherEventCallbacks", lambda **_: PublisherEventCallbacks())
    scene = stage()
    scene.rests()
    if missing == "timer":
        for timer in scene.node.timers:
            timer.cancel()
    scene.peer.watch()
    scene.dresses()
    scene.peer.unwatch()
    scene.rests()


def test_rest_is_reported_and_is_no_fault(stage: Callable[..., Stage], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("refu_ros._diagnostics._FIRST_INPUT_S", math.inf)  # nobody can have sent yet
    scene = stage(person_timeout=0.05)
    scene.peer.watch()
    scene.dresses()
    scene.peer.unwatch()
    scene.rests()
    received = int(scene.reports()[2]["received"])
    for i in range(30):
        scene.peer.send(frame(i))
    level, message, values = scene.reports(3)
    assert (level, values["subscribed"], values["received"]) == (0, "no", str(received))
    assert "nobody listens" in message
    assert scene.peer.status("garments")[:2] == (0, "nobody listens")
    scene.peer.watch()
    assert scene.reports(2)[0] == 0
    monkeypatch.setattr("refu_ros._diagnostics._FIRST_INPUT_S", 0.5)
    scene.until(lambda: scene.peer.status("input")[0] == 1, "who doesn't send though somebody listens is missed")
    assert scene.peer.status("input")[2]["subscribed"] == "yes"


def test_a_message_that_the_executor_has_taken_before_nobody_listened_is_left_out(stage: Callable[..., Stage]) -> None:
    """It waited for a turn that never came: the node tried again and again, as fast as it could."""
    scene = stage()
    scene.peer.watch()
    scene.dresses()
    take = scene.node._listener._inputs[""].callback
    scene.peer.unwatch()
    scene.rests()
    take(b"")
    assert not scene.node._listener._turns


def test_bodies_alone_are_a_reason_to_listen(stage: Callable[..., Stage]) -> None:
    scene = stage()
    scene.rests()
    bodies: list[bytes] = []
    subscription = scene.peer.node.create_subscription(MarkerArray, "body", bodies.append, 10, raw=True)

    def came() -> bool:
        scene.peer.send(frame(1))
        return bool(bodies)

    scene.until(came, "a body comes")
    scene.peer.node.destroy_subscription(subscription)
    scene.rests()


def test_so_are_recordings(stage: Callable[..., Stage], tmp_path: Path) -> None:
    """By the parameter, and by the service."""
    scene = stage()
    scene.rests()
    client = scene.peer.node.create_client(SetBool, "garment_node/record")

    def switch(on: bool) -> None:
        future = client.call_async(SetBool.Request(data=on))
        scene.until(future.done, "the service answers")
        assert future.result().success, future.result().message

    def dressed() -> int:
        return scene.node.statistics.report().total["ticks"]

    def recorded(since: int) -> bool:
        scene.peer.send(frame(1))
        return dressed() > since and int(scene.peer.status("recording")[2].get("messages", 0)) > 3

    def is_closed() -> bool:
        return all(one.finished for one in scene.node.recording._closing)

    scene.until(client.service_is_ready, "the service is there")
    (result,) = scene.node.set_parameters([Parameter("record", value=str(tmp_path / "bag"))])
    assert result.successful, result.reason
    for bag in ("bag", "bag-1"):
        scene.peer.forget_reports()
        scene.until(lambda: scene.heard() == 1, "the input is recorded")
        scene.until(partial(recorded, dressed()), "messages are recorded")
        switch(False)
        scene.rests()
        scene.until(lambda: scene.reports(1) and is_closed(), "the bag is closed")
        with BagReader(tmp_path / bag) as reader:
            assert {"/smpl_params", "/garments"} <= {message.topic for message in reader.messages()}
        if bag == "bag":
            switch(True)


def test_the_parameter_is_heeded_while_something_else_is_recorded(stage: Callable[..., Stage], tmp_path: Path) -> None:
    """It had that value already, so it was taken and nothing was done."""
    scene = stage(record=str(tmp_path / "a"))
    scene.node.record(on=False)
    scene.node.record(on=True, path=str(tmp_path / "b"))
    for _ in range(2):  # the second time it is what is recorded
        assert scene.node.set_parameters([Parameter("record", value=str(tmp_path / "a"))])[0].successful
        state, _ = scene.node.recording.state()
        assert state.path == tmp_path / "a-1"


def test_who_needs_the_input_watched_switches_it_off(
    stage: Callable[..., Stage], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refu_ros._diagnostics._FIRST_INPUT_S", 0.5)
    scene = stage(lazy=False)
    scene.until(lambda: scene.heard() == 1, "the node listens")
    scene.reports(3)
    assert scene.heard() == 1
    scene.until(lambda: scene.peer.status("input")[:2] == (1, "no input yet"), "a silent sender is missed")


def test_the_lifecycle_goes_round(stage: Callable[..., Stage]) -> None:
    """Whether somebody listens or not: an inactive node doesn't."""
    scene = stage()
    scene.rests()
    scene.node.trigger_deactivate()
    scene.peer.watch()
    scene.reports()
    assert scene.heard() == 0
    scene.node.trigger_activate()
    scene.dresses(1)
    scene.node.trigger_deactivate()
    scene.rests()
    scene.node.trigger_cleanup()
    scene.reports()
    scene.node.trigger_configure()
    scene.node.trigger_activate()
    scene.dresses(2)


def test_humans_are_found_when_they_are_wanted(stage: Callable[..., Stage]) -> None:
    scene = stage(follow_humans=True)
    ann = Peer("ann", topic="/humans/bodies/{}/joint_states")
    ann.unwatch()
    scene.reports()
    assert ann.listeners() == 0
    scene.peer.watch()

    def came() -> bool:
        ann.send(frame(1), "ann")
        return scene.peer.seen(frame(1).stamp_ns, f"ann/{GARMENTS[0]}") is not None

    scene.until(came, "ann is dressed")
    scene.peer.unwatch()
    scene.until(lambda: ann.listeners() == 0, "nobody looks at ann")
    ann.close()


def test_people_of_whom_others_tell_are_missed(stage: Callable[..., Stage], monkeypatch: pytest.MonkeyPatch) -> None:
    """REP-155: whoever sent a body died, and the diagnostics said "0.0 Hz", level OK, for ever."""
    monkeypatch.setattr("refu_ros._diagnostics._FIRST_INPUT_S", 0.5)
    scene = stage(follow_humans=True, person_timeout=0.3)
    ann = Peer("ann", topic="/humans/bodies/{}/joint_states")
    scene.peer.watch()

    def came() -> bool:
        ann.send(frame(1), "ann")
        return scene.peer.status("input")[0] == 0 and scene.peer.shown() == {f"ann/{GARMENTS[0]}"}

    scene.until(came, "ann is dressed, and nobody is missed")
    scene.until(lambda: scene.peer.status("input")[:2] == (1, "no input from ann"), "ann has a topic, and is silent")
    ann.fall_silent("ann")
    scene.until(lambda: scene.peer.status("input")[1].startswith("no input for"), "who sent her has gone")
    assert scene.peer.status("input")[0] == 1
    ann.close()


def test_overridden_qualities_hold_each_time(stage: Callable[..., Stage]) -> None:
    scene = stage(**{"qos_overrides./smpl_params.subscription.reliability": "reliable"})
    there = partial(scene.peer.node.get_subscriptions_info_by_topic, "/smpl_params")
    scene.rests()
    for _ in range(2):
        scene.peer.watch()
        scene.dresses()
        scene.until(lambda: len(there()) == 1, "those before are gone")
        assert there()[0].qos_profile.reliability == ReliabilityPolicy.RELIABLE
        scene.peer.unwatch()
        scene.rests()


def test_the_guide_names_the_qualities_that_can_be_overridden() -> None:
    text = (ROOT / "docs" / "guide" / "ros.md").read_text(encoding="utf-8")
    said = text.partition("QoS overrides change")[2].partition(".")[0]
    policies = {kind.name.lower() for kind in QoSPolicyKind}
    overridable = {kind.name.lower() for kind in QoSOverridingOptions.with_default_policies().policy_kinds}
    assert {word.strip(",") for word in said.split()} & policies == overridable


def test_the_program_rests_after_some_seconds(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    soon = "from refu_ros import _listener; _listener._GRACE_S = 0.3"
    with NodeProcess(tmp_path / "log.txt", first=soon, **CHEAP) as node:
        peer = Peer()
        peer.wait_for_node()
        peer.dress(frame(1))
        peer.unwatch()
        peer.spin_until(lambda: peer.status("input")[2].get("subscribed") == "no", "the node rests")
        peer.spin_until(lambda: peer.listeners() == 0, "it has unsubscribed")
        peer.watch()
        peer.dress(frame(2))
        peer.close()
        assert node.process.poll() is None, node.log
        assert "Traceback" not in node.log
