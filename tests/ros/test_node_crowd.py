"""Names that peers choose: they come and go for days, in crowds, and as long as a name can be."""

from __future__ import annotations

import ctypes
import gc
import shutil
import threading
import time
from collections import deque
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

import rclpy
from harness import CHEAP, NodeHere, NodeProcess, Peer
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rmw_dds_common.msg import NodeEntitiesInfo, ParticipantEntitiesInfo
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

import refu_core
from msg_adapters import MARKER_ARRAY, TransformError
from msg_adapters.markers import encode_lists
from msg_adapters.scene import Scene
from msg_adapters.transforms import Transform, encode_transforms
from refu_core import RefuError, load_body
from refu_core.keypoints import MOST_PEOPLE, Proportions, Skeleton, keypoint_layout
from refu_core.keypoints._pose import Pose, exp_so3
from refu_ros._listener import INPUT_QOS
from refu_ros._listener import Listener as NodeListener
from refu_ros._node import GarmentNode
from refu_ros._program import make_executor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
BODY = "/humans/bodies/{}/joint_states"
LONGEST = "x" * 219
"""The longest id whose topic is one; its garments' would be none."""


@pytest.fixture
def node(ros: None) -> Iterator[Any]:  # noqa: ARG001
    values = {"input_type": "keypoint_markers", "keypoints": "coco17", "garments": CHEAP["garments"]}
    node = GarmentNode(parameter_overrides=[Parameter(name, value=value) for name, value in values.items()])
    yield node
    node.close()
    node.destroy_node()


def test_nothing_is_kept_of_topics_that_have_gone(node: Any) -> None:
    """rclpy kept a reference to each: three kilobytes of each person who came and went."""
    before = len(node.default_callback_group.entities)
    for i in range(20):
        node._bank.hold({f"person_{i}/{name}": MARKER_ARRAY for name in ("points", "contacts")})
        node.destroy_subscription(node.create_subscription(MarkerArray, f"person_{i}", lambda _: None, 1))
    node._bank.hold({})
    gc.collect()
    assert len(node.default_callback_group.entities) == before


def test_a_topic_with_too_long_a_name_is_left_out_alone(node: Any) -> None:
    node._bank.hold({f"{LONGEST}/openings/tshirt_male/left_sleeve": MARKER_ARRAY, "bob/points": MARKER_ARRAY})
    assert node._bank.name("bob/points") == "/bob/points"
    report = node.statistics.report()
    assert report.group("fault") == {"topics": 1}
    assert "should not exceed" in report.reasons["fault"]


