"""`smpl_publisher`: what it plays, and the process itself with a raw subscriber on the other side."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import msg_adapters as adapters
from refu_core import RefuError, SmplFrame, load_body

rclpy = pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros)")

from harness import PATIENCE_S, isolate  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.exceptions import ParameterException  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402

from msg_adapters import load_motion  # noqa: E402
from msg_adapters.motion import march  # noqa: E402
from refu_ros._interfaces import interface  # noqa: E402
from refu_ros._settings import declare  # noqa: E402
from refu_ros.smpl_publisher import PublisherOptions, SmplPublisher  # noqa: E402
from tests.ros.ready import Forked, run_program  # noqa: E402

# rclpy's parser of message definitions uses a module that Python 3.11 deprecates.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")

BAGS = Path(__file__).parents[2] / "bags"


class Listener:
    """A node that keeps the raw messages of some topics."""

    def __init__(self, context: Context, input_type: str, topics: tuple[str, ...]) -> None:
        self.node = Node("listener", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.received: dict[str, list[bytes]] = {topic: [] for topic in topics}
        for topic, messages in self.received.items():
            self.node.create_subscription(
                interface(adapters.INPUT_TYPES[input_type]), topic, messages.append, QoSProfile(depth=100), raw=True
            )

    def collect(self, count: int) -> None:
        """Until each topic has so many messages."""
        self.until(lambda: min(map(len, self.received.values())) >= count)

    def until(self, condition: Callable[[], bool]) -> None:
        """Fails where it doesn't come true."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, {topic: len(messages) for topic, messages in self.received.items()}
            self.executor.spin_once(timeout_sec=0.1)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()


@pytest.fixture(scope="module")
def context() -> Iterator[Context]:
    isolate()
    context = Context()
    rclpy.init(context=context)
    yield context
    rclpy.try_shutdown(context=context)


def ros_arguments(parameters: dict[str, Any]) -> list[str]:
    return ["--ros-args", *(word for name, value in parameters.items() for word in ("-p", f"{name}:={value}"))]


def start(log: Path, **parameters: Any) -> Forked:
    return run_program("smpl_publisher", ros_arguments(parameters), log=log)


