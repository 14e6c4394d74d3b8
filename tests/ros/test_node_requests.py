"""Requests with types of our own, over Fast DDS: a frame, a recording, a bag, and peers who mean harm."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from harness import GARMENTS, PATIENCE_S, ROOT, NodeProcess, Peer, frame, ros_arguments
from rclpy.action import ActionClient
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header

import msg_adapters as adapters
from msg_adapters import BagReader, BagWriter
from msg_adapters.axes import SMPL_COLUMNS
from refu_core import GarmentPipeline, RefuError, SmplFrame
from refu_ros._beside import BagJob, RequestDresser
from refu_ros._node import GarmentNode
from refu_ros._requests import _fill
from refu_ros._settings import NodeSettings

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
WALK = ROOT / "bags" / "walk"
N_WALK = 8
"""Frames of the bag that is dressed here."""


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short bag, and with what a peer mustn't reach by it."""
    home: Path = tmp_path_factory.mktemp("node")
    folder = home / "bags"
    folder.mkdir()
    with BagReader(WALK) as walk:
        messages = [message for message in walk.messages() if message.topic == "/smpl_params"][:N_WALK]
    one, two = ["/smpl_params"], ["/ann/smpl_params", "/bob/smpl_params"]
    for path, topics in ((folder / "walk.mcap", one), (folder / "two.mcap", two), (home / "secret.mcap", one)):
        with BagWriter(path) as bag:
            for topic in topics:
                bag.add_topic(topic, messages[0].message_type)
            for topic, message in product(topics, messages):
                bag.write(topic, message.data, log_time_ns=message.log_time_ns)
    (folder / "out.mcap").symlink_to(home / "secret.mcap")
    (folder / "noise.mcap").write_bytes(os.urandom(1000))
    return folder


@pytest.fixture(scope="module")
def node(ros: None, messages: Path, bags: Path) -> Iterator[NodeProcess]:  # noqa: ARG001
    log = bags.parent / "log.txt"
    with NodeProcess(log, packages=messages, input_type="joint_state", backbone="skinned", bags=bags) as node:
        yield node
        assert node.process.poll() is None, node.log
        assert "Traceback" not in node.log


@pytest.fixture(scope="module")
def peer(node: NodeProcess) -> Iterator[Peer]:  # noqa: ARG001
    peer = Peer()
    yield peer
    peer.close()


def ask(peer: Peer, **given: Any) -> Any:
    """A frame's answer."""
    from refu_msgs.srv import Dress

    return peer.call(Dress, "garment_node/dress", Dress.Request(**given))


class Replayer:
    """An action client."""

    def __init__(self, peer: Peer) -> None:
        from refu_msgs.action import ReplayBag

        self._peer, self._type = peer, ReplayBag
        self._client = ActionClient(peer.node, ReplayBag, "garment_node/replay_bag")
        peer.spin_until(self._client.server_is_ready, "the action is offered")
        self.feedback: list[tuple[int, int]] = []

    def begin(self, **goal: Any) -> Any:
        """The goal's handle."""
        told = lambda message: self.feedback.append(  # noqa: E731
            (message.feedback.frames_done, message.feedback.frames_total)
        )
        return self._done(self._client.send_goal_async(self._type.Goal(**goal), feedback_callback=told))

    def begin_and_cancel(self, **goal: Any) -> Any:
        """The handle of a goal that is cancelled, with all others, before the node has said that it accepts it."""
        cancel = self._peer.node.create_client(CancelGoal, "garment_node/replay_bag/_action/cancel_goal")
        self._peer.spin_until(cancel.service_is_ready, "goals can be cancelled")
        begun, asked = self._client.send_goal_async(self._type.Goal(**goal)), cancel.call_async(CancelGoal.Request())
        handle = self._done(begun)
        if not self._done(asked).goals_canceling:  # the request has overtaken the goal
            self.cancel(handle)
        return handle

    def result(self, handle: Any) -> tuple[int, Any]:
        """Status and result."""
        answer = self._done(handle.get_result_async())
        return answer.status, answer.result

    def cancel(self, handle: Any) -> None:
        """Asks for it."""
        assert self._done(handle.cancel_goal_async()).goals_canceling

    def _done(self, future: Any) -> Any:
        self._peer.spin_until(future.done, "the action answers")
        return future.result()


