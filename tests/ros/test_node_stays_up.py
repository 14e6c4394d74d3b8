"""What ends a node that isn't told to end: nothing that a peer asks, says, or does."""

from __future__ import annotations

import random
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

rclpy = pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from harness import CHEAP, GARMENTS, NodeProcess, Peer, frame  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from rclpy.event_handler import PublisherEventCallbacks  # noqa: E402
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

import refu_core  # noqa: E402
from msg_adapters import BagReader  # noqa: E402
from refu_ros._guard import GuardedNode  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
CYCLE = (
    Transition.TRANSITION_DEACTIVATE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_ACTIVATE,
)


@pytest.fixture(scope="module")
def scene(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Peer, NodeProcess]]:  # noqa: ARG001
    """A node, of simulated time, that has to be there at the end; and its peer."""
    with NodeProcess(tmp_path_factory.mktemp("node") / "log.txt", **CHEAP, use_sim_time=True) as node:
        peer = Peer()
        peer.wait_for_node()
        yield peer, node
        peer.dress(frame(12345))
        assert node.process.poll() is None, node.log
        assert "Traceback" not in node.log
        peer.close()


def change(peer: Peer, number: int, label: str = "") -> bool:
    request = ChangeState.Request(transition=Transition(id=number, label=label))
    return bool(peer.call(ChangeState, "garment_node/change_state", request).success)


def count(peer: Peer, what: str) -> int:
    return peer.count("node", f"faults: {what}")


def test_it_is_brought_up_and_torn_down_while_viewers_come_and_go(scene: tuple[Peer, NodeProcess]) -> None:
    """A viewer's coming and going is queued while its publisher is taken down: rclpy raised InvalidHandle."""
    peer, _ = scene
    draw, viewers = random.Random(0), []
    for i in range(15):
        for transition in CYCLE:
            if viewers and draw.random() < 0.5:
                peer.node.destroy_subscription(viewers.pop())
            else:
                viewers.append(peer.node.create_subscription(MarkerArray, "garments", lambda _: None, 5, raw=True))
            assert change(peer, transition), (i, transition)
    for viewer in viewers:
        peer.node.destroy_subscription(viewer)


def test_who_has_gone_is_not_waited_for(ros: None) -> None:  # noqa: ARG001
    """With a MultiThreadedExecutor one thread takes a publisher down and another begins to wait: its spin ended."""
    node = GuardedNode("guarded")
    told = PublisherEventCallbacks(matched=lambda _: None)
    publisher = node.create_publisher(MarkerArray, "garments", 1, event_callbacks=told)
    waitable = next(one for one in publisher.event_handlers if one.event_type.name == "RCL_PUBLISHER_MATCHED")
    with node.context.handle:
        wait_set = _rclpy.WaitSet(0, 0, 0, 0, 0, 1, node.context.handle)
    waitable.add_to_wait_set(wait_set)
    node.destroy_publisher(publisher)
    wait_set.clear_entities()
    waitable.add_to_wait_set(wait_set)
    assert not waitable.is_ready(wait_set)
    node.destroy_node()


def test_requests_that_are_not_valid_now_are_answered_in_the_negative(scene: tuple[Peer, NodeProcess]) -> None:
    peer, _ = scene
    for number in (Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CLEANUP, 0, 8, 10, 77, 255):
        assert not change(peer, number)
    assert not change(peer, 0, "nonsense")
    unknown = ParameterValue(type=77)
    request = SetParameters.Request(parameters=[Parameter(name="margin", value=unknown)] * 3)
    answer = peer.call(SetParameters, "garment_node/set_parameters", request)
    assert [result.successful for result in answer.results] == [False] * 3
    assert "77" in answer.results[0].reason
    many = GetParameters.Request(names=["margin"] * 20_000)
    assert not peer.call(GetParameters, "garment_node/get_parameters", many).values
    peer.spin_until(lambda: count(peer, "change_state") >= 7, "the requests are counted")
    peer.spin_until(lambda: count(peer, "set_parameters") and count(peer, "get_parameters"), "these, too")