@pytest.mark.parametrize(
    ("input_type", "bag", "stop"),
    [
        ("joint_state", "walk", signal.SIGINT),
        ("multiarray", "reach_squat", signal.SIGTERM),
        ("pose_array", "walk", signal.SIGINT),
    ],
)
def test_plays_a_bag(context: Context, tmp_path: Path, input_type: str, bag: str, stop: signal.Signals) -> None:
    """The bag's frames in order, in another type, stamped anew; then a clean end."""
    listener, before = Listener(context, input_type, ("smpl_params",)), time.time_ns()
    log = tmp_path / "log.txt"
    process = start(log, motion=BAGS / bag, input_type=input_type, frame_id="camera")
    try:
        listener.collect(20)
    finally:
        process.send_signal(stop)
        status = process.wait(PATIENCE_S)
        listener.close()
    assert status == 0, log.read_text()
    assert "Traceback" not in log.read_text()
    recorded = load_motion(str(BAGS / bag))
    frames = [adapters.decoder_for(input_type).from_bytes(data) for data in listener.received["smpl_params"]]
    indices = [int(np.abs(recorded.poses - frame.pose).max(axis=(1, 2)).argmin()) for frame in frames]
    # A topic's queue holds one: a listener that gets no turn in time misses some.
    assert all(0 < step < len(recorded) // 2 for step in np.diff(indices) % len(recorded)), indices
    for index, frame in zip(indices, frames, strict=True):
        np.testing.assert_allclose(frame.pose, recorded.poses[index], atol=1e-5)
        np.testing.assert_allclose(frame.transl, recorded.transl[index], atol=1e-6)
        if input_type != "pose_array":  # carries no betas
            np.testing.assert_allclose(frame.betas, recorded.betas, atol=1e-6)
    if input_type != "multiarray":  # has no header
        stamps = [frame.stamp_ns for frame in frames]
        assert stamps == sorted(set(stamps))
        assert before < stamps[0] < stamps[-1] < time.time_ns()


def test_a_motion_may_be_at_home(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(BAGS.parent))
    node = SmplPublisher(context=context, cli_args=ros_arguments({"motion": "~/bags/walk"}))
    assert len(node.motion) == len(load_motion(str(BAGS / "walk")))
    node.destroy_node()


@pytest.mark.parametrize("is_simulated", [False, True])
def test_who_waits_for_a_clock_says_so(
    context: Context, capfd: pytest.CaptureFixture[str], *, is_simulated: bool
) -> None:
    """Without a /clock it sent nothing for ever, and said nothing of it."""
    given = ros_arguments({"use_sim_time": str(is_simulated).lower()})
    SmplPublisher(context=context, cli_args=given).destroy_node()
    assert ("as soon as /clock runs" in capfd.readouterr().err) == is_simulated


def test_persons_stand_apart_and_move_apart(context: Context, tmp_path: Path) -> None:
    listener = Listener(context, "joint_state", ("ann/smpl_params", "bob/smpl_params"))
    log, decode = tmp_path / "log.txt", adapters.decoder_for("joint_state").from_bytes

    def sent() -> list[dict[int, SmplFrame]]:
        return [{f.stamp_ns: f for f in map(decode, messages)} for messages in listener.received.values()]

    process = start(log, input_type="joint_state", persons="[ann, bob]", spacing=1.5, rate=60)
    try:
        listener.until(lambda: len(set.intersection(*map(set, sent()))) >= 5)
    finally:
        process.send_signal(signal.SIGINT)
        status = process.wait(PATIENCE_S)
        listener.close()
    assert status == 0, log.read_text()
    ann, bob = sent()
    for stamp in ann.keys() & bob.keys():
        np.testing.assert_allclose(bob[stamp].transl - ann[stamp].transl, [1.5, 0, 0], atol=1e-6)
        assert np.abs(bob[stamp].pose - ann[stamp].pose).max() > 0.01


def test_no_frame_is_left_out_and_the_end_is_the_beginning_again(context: Context) -> None:
    node = publisher(context, motion=BAGS / "walk", input_type="joint_state")
    sent: list[bytes] = []
    node._outputs = [SimpleNamespace(publish=sent.append)]  # type: ignore[list-item]
    recorded = load_motion(str(BAGS / "walk"))
    for _ in range(len(recorded) + 5):
        node._tick()
    node.destroy_node()
    for i, data in enumerate(sent):
        frame = adapters.decoder_for("joint_state").from_bytes(data)
        np.testing.assert_allclose(frame.pose, recorded.poses[i % len(recorded)], atol=1e-5)
    assert len(sent) == len(recorded) + 5


def test_ends_with_the_motion(context: Context) -> None:
    listener = Listener(context, "joint_state", ("smpl_params",))
    node = publisher(context, loop=False, rate=240, input_type="joint_state")
    listener.executor.add_node(node)
    while not node.finished:
        listener.executor.spin_once(timeout_sec=1.0)
    decode, received = adapters.decoder_for("joint_state").from_bytes, listener.received["smpl_params"]
    listener.until(lambda: bool(received) and np.allclose(decode(received[-1]).pose, march().poses[-1], atol=1e-5))
    node.destroy_node()
    listener.close()
    assert 1 <= len(received) <= len(march().resampled(240.0))


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"motion": "nowhere"}, "nowhere: can't be read: No such file"),
        ({"input_type": "pointcloud"}, "wanted an input type, got 'pointcloud'"),
        ({"rate": -1}, "rate"),
        ({"rate": "fast"}, "rate: wanted a number, got 'fast'"),
        ({"spacing": ".nan"}, "spacing"),
        ({"persons": "[ann, a b]"}, "persons: wanted distinct names"),
        ({"persons": "[ann, é]"}, "persons: wanted distinct names"),
        ({"persons": "[ann, ann]"}, "persons: wanted distinct names"),
        ({"loop": 1}, "loop"),
        ({"frame_id": "/map"}, "frame_id: wanted a name as tf2 has them"),  # which nobody could transform
        ({"input_axes": "left"}, "input_axes: wanted smpl or frame, got 'left'"),
    ],
    ids=lambda value: str(value),
)
def test_refuses(context: Context, parameters: dict[str, Any], words: str) -> None:
    with pytest.raises((RefuError, ParameterException), match=re.escape(words)):
        publisher(context, **parameters)