def test_a_frame_is_dressed_as_by_the_library(peer: Peer) -> None:
    given = frame(3, transl=(1.0, 2.0, 3.0))
    betas = [0.5, -1.0]
    header = Header(frame_id="camera")
    header.stamp.sec = 7
    pose = given.pose.ravel()
    answer = ask(
        peer, header=header, pose=pose, betas=betas, transl=given.transl, garments=GARMENTS[:1], sdf="accurate"
    )
    assert answer.success, answer.message
    assert (answer.message, answer.header) == ("", header)
    pipeline = GarmentPipeline.load(GARMENTS[:1], sdf="accurate", backbone="skinned")
    wanted = pipeline(SmplFrame(pose=given.pose, betas=np.pad(betas, (0, 8)), transl=given.transl))
    (garment,) = answer.garments
    mesh = wanted[GARMENTS[0]]
    assert garment.name == GARMENTS[0]
    points = np.array([(point.x, point.y, point.z) for point in garment.mesh.vertices])
    np.testing.assert_allclose(points, mesh.vertices[:, SMPL_COLUMNS["smpl"]], atol=1e-6)
    np.testing.assert_array_equal([corner.vertex_indices for corner in garment.mesh.triangles], mesh.faces)
    stats = wanted.stats.garments[GARMENTS[0]]
    assert (garment.n_inside, garment.n_unresolved) == (stats.n_inside, stats.n_unresolved)
    assert answer.largest_shift == pytest.approx(wanted.stats.shift.largest, abs=1e-6)
    assert answer.within_promise


def test_cloth_hangs_down_in_the_frame_of_the_request(ros: None, messages: Path) -> None:  # noqa: ARG001
    """A camera's, for somebody who stands upright in it, whichever frame the topics are in."""
    from refu_msgs.srv import Dress

    pose = np.zeros((24, 3))
    pose[0] = Rotation.from_euler("x", 180, degrees=True).as_rotvec()
    request = Dress.Request(header=Header(frame_id="camera_optical_frame"), pose=pose.ravel(), transl=[0.0, 0.2, 3.0])
    skirt = {"garments": ["skirt-female"], "sdf": "none", "collider": False, "input_axes": "frame"}
    node = GarmentNode(cli_args=ros_arguments(skirt), namespace="robot")
    try:
        answer = node._requests._on_dress(request, Dress.Response()).result(PATIENCE_S)
        request.header.frame_id = "my frame"
        with pytest.raises(RefuError, match="frame_id: wanted a name"):
            node._requests._on_dress(request, Dress.Response())
    finally:
        node.close()
        node.destroy_node()
    got = np.array([(point.x, point.y, point.z) for point in answer.garments[0].mesh.vertices])
    pipeline = GarmentPipeline.load(["skirt-female"], sdf="none", collider=False)
    sent = SmplFrame(pose, transl=np.array([0.0, 0.2, 3.0]))
    hangs, of_map = (
        pipeline(replace(sent, up=np.array(up)))["skirt-female"].vertices for up in ((0, -1, 0), (0, 0, 1))
    )
    np.testing.assert_allclose(got, hangs, atol=1e-6)
    assert np.abs(hangs - of_map).max() > 0.01


def test_requests_leave_the_stream_as_it_is(peer: Peer) -> None:
    peer.wait_for_node()
    before = peer.dress(frame(1)).points
    assert ask(peer, pose=frame(9).pose.ravel(), betas=[2.0] * 10).success
    after = peer.dress(frame(1, stamp_ns=5 * 10**9)).points
    np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"pose": [np.nan] * 72}, "NaN"),
        ({"pose": [1e30] * 72}, "pose"),
        ({"betas": [0.0] * 11}, "betas"),
        ({"betas": [np.inf]}, "betas"),
        ({"transl": [0.0, np.nan, 0.0]}, "transl"),
        ({"style": [1.0]}, "style"),
        ({"header": Header(stamp={})}, "stamp"),
        ({"garments": ["cape"]}, "cape"),
        ({"garments": ["/etc/passwd.npz"]}, "garments"),
        ({"garments": ["../garment_tshirt-male.npz"]}, "garments"),
        ({"garments": ["tshirt-male"] * 2}, "distinct"),
        ({"garments": ["tshirt-male"] * 17}, "garments"),
        ({"garments": ["tshirt-male", "skirt-female"]}, "one body"),
        ({"sdf": "best"}, "sdf"),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value,
)
def test_nonsense_gets_an_answer(peer: Peer, given: dict[str, Any], said: str) -> None:
    if "header" in given:
        given = {"header": Header()}
        given["header"].stamp.sec = -1
    answer = ask(peer, **given)
    assert not answer.success
    assert said in answer.message
    assert "\n" not in answer.message
    assert not answer.garments