def test_who_has_left_a_tracker_is_forgotten(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bones, turns = Skeleton(keypoint_layout("coco17"), Proportions.builtin("male")), np.zeros((24, 3))
    turns[0, 0], turns[16, 2], turns[17, 2] = np.pi, -1.0, 1.0
    points = bones.posed(Pose(np.array([0.0, 0, 3]), exp_so3(turns), np.zeros(10))).points
    listener = node._listener
    listener.follow(load_body("male"))
    listener.scene = Scene(node.statistics)
    monkeypatch.setattr(node, "is_watched", lambda: True)
    for i in range(MOST_PEOPLE + 10):
        seen = [(f"p{i}", 10**9 + i, [0, 0, 0, 0, 0, 0, 1], points)]
        data = encode_lists(7, seen, frame_id="camera", color=(1, 1, 1, 1), size=0.01)
        listener._on_input("", "/smpl_params", data)
    assert len(listener._frames) == MOST_PEOPLE
    assert listener._frames[f"p{MOST_PEOPLE + 9}"] == "camera"  # who came first is forgotten
    assert "p9" not in listener._frames


def test_what_is_loaded_while_nothing_spins_is_taken_over_later(node: Any) -> None:
    """A device that fails before the first spin; and, at the end, loading was said to have failed."""

    def load() -> None:
        node._loader.request(wanted)
        node._loader._pool.submit(bool).result()  # once that has been loaded

    node.trigger_configure()
    wanted = replace(node._pipeline_key, sdf="none")
    load()
    assert not node.statistics.report().last_error
    node._look_after()
    assert node._in_use == wanted
    load()
    node.trigger_cleanup()
    node._look_after()
    assert node._fittings is None


def test_what_is_asked_for_again_before_it_is_taken_back_is_tried_again(node: Any, tmp_path: Path) -> None:
    """A request that was repeated between the failure and the next look was forgotten."""
    shipped, file = Path(refu_core.__file__).parent / "weights" / "tshirt-male", "tailornet-hybrid.safetensors"
    shutil.copytree(shipped, tmp_path / shipped.name)
    (tmp_path / shipped.name / file).write_bytes(b"")
    node.trigger_configure()
    do, gate = node._loader._pool.submit, threading.Event()
    again = [Parameter("weights", value=str(tmp_path))]
    assert node.set_parameters(again)[0].successful
    do(bool).result()
    assert "an empty file" in node.statistics.report().last_error
    shutil.copy(shipped / file, tmp_path / shipped.name)
    do(gate.wait)
    assert node.set_parameters(again)[0].successful
    node._look_after()
    gate.set()
    do(bool).result()
    node._look_after()
    assert node._in_use.weights == node.settings.weights == str(tmp_path)


def keypoints(*persons: str) -> bytes:
    """A message of people's keypoints, all in one place."""
    bones = Skeleton(keypoint_layout("coco17"), Proportions.builtin("male"))
    points = bones.posed(Pose(np.array([0.0, 0.0, 3.0]), exp_so3(np.zeros((24, 3))), np.zeros(10))).points
    lists = [(person, 10**9, [0.0] * 6 + [1.0], points) for person in persons]
    return encode_lists(7, lists, frame_id="map", color=(1.0,) * 4, size=0.1, lifetime_ns=0)


def test_a_message_of_many_is_placed_at_once(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """All who wait for transforms were looked through again for each person: a minute for a message."""
    listener, looks = node._listener, list[int]()
    listener.follow(load_body("male"))
    listener.scene = Scene(node.statistics)
    monkeypatch.setattr(node, "is_watched", lambda: True)
    monkeypatch.setattr(node, "now_ns", lambda: 10**9)
    monkeypatch.setattr(listener, "_place", lambda: looks.append(len(listener._waiting)))
    listener._on_input("", "/smpl_params", keypoints(*(f"p{i}" for i in range(20))))
    assert looks == [20]


def test_predictions_end_with_the_messages_where_time_stands_still(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tracker that ended while a simulation was paused left its people standing there, and nothing was wrong."""
    listener, parameters = node._listener, [Parameter("person_timeout", value=0.2)]
    assert node.set_parameters(parameters)[0].successful
    listener.follow(load_body("male"))
    monkeypatch.setattr(node, "is_watched", lambda: True)
    monkeypatch.setattr(node, "now_ns", lambda: 10**9)
    monkeypatch.setattr(NodeListener, "is_steady", True)
    for persons in ({"ann"}, set()):
        listener.scene = Scene(node.statistics)
        if persons:
            listener._on_input("", "/smpl_params", keypoints("ann"))
        else:
            time.sleep(0.25)
        listener.predict()
        assert {*listener.scene.persons} == persons


def test_a_clock_set_back_has_things_where_they_will_be(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    listener, now = node._listener, [8 * 10**9]
    monkeypatch.setattr(node, "now_ns", lambda: now[0])

    def come(child: str, *stamps: int) -> None:
        ones = [Transform(stamp, "map", child, [1e-9 * stamp, 0, 0], [0, 0, 0, 1]) for stamp in stamps]
        listener._on_transforms(deque([encode_transforms(ones)]), is_static=False)

    come("camera", *range(0, 8 * 10**9 + 1, 10**9))
    now[0] -= 10**7  # the clock is corrected
    come("lidar", now[0])
    assert listener._tf.lookup("map", "camera", 5 * 10**9).translation[0] == 5
    now[0] = 4 * 10**9 + 5 * 10**8  # a simulation begins anew
    come("lidar", now[0])  # it came after that
    come("camera", now[0] + 10**8)
    assert listener._tf.lookup("map", "lidar", now[0])
    with pytest.raises(TransformError, match="newer than the input"):
        listener._tf.lookup("map", "camera", now[0])


def test_a_topic_of_two_types_is_said_to_be_one(ros: None) -> None:  # noqa: ARG001
    remapped = ["--ros-args", "-r", "garments:=of_two_types", "-r", "smpl_params:=of_two_types"]
    node = GarmentNode(cli_args=remapped)
    try:
        with pytest.raises(RefuError, match=r"can't subscribe to /of_two_types as std_msgs.*another type"):
            node._listener.subscribe()
    finally:
        node.close()
        node.destroy_node()


def test_a_camera_whose_topic_is_no_name_is_named(ros: None) -> None:  # noqa: ARG001
    """The error said that some name couldn't be resolved, and not whose."""
    node = GarmentNode(cli_args=["--ros-args", "-p", "camera_info:=a b"])
    try:
        with pytest.raises(RefuError, match=r"can't subscribe to a b as sensor_msgs/msg/CameraInfo.*no name of one"):
            node._listener.subscribe()
    finally:
        node.close()
        node.destroy_node()


def test_messages_that_come_too_fast_leave_a_turn_to_others(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Timers and requests waited behind all messages that had come: twenty seconds, with a crowd's keypoints."""
    executor, done, listener = make_executor(), list[bytes | str](), node._listener
    executor.add_node(node)
    monkeypatch.setattr(listener, "_on_input", lambda person, topic, data: done.append(data))  # noqa: ARG005
    listener.scene = Scene(node.statistics)
    listener.subscribe()
    for i in range(100):
        listener._come("", "/smpl_params", bytes([i]))
    others = 20
    for _ in range(others):
        executor.create_task(lambda: done.append("other"))
    while len(done) < INPUT_QOS.depth + others:
        executor.spin_once(timeout_sec=0.1)
    assert [one for one in done if one != "other"] == [bytes([i]) for i in range(95, 100)]
    assert done.index(b"\x60") > done.index("other")  # not one message after another
    report = node.statistics.report()
    assert (report.total["received"], report.total["drop.stale"]) == (100, 100 - INPUT_QOS.depth)
    listener.unsubscribe()
    executor.remove_node(node)


def test_a_crowds_topics_leave_a_turn_to_others(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of 64 people who came at once held up all else for two seconds, and again with each 64 new names."""
    executor, there, persons = make_executor(), list[int](), [f"p{i}" for i in range(20)]
    executor.add_node(node)
    node.trigger_configure()
    node._worker = SimpleNamespace(fittings=node._fittings, stop=lambda: None)
    monkeypatch.setattr(NodeListener, "persons", persons)
    known = node._bank._publishers
    node._hold_topics()
    for _ in range(3):
        executor.create_task(lambda: there.append(len(known)))

    wanted = {topic for one in node._outputs for topic in one.topics(persons, node._fittings) if topic[0] == "p"}
    while len(there) < 3 or not wanted <= known.keys():
        executor.spin_once(timeout_sec=0.1)
    assert max(there) < len(known) / 2
    monkeypatch.setattr(NodeListener, "persons", [])
    node._hold_topics()
    assert not wanted & known.keys()
    executor.remove_node(node)


class _Qos(ctypes.Structure):
    """`rmw_qos_profile_t`."""

    _fields_ = (
        ("history", ctypes.c_int),
        ("depth", ctypes.c_size_t),
        ("reliability", ctypes.c_int),
        ("durability", ctypes.c_int),
        ("deadline_and_lifespan", ctypes.c_uint64 * 4),
        ("liveliness", ctypes.c_int),
        ("lease", ctypes.c_uint64 * 2),
        ("is_not_ros", ctypes.c_bool),
    )


class _Bytes(ctypes.Structure):
    """`rmw_serialized_message_t`."""

    _fields_ = (("data", ctypes.c_char_p), ("length", ctypes.c_size_t), ("room", ctypes.c_size_t * 6))


@contextmanager
def dds(peer: Any, kind: Any, topic: bytes) -> Iterator[Callable[[bytes], int]]:
    """A publisher of the middleware alone, for which ROS's rules of names don't hold; yields its `publish`."""
    files = [line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if ".so" in line]
    loaded = {Path(file).name: file for file in files}
    if "librmw_fastrtps_cpp.so" not in loaded:
        pytest.skip("the middleware isn't Fast DDS")
    rcl, rmw, python = ctypes.CDLL(loaded["librcl.so"]), ctypes.CDLL(loaded["librmw_fastrtps_cpp.so"]), ctypes.pythonapi
    pointer, python.PyCapsule_GetName.restype = ctypes.c_void_p, ctypes.c_char_p
    for function in (rcl.rcl_node_get_rmw_handle, rmw.rmw_create_publisher, python.PyCapsule_GetPointer):
        function.restype = pointer
    kind.__class__.__import_type_support__()
    support = ctypes.py_object(kind.__class__._TYPE_SUPPORT)
    support = pointer(python.PyCapsule_GetPointer(support, ctypes.c_char_p(python.PyCapsule_GetName(support))))
    qos, nothing = _Qos(1, 1, 1, 1, liveliness=1, is_not_ros=True), (ctypes.c_uint64 * 8)()
    with peer.handle:
        own = pointer(rcl.rcl_node_get_rmw_handle(pointer(peer.handle.pointer)))
        made = pointer(rmw.rmw_create_publisher(own, support, topic, ctypes.byref(qos), nothing))
    assert made
    try:
        yield lambda data: rmw.rmw_publish_serialized_message(made, ctypes.byref(_Bytes(data, len(data))), None)
    finally:
        rmw.rmw_destroy_publisher(own, made)


def test_names_that_are_no_text_silence_nobody(ros: None, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: ARG001
    """rclpy names no node, or no topic, while one of them isn't UTF-8: diagnostics ended for good."""
    monkeypatch.setattr("refu_ros._node._BEAT_S", 0.2)
    scene, ann, context = NodeHere(**CHEAP, follow_humans=True), Peer("ann", topic=BODY), rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    stranger = rclpy.create_node("stranger", context=context)  # what comes from its own process a node doesn't heed
    info = ParticipantEntitiesInfo(node_entities_info_seq=[NodeEntitiesInfo(node_namespace="/", node_name="nobody")])
    scene.until(ann.listeners, "ann is listened to")
    with dds(stranger, ParticipantEntitiesInfo, b"ros_discovery_info") as announce:
        with dds(stranger, JointState, b"rt/humans/bodies/\xff/joint_states"):
            announce(serialize_message(info).replace(b"nobody", b"\xff" * 6))
            wanted = {"faults: names of nodes", "faults: names of topics"}
            scene.until(lambda: wanted <= scene.peer.status("node")[2].keys(), "it is said")
            assert ann.listeners()
        announce(serialize_message(ParticipantEntitiesInfo()))  # nothing else takes the name back

        def readable() -> bool:
            with suppress(UnicodeDecodeError):
                return bool(scene.node.get_node_names() and scene.node.get_topic_names_and_types())
            return False

        scene.until(readable, "names can be read again")
    stranger.destroy_node()
    context.try_shutdown()
    ann.close()
    scene.close()


def test_a_crowd_of_bodies_and_a_long_name_take_nothing_from_others(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    """Once a second the topics of all were made, and of a name too long for one nothing came any more."""
    peer = Peer("p0", topic=BODY)
    with NodeProcess(tmp_path / "log.txt", **CHEAP, follow_humans=True) as node:
        peer.wait_for_node()
        names = [LONGEST, *(f"p{i}" for i in range(1, MOST_PEOPLE + 6))]
        crowd = [peer.node.create_publisher(JointState, BODY.format(name), 1) for name in names]
        said = f"{MOST_PEOPLE + 6} bodies, up to {MOST_PEOPLE} are dressed"
        peer.spin_until(lambda: said in peer.status("input")[1], "it says how many there are")
        peer.spin_until(lambda: sum(one.get_subscription_count() for one in crowd) >= MOST_PEOPLE - 1, "it listens")
        for _ in range(2):
            peer.forget_reports()
            peer.spin_until(lambda: peer.status("node")[1] == "active", "it says how it is")
        assert sum(one.get_subscription_count() for one in crowd) == MOST_PEOPLE - 1
        assert peer.listeners("p0")  # who was here stays
        assert not crowd[0].get_subscription_count()
        assert "Traceback" not in node.log
    peer.close()
