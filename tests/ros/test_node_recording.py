"""What is in the bag after the node was ended, in every way that processes end."""

from __future__ import annotations

import resource
import signal
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from harness import CHEAP, NodeProcess, Peer, frame
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from std_srvs.srv import SetBool

from msg_adapters import BagReader, decode_marker_array, decoder_for

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
N_FRAMES = 25


@pytest.fixture
def peer(ros: None) -> Iterator[Peer]:  # noqa: ARG001
    peer = Peer()
    yield peer
    peer.close()


def play(peer: Peer) -> set[int]:
    """Sends frames and returns the stamps of the garments that came back: a third of them at least."""
    peer.wait_for_node()
    for i in range(N_FRAMES):
        if i % 3:
            peer.send(frame(i))
            peer.spin(1 / 30)
        else:  # also by a node that is slower than the frames
            peer.dress(frame(i))
    return stamps_of(peer)


def stamps_of(peer: Peer) -> set[int]:
    return {markers[0].stamp_ns for markers in peer.garments if markers[0].action == 0}


def recorded(path: Path) -> tuple[set[int], set[int], bool]:
    """Stamps of inputs and of garments in a bag, and whether it was cut short."""
    decode = decoder_for("joint_state")
    inputs, garments = set(), set()
    with BagReader(path) as bag:
        for message in bag.messages():
            if message.topic.endswith("/smpl_params"):
                inputs.add(decode.from_bytes(message.data).stamp_ns)
            elif message.topic.endswith("/garments"):
                garments |= {marker.stamp_ns for marker in decode_marker_array(message.data) if marker.action == 0}
        return inputs, garments, bag.truncated


@pytest.mark.parametrize(
    "signals",
    [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGHUP,), (signal.SIGINT, signal.SIGINT)],
    ids=["SIGINT", "SIGTERM", "SIGHUP", "double SIGINT"],
)
def test_signals_lose_nothing(peer: Peer, tmp_path: Path, signals: tuple[signal.Signals, ...]) -> None:
    bag = tmp_path / "bag"
    with NodeProcess(tmp_path / "log.txt", **CHEAP, record=bag) as node:
        published = play(peer)
        assert node.stop(*signals) == 0, node.log
        assert "Traceback" not in node.log
    inputs, garments, truncated = recorded(bag)
    assert not truncated
    assert (bag / "metadata.yaml").is_file()
    assert len(published) > N_FRAMES // 3
    assert published <= garments <= inputs


def test_topics_are_recorded_under_the_names_that_they_are_remapped_to(peer: Peer, tmp_path: Path) -> None:
    bag, remaps = tmp_path / "bag", ("/diagnostics:=/robot/health",)
    with NodeProcess(tmp_path / "log.txt", **CHEAP, record=bag, remaps=remaps) as node:
        play(peer)
        assert node.stop(signal.SIGINT) == 0, node.log
    with BagReader(bag) as reader:
        topics = {message.topic for message in reader.messages()}
    assert "/robot/health" in topics
    assert "/diagnostics" not in topics


def test_a_lifecycle_shutdown_loses_nothing(peer: Peer, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with NodeProcess(tmp_path / "log.txt", **CHEAP, record=bag) as node:
        published = play(peer)
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVE_SHUTDOWN))
        assert peer.call(ChangeState, "garment_node/change_state", request).success
        assert node.ends() == 0, node.log
    inputs, garments, truncated = recorded(bag)
    assert not truncated
    assert published <= garments <= inputs


def test_a_kill_leaves_all_but_the_last_chunk(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    # The others don't miss who is killed for twenty seconds: it is in a namespace where nobody else asks for it.
    bag, namespace = tmp_path / "bag", "killed"
    with (
        closing(Peer(namespace=namespace)) as peer,
        NodeProcess(tmp_path / "log.txt", namespace=namespace, **CHEAP, record=bag) as node,
    ):
        published = play(peer)
        peer.forget_reports()
        peer.spin_until(lambda: peer.status("recording")[2].get("queued") == "0", "all is written")
        node.stop(signal.SIGKILL)
    assert not (bag / "metadata.yaml").exists()
    inputs, garments, truncated = recorded(bag / "bag_0.mcap")
    assert truncated
    assert len(published - garments) <= 1  # a message of garments is a chunk of its own
    assert len(garments - inputs) == 0


def test_the_service_starts_and_stops(peer: Peer, tmp_path: Path) -> None:
    with NodeProcess(tmp_path / "log.txt", **CHEAP, autostart=False) as node:
        call = lambda on: peer.call(SetBool, "garment_node/record", SetBool.Request(data=on))  # noqa: E731
        assert "unconfigured" in call(True).message
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            request = ChangeState.Request(transition=Transition(id=transition))
            assert peer.call(ChangeState, "garment_node/change_state", request).success
        assert "set the parameter record" in call(True).message
        peer.wait_for_node()
        (result,) = peer.set(record=str(tmp_path / "bag"))
        assert result.successful, result.reason
        first = frame(1)
        peer.dress(first)
        assert not call(True).success  # it records already
        assert call(False).success
        assert not call(False).success
        peer.dress(frame(2))
        peer.dress(frame(3))  # which is sent until it comes back: some may still be on its way when the next bag begins
        assert call(True).success
        peer.dress(frame(4))
        assert node.stop(signal.SIGINT) == 0, node.log
    assert recorded(tmp_path / "bag")[1] == {first.stamp_ns}
    assert {frame(4).stamp_ns} <= recorded(tmp_path / "bag-1")[1] <= {frame(3).stamp_ns, frame(4).stamp_ns}


def test_a_full_disk_stops_the_recording_and_not_the_node(peer: Peer, tmp_path: Path) -> None:
    limit = 3_000_000
    bag = tmp_path / "bag"
    with NodeProcess(tmp_path / "log.txt", **CHEAP, record=bag) as node:
        resource.prlimit(node.process.pid, resource.RLIMIT_FSIZE, (limit, limit))  # a small disk
        peer.wait_for_node()

        def failed() -> bool:
            peer.send(frame(len(peer.garments)))
            return peer.status("recording")[0] == 2

        peer.spin_until(failed, "the full disk is an error")
        assert "can't be written" in peer.status("recording")[1]
        peer.dress(frame(10_000))
        assert node.stop(signal.SIGINT) == 0, node.log
    assert recorded(bag / "bag_0.mcap")[1]