OUTSIDE = ("../secret", "/tmp/bag", "a/../../secret", ".hidden", "--help", "a//b", "a\x1b[2J", "x" * 200)


@pytest.mark.parametrize("path", OUTSIDE)
def test_a_recording_stays_in_its_folder(peer: Peer, bags: Path, path: str) -> None:
    from refu_msgs.srv import Record

    before = sorted(bags.parent.rglob("*"))
    answer = peer.call(Record, "garment_node/record_bag", Record.Request(start=True, path=path))
    assert (answer.success, answer.path) == (False, "")
    assert "below the parameter bags" in answer.message
    assert sorted(bags.parent.rglob("*")) == before


def test_a_recording_says_where_it_is(peer: Peer, bags: Path) -> None:
    from refu_msgs.srv import Record

    def record(path: str = "", *, start: bool = True) -> Any:
        return peer.call(Record, "garment_node/record_bag", Record.Request(start=start, path=path))

    assert "set the parameter record" in record().message
    for wanted in ("day", "day-1"):
        begun = record("day")
        assert begun.success, begun.message
        assert begun.path == str(bags / wanted)
        assert "already" in record("day").message
        peer.dress(frame(1 if wanted == "day" else 2))
        ended = record(start=False)
        assert (ended.success, ended.path) == (True, begun.path)
    assert not record(start=False).success


def test_requests_that_wait_when_the_node_ends_are_told_so() -> None:
    dresser, settings = RequestDresser(), NodeSettings(garments=GARMENTS[:1], backbone="skinned", sdf="none")
    waiting = [dresser.ask(frame(i), settings, lambda *_: None) for i in range(3)]
    dresser.close()
    with pytest.raises(RefuError, match="shut down or failed before"):
        waiting[-1].result()
    again = dresser.ask(frame(1), settings, lambda output, _: output)
    assert GARMENTS[0] in again.result()
    dresser.close()


def test_a_bag_is_dressed_beside_the_stream(peer: Peer, bags: Path) -> None:
    replayer = Replayer(peer)
    handle = replayer.begin(bag="two.mcap", topic="/bob/smpl_params", garments=GARMENTS[:1])
    peer.dress(frame(4))  # meanwhile
    status, result = replayer.result(handle)
    assert (status, result.success) == (GoalStatus.STATUS_SUCCEEDED, True), result.message
    assert result.output == str(bags / "two-dressed.mcap")
    assert (result.frames, list(result.garments)) == (N_WALK, [GARMENTS[0]])
    assert 0 <= result.vfcp_percent[0] <= 100
    assert 0 <= result.cfmp_percent[0] <= 100
    assert replayer.feedback[0] == (0, N_WALK)
    # The last word of it may still be on its way when the result has come.
    peer.spin_until(lambda: replayer.feedback[-1] == (N_WALK, N_WALK), "all of it is told")
    with BagReader(bags / "two-dressed.mcap") as bag:
        assert sum(message.topic == "/garments" for message in bag.messages()) == N_WALK


def test_a_bag_is_read_in_the_axes_of_the_node(bags: Path, tmp_path: Path) -> None:
    garments: dict[str, np.ndarray[Any, Any]] = {}
    jobs = {}
    for axes in ("smpl", "frame"):
        settings = NodeSettings(garments=GARMENTS[:1], backbone="skinned", sdf="none", input_axes=axes)
        jobs[axes] = BagJob(bags / "walk.mcap", tmp_path / f"{axes}.mcap", settings, lambda *_: None)
    for axes, job in jobs.items():
        job.done.result()
        with BagReader(tmp_path / f"{axes}.mcap") as bag:
            first = next(message for message in bag.messages(["/garments"]))
        garments[axes] = adapters.decode_marker_array(first.data)[0].points
    np.testing.assert_allclose(garments["smpl"], garments["frame"][:, SMPL_COLUMNS["smpl"]], atol=1e-5)