def test_a_parameter_that_there_is_not_is_warned_of(context: Context) -> None:
    given = [
        Parameter(name, value=1.0) for name in ("rat", "qos_overrides./smpl_params.publisher.depth", "use_sim_tine")
    ]
    node, said = Node("probe", context=context, parameter_overrides=given), []
    node.get_logger = lambda: SimpleNamespace(warning=said.append)  # type: ignore[assignment, method-assign, return-value]
    declare(node, PublisherOptions)
    node.destroy_node()
    assert said == ["there is no parameter rat: is rate meant?", "there is no parameter use_sim_tine"]


def test_bad_parameters_are_one_line(tmp_path: Path) -> None:
    assert start(tmp_path / "log.txt", motion="nowhere").wait(PATIENCE_S) == 2
    (line,) = (tmp_path / "log.txt").read_text().splitlines()
    assert line.startswith("smpl_publisher: error: nowhere: can't be read: No such file or directory; wanted")


def test_an_unknown_ros_argument_is_one_line(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    assert run_program("smpl_publisher", ["--ros-args", "--nonsense"], log=log).wait(PATIENCE_S) == 2
    assert log.read_text() == "smpl_publisher: error: no such arguments after --ros-args: ['--nonsense']\n"


def test_without_standard_streams_it_runs_as_with_them() -> None:
    """As daemons are started: the executor refused to begin, and to say so failed."""
    isolate()
    given = ros_arguments({"loop": False, "rate": 240})
    command = [sys.executable, "-m", "refu_ros.smpl_publisher", *given]
    closed = ["sh", "-c", 'exec "$@" >&- 2>&-', "sh", *command]
    assert subprocess.run(closed, cwd=BAGS.parent, check=False, timeout=PATIENCE_S).returncode == 0


def publisher(context: Context, **parameters: Any) -> SmplPublisher:
    return SmplPublisher(context=context, cli_args=ros_arguments(parameters))


def test_in_place_holds_the_ground_and_not_the_height() -> None:
    walk = load_motion(str(BAGS / "walk"))
    held = walk.in_place(up=1)
    np.testing.assert_array_equal(held.transl[:, 1], walk.transl[:, 1])
    np.testing.assert_array_equal(held.transl[:, [0, 2]], np.tile(walk.transl[0, [0, 2]], (len(walk), 1)))
    np.testing.assert_array_equal(held.poses, walk.poses)


def test_march_loops_and_stands_on_the_floor() -> None:
    motion = march()
    steps = np.abs(np.diff(motion.poses, axis=0, append=motion.poses[:1])).max(axis=(1, 2))
    assert steps[-1] <= steps.max() * 1.01  # the seam is a step like any other
    assert steps.max() < 0.2
    soles = load_body("male")(motion.poses, transl=motion.transl).vertices[..., 1].min(dim=1).values.numpy()
    assert np.abs(soles).max() < 0.01


def test_npz_is_read_and_bags_keep_their_rate(tmp_path: Path) -> None:
    np.savez(tmp_path / "clip.npz", poses=np.zeros((5, 72)), trans=np.ones((5, 3)), mocap_framerate=25.0)
    assert (len(load_motion(str(tmp_path / "clip.npz"))), load_motion(str(tmp_path / "clip.npz")).fps) == (5, 25.0)
    walk = load_motion(str(BAGS / "walk"))
    assert len(walk) == 300
    assert walk.fps == pytest.approx(30, abs=1e-6)


def test_a_bag_without_a_body_is_refused(tmp_path: Path) -> None:
    with adapters.BagWriter(tmp_path / "bad.mcap") as bag:
        bag.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        bag.write("/smpl_params", b"\x00\x01\x00\x00nonsense", log_time_ns=1)
    with pytest.raises(adapters.BagError, match="no frame of its SMPL topic can be decoded"):
        load_motion(str(tmp_path / "bad.mcap"))