def test_no_clock_ends_it(scene: tuple[Peer, NodeProcess]) -> None:
    peer, node = scene
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    peer.spin_until(lambda: clock.get_subscription_count(), "the clock is listened to")

    def strikes(seconds: int, nanoseconds: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = seconds, nanoseconds
        clock.publish(message)

    for time in (
        (2**31 - 1, 2**32 - 1),
        (-1, 0),
        (-(2**31), 0),
        (2**31 - 1, 0),
        (5, 2**32 - 1),
        (0, 0),
    ):
        strikes(*time)
        peer.forget_reports()
        peer.spin_until(lambda: peer.diagnostics, f"it lives at {time[0]} s")

    def counted() -> bool:  # clocks are best effort, too
        strikes(-1, 0)
        return count(peer, "/clock") >= 2

    peer.spin_until(counted, "clocks without sense are counted")
    assert "wanted a stamp that fits a ROS time" in node.log


def test_a_refused_recording_leaves_the_running_one_alone(scene: tuple[Peer, NodeProcess], tmp_path: Path) -> None:
    peer, _ = scene
    (result,) = peer.set(record=str(tmp_path / "bag"))
    assert result.successful, result.reason
    for value in ("/", "~nosuchuser/x", "/proc/nope", "x" * 300, "log.txt/bag"):
        (result,) = peer.set(record=value)
        assert not result.successful, value
        assert result.reason
    peer.dress(frame(1))
    kept = peer.call(GetParameters, "garment_node/get_parameters", GetParameters.Request(names=["record"]))
    assert kept.values[0].string_value == str(tmp_path / "bag")
    (result,) = peer.set(record="")
    assert result.successful
    peer.spin_until(lambda: (tmp_path / "bag" / "metadata.yaml").exists(), "the bag is closed")
    with BagReader(tmp_path / "bag") as bag:
        assert "/garments" in {message.topic for message in bag.messages()}


def test_what_is_asked_for_again_is_done_again(scene: tuple[Peer, NodeProcess], tmp_path: Path) -> None:
    """Values that the parameters have already: a recording that was ended otherwise, weights that couldn't be read."""
    peer, _ = scene
    folder = str(tmp_path / "bag")
    for name in ("bag", "bag-1"):
        assert peer.set(record=folder)[0].successful
        peer.spin_until(lambda name=name: peer.status("recording")[2].get("path") == str(tmp_path / name), "recorded")
        assert peer.call(SetBool, "garment_node/record", SetBool.Request(data=False)).success
    assert peer.set(record="")[0].successful

    shipped = Path(refu_core.__file__).parent / "weights" / GARMENTS[0]
    shutil.copytree(shipped, tmp_path / GARMENTS[0])
    file = tmp_path / GARMENTS[0] / "tailornet-none.safetensors"
    file.write_bytes(b"")
    assert peer.set(weights=str(tmp_path))[0].successful
    assert peer.set(backbone="tailornet")[0].successful
    peer.spin_until(lambda: "an empty file" in peer.status("garments")[1], "the weights can't be read")
    shutil.copy(shipped / file.name, file)
    assert peer.set(backbone="tailornet")[0].successful
    peer.spin_until(lambda: peer.status("garments")[2].get("backbone") == "tailornet", "now they can")
    for name, value in (("backbone", "skinned"), ("weights", "")):
        assert peer.set(**{name: value})[0].successful


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"device": "tpu"}, "cpu or cuda"),
        ({"body": "nobody"}, "no body .nobody."),
        ({"betas_from": "/nonexistent.npz"}, "no body"),
        ({"backbone": "gcnn"}, "no weights of gcnn"),
        ({"weights": "/nonexistent", "backbone": "tailornet"}, "no weights"),
        ({"frame_id": "/map"}, "leading slash"),
        ({"frame_id": "my frame"}, "spaces"),
        ({"max_rate": 1e-300}, "max_rate"),
        ({"betas": None}, "write all as decimals"),
        ({"style": "[0, 0.5, 0, 0]"}, "write all as decimals"),  # as `ros2 param set` sends it
        ({"garments": None}, "wanted a list of strings, got None: no value, or an empty list"),
    ],
    ids=lambda value: str(value),
)
def test_what_cannot_be_used_is_refused(values: dict[str, Any], reason: str) -> None:
    """Whether by the settings, or by what they need."""
    from refu_core import RefuError
    from refu_ros._settings import NodeSettings

    with pytest.raises(RefuError, match=reason):
        NodeSettings().changed(values).check_files()