def test_a_bag_gives_way_to_a_node_that_gives_way_itself(bags: Path, tmp_path: Path) -> None:
    def begin() -> BagJob:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)
        settings = NodeSettings(garments=GARMENTS[:1], backbone="skinned", sdf="none")
        return BagJob(bags / "walk.mcap", tmp_path / "out.mcap", settings, lambda *_: None)

    with ThreadPoolExecutor(1) as node:
        job = node.submit(begin).result()
    assert os.getpriority(os.PRIO_PROCESS, job._process.pid) == 15
    assert job.done.result()["frames"] == N_WALK


def test_one_bag_at_a_time_and_it_can_be_cancelled(peer: Peer, bags: Path) -> None:
    long = bags / "endless.mcap"
    with BagReader(bags / "walk.mcap") as walk:
        (message, *_) = walk.messages()
    with BagWriter(long) as bag:
        bag.add_topic("/smpl_params", message.message_type)
        for i in range(20_000):
            bag.write("/smpl_params", message.data, log_time_ns=i)
    replayer = Replayer(peer)
    first = replayer.begin(bag="endless.mcap", garments=GARMENTS[:1], sdf="none")
    status, result = replayer.result(replayer.begin(bag="walk.mcap"))
    assert status == GoalStatus.STATUS_ABORTED
    assert "another bag" in result.message
    peer.spin_until(lambda: any(done for done, _ in replayer.feedback), "it has begun")
    replayer.cancel(first)
    status, result = replayer.result(first)
    assert status == GoalStatus.STATUS_CANCELED
    assert not result.success
    assert "cancelled" in result.message
    assert 0 < result.frames < 20_000
    with BagReader(result.output) as bag:
        assert not bag.truncated
    status, result = replayer.result(replayer.begin_and_cancel(bag="endless.mcap", garments=GARMENTS[:1], sdf="none"))
    assert (status, result.output) == (GoalStatus.STATUS_CANCELED, "")
    assert "before a frame was done" in result.message


def test_a_bag_that_is_cancelled_before_its_first_frame_has_no_figures() -> None:
    result = SimpleNamespace(garments=[], vfcp_percent=[], cfmp_percent=[])
    garments = {GARMENTS[0]: {"vfcp_percent": None, "cfmp_percent": None}}
    _fill(result, {"frames": 0, "garments": garments, "interrupted": True, "warnings": []}, "a.mcap")
    assert np.isnan([*result.vfcp_percent, *result.cfmp_percent]).all()
    assert not result.success
    assert "cancelled" in result.message


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        ({"bag": "none.mcap"}, "no bag"),
        ({"bag": ""}, "below the parameter bags"),
        ({"bag": "../secret.mcap"}, "below the parameter bags"),
        ({"bag": "out.mcap"}, "below the parameter bags"),
        ({"bag": "walk.mcap", "garments": ["x.npz"]}, "garments"),
        ({"bag": "walk.mcap", "sdf": "--help"}, "sdf"),
        ({"bag": "noise.mcap"}, "noise.mcap"),
        ({"bag": "two.mcap"}, "/ann/smpl_params (std_msgs/msg/Float32MultiArray), /bob/smpl_params"),
        ({"bag": "two.mcap", "topic": "/eve"}, "no topic /eve"),
        ({"bag": "two.mcap", "topic": "/eve\n--overwrite"}, "control characters"),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value,
)
def test_a_bad_goal_gets_an_answer(peer: Peer, goal: dict[str, Any], said: str) -> None:
    replayer = Replayer(peer)
    status, result = replayer.result(replayer.begin(**goal))
    assert (status, result.success, result.output) == (GoalStatus.STATUS_ABORTED, False, "")
    assert said in result.message
    assert "\n" not in result.message
