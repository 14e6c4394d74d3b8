"""What robots read: points, openings, meshes, obstacles and transforms, over real rclpy."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from geometry_msgs.msg import PolygonStamped, PoseStamped
from harness import GARMENTS, PATIENCE_S, ROOT, NodeHere, Peer, frame
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, JointState, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import String
from test_node_keypoints import people
from visualization_msgs.msg import MarkerArray

from msg_adapters import (
    IDS_LIST,
    TransformBuffer,
    decode_marker_array,
    encoder_for,
    message_definition,
    points_of,
)
from msg_adapters.cdr import CdrWriter
from msg_adapters.inputs._joint_state import AXES
from msg_adapters.outputs import COLLISION_OBJECT, SCENE_UPDATE
from msg_adapters.transforms import Transform, encode_transforms
from refu_core import GarmentPipeline, SmplFrame, load_garment
from refu_core.outputs import Openings

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
PLAIN = {"input_type": "joint_state", "garments": [*GARMENTS], "backbone": "skinned", "sdf": "none"}
TSHIRT = GARMENTS[0]


class Robot(NodeHere):
    """A node in this process, and a peer that hears what is asked for."""

    def __init__(self, *persons: str, **parameters: Any) -> None:
        super().__init__(*persons, **(PLAIN | parameters))
        self.heard: dict[str, list[Any]] = {}

    def hear(self, topic: str, kind: Any, *, raw: bool = False) -> Any:
        """Subscribes; what comes is in `heard`."""
        came: list[Any] = self.heard.setdefault(topic, [])
        return self.peer.node.create_subscription(kind, topic, came.append, 10, raw=raw)

    def sends(self, sent: SmplFrame, *topics: str, person: str = "", data: bytes | None = None) -> None:
        """Until each topic has brought something of it."""
        for topic in topics:
            self.heard[topic].clear()

        def came() -> bool:
            self.peer.send_raw(data or encoder_for("joint_state")(sent), person)
            return all(self.heard[topic] and _is_of(self.heard[topic][-1], sent) for topic in topics)

        self.until(came, f"{topics} come")


def _is_of(message: Any, sent: SmplFrame) -> bool:
    """Whether it may be of the frame: by its stamp, where it has one."""
    parts = message.markers if isinstance(message, MarkerArray) else [message]
    stamps = [part.header.stamp for part in parts if hasattr(part, "header")]
    return all(stamp.sec * 10**9 + stamp.nanosec == sent.stamp_ns for stamp in stamps)


@pytest.fixture
def robot(ros: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Robot]]:  # noqa: ARG001
    """Makes robots."""
    monkeypatch.setattr("refu_ros._listener._GRACE_S", 0.0)
    monkeypatch.setattr("refu_ros._node._BEAT_S", 0.2)
    made: list[Robot] = []

    def make(*persons: str, **parameters: Any) -> Robot:
        made.append(Robot(*persons, **parameters))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Packages that pip doesn't have, by name alone: what goes over the wire is our bytes under another type's name."""

    def make(*types: str) -> Any:
        for name in types:
            package, kind, type_name = name.split("/")
            module = ModuleType(f"{package}.{kind}")
            setattr(module, type_name, String)
            monkeypatch.setitem(sys.modules, package, ModuleType(package))
            monkeypatch.setitem(sys.modules, f"{package}.{kind}", module)
        return String

    return make


def count(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every part that is computed for an output, by name, from now on."""
    made: list[str] = []

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            made.append(name)
            return function(*arguments, **options)

        return call

    for place in (
        "outputs._dressed.VertexNormals.__call__",
        "outputs._openings.Openings.frames",
        "outputs._planner.PlannerMesh.solid",
        "outputs._clearance.Clearance.__call__",
        "outputs._sigma.Sigma.__call__",
        "outputs._limbs.LimbContacts.__call__",
        "realtime._pipeline.GarmentPipeline.__call__",
    ):
        path, _, method = f"refu_core.{place}".rpartition(".")
        module, _, owner = path.rpartition(".")
        whole = getattr(sys.modules[module], owner)
        monkeypatch.setattr(whole, method, counted(owner, getattr(whole, method)))
    return made


def test_points_openings_and_meshes_are_those_of_the_pipeline(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each computed for who subscribes, and nothing else."""
    scene = robot()
    made = count(monkeypatch)
    wanted = GarmentPipeline.load(GARMENTS, backbone="skinned", sdf="none")
    sleeve = "openings/tshirt_male/left_sleeve"
    sent = frame(3, stamp_ns=5 * 10**9, transl=(1.0, 2.0, 3.0))
    mesh = wanted(sent)[TSHIRT]
    made.clear()
    vertices = mesh.vertices[:, [2, 0, 1]]
    (opening,) = (one for one in Openings(wanted.garments[TSHIRT]).frames(vertices) if one.name == "left_sleeve")
    made.clear()

    scene.until(lambda: scene.peer.node.count_publishers(sleeve), "the topics are there")
    for i in range(5):
        scene.peer.send(frame(i))
        scene.peer.spin(0.02)
    assert made == []

    cloud = scene.hear("points", PointCloud2)
    scene.sends(sent, "points")
    assert set(made) == {"GarmentPipeline", "VertexNormals", "Clearance", "Sigma"}
    message = scene.heard["points"][-1]
    assert (message.header.frame_id, message.header.stamp.sec) == ("map", sent.stamp_ns // 10**9)
    points = points_of(message)
    own = points[points["garment"] == [*wanted.garments].index(TSHIRT)]
    np.testing.assert_array_equal(own["vertex"], np.arange(len(vertices)))
    np.testing.assert_allclose(np.stack([own["x"], own["y"], own["z"]], 1), vertices, atol=1e-5)
    lengths = np.linalg.norm(np.stack([own[f"normal_{axis}"] for axis in "xyz"], 1), axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-5)
    assert np.isfinite(own["clearance"]).all()
    assert (own["sigma"] > 0).all()
    assert "visible" not in points.dtype.names  # there is no camera
    (result,) = scene.node.set_parameters([Parameter("points_fields", value=["normal", "garment"])])
    assert result.successful, result.reason
    scene.sends(frame(4), "points")
    made.clear()
    scene.sends(frame(5), "points")
    assert set(made) == {"GarmentPipeline", "VertexNormals"}
    scene.peer.node.destroy_subscription(cloud)

    scene.until(lambda: not scene.node.watchers("points"), "nobody listens to points")
    scene.hear(sleeve, PolygonStamped)
    scene.sends(frame(6), sleeve)
    made.clear()
    scene.sends(sent, sleeve)
    assert set(made) == {"GarmentPipeline", "Openings"}
    ring = [(p.x, p.y, p.z) for p in scene.heard[sleeve][-1].polygon.points]
    np.testing.assert_allclose(ring, opening.ring, atol=1e-4)

    scene.hear("openings", MarkerArray, raw=True)
    scene.hear("mesh/short_pant_male", Mesh)
    scene.sends(sent, "openings", "mesh/short_pant_male")
    rims = {marker.ns: marker for marker in decode_marker_array(scene.heard["openings"][-1])}
    assert {"tshirt-male/neck", "tshirt-male/hem", "short-pant-male/waist"} <= set(rims)
    pose = rims["tshirt-male/left_sleeve"].pose
    np.testing.assert_allclose(pose[:3], opening.centre, atol=1e-4)
    np.testing.assert_allclose(Rotation.from_quat(pose[3:]).as_matrix(), opening.rotation, atol=1e-3)
    solid = scene.heard["mesh/short_pant_male"][-1]
    assert 1000 < len(solid.triangles) <= 2000
    corners = np.array([(p.x, p.y, p.z) for p in solid.vertices])
    shorts = wanted(sent)[GARMENTS[1]].vertices[:, [2, 0, 1]]
    np.testing.assert_allclose(corners.min(0), shorts.min(0), atol=0.02)
    np.testing.assert_allclose(corners.max(0), shorts.max(0), atol=0.02)


def test_nobody_listens_and_nothing_is_computed(robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch) -> None:
    scene = robot(lazy=False)
    made = count(monkeypatch)
    scene.until(lambda: scene.peer.listeners(), "the node listens")

    def ignored() -> bool:
        scene.peer.send(frame(1))
        return scene.node.statistics.report().total["skip.unwatched"] > 5

    scene.until(ignored, "frames come")
    assert made == []


def test_persons_have_topics_of_their_own(robot: Callable[..., Robot]) -> None:
    scene = robot("ann", "bob", persons=["ann", "bob"], garments=[TSHIRT])
    scene.hear("ann/points", PointCloud2)
    scene.hear("bob/points", PointCloud2)
    scene.hear("contacts", String)
    scene.until(lambda: scene.node.watchers("ann/points") and scene.node.watchers("bob/points"), "they are connected")
    scene.sends(frame(1), "ann/points", person="ann")
    assert not scene.heard["bob/points"]
    (result,) = scene.node.set_parameters([Parameter("garments", value=[GARMENTS[1]])])
    assert result.successful
    graph = scene.peer.node.count_publishers
    scene.until(lambda: graph("ann/openings/short_pant_male/waist"), "what is worn now has topics")
    scene.until(lambda: not graph("ann/openings/tshirt_male/neck"), "what was worn has none any more")
    scene.sends(frame(2), "ann/points", person="ann")


def test_obstacles_are_added_moved_and_removed(robot: Callable[..., Robot], foreign: Callable[..., Any]) -> None:
    kind = foreign(COLLISION_OBJECT, SCENE_UPDATE)
    scene = robot(garments=[GARMENTS[1]], planner_rate=0.0, person_timeout=1.0)
    scene.hear("collision_object", kind, raw=True)
    scene.hear("scene", kind, raw=True)
    store = get_typestore(Stores.ROS2_JAZZY)
    found = get_types_from_msg(message_definition(COLLISION_OBJECT).text, COLLISION_OBJECT)
    store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})

    known: list[Any] = []

    def heard() -> list[Any]:
        known.extend(
            store.deserialize_cdr(one, COLLISION_OBJECT) for one in scene.heard["collision_object"][len(known) :]
        )
        return known

    scene.sends(frame(1, stamp_ns=10**9), "collision_object", "scene")
    first = heard()[0]
    assert (first.id, first.operation, first.header.frame_id) == (GARMENTS[1], first.ADD, "map")
    assert 1000 < len(first.meshes[0].triangles) <= 2000
    assert set(first.subframe_names) == {"waist", "left_leg", "right_leg"}
    assert len(scene.heard["scene"][0]) > 100_000
    stamps = iter(range(2 * 10**9, 10**12, 10**8))

    def moved() -> bool:
        scene.peer.send(frame(1, stamp_ns=next(stamps), transl=(0.1, 0.0, 0.0)))
        return any(one.operation == one.ADD and one.meshes and one.pose.position.y > 0.05 for one in heard())

    scene.until(moved, "who has only moved is somewhere else")
    scene.until(lambda: any(one.operation == one.REMOVE for one in heard()), "who has left is removed")


@pytest.mark.parametrize("way", ["deactivate", "cleanup"])
def test_what_was_worn_before_is_forgotten(robot: Callable[..., Robot], way: str) -> None:
    """Garments that change while nobody is dressed: all that is sent afterwards is of the new ones."""
    scene = robot(garments=[TSHIRT], lazy=False)
    node, short = scene.node, GARMENTS[1]
    for topic, kind in (("garments", MarkerArray), ("openings", MarkerArray), ("points", PointCloud2)):
        scene.hear(topic, kind)
    scene.sends(frame(1), "garments", "openings", "points")
    node.trigger_deactivate()
    node.set_parameters([Parameter("garments", value=[short])])
    if way == "cleanup":
        node.trigger_cleanup()
        node.trigger_configure()
    else:
        scene.until(lambda: node._in_use.garments == (short,), "the other garment is loaded")
    node.trigger_activate()
    scene.sends(frame(2), "garments", "openings", "points")
    assert [marker.ns for marker in scene.heard["garments"][-1].markers] == [short]
    assert {marker.ns.split("/")[0] for marker in scene.heard["openings"][-1].markers} == {short}
    assert len(points_of(scene.heard["points"][-1])) == load_garment(short).n_vertices


def world() -> tuple[bytes, TransformBuffer]:
    """A camera on a mast, 2 m high, that looks along x, 20° down: /tf_static, and the same for the test."""
    optical = Rotation.from_euler("ZYX", [-90, 0, -90], degrees=True)
    ones = [
        Transform(0, "map", "mast", [1.0, 2.0, 2.0], Rotation.from_euler("y", 20, degrees=True).as_quat()),
        Transform(0, "mast", "optical", [0, 0, 0], optical.as_quat()),
    ]
    data, buffer = encode_transforms(ones), TransformBuffer()
    buffer.put(data, is_static=True)
    return data, buffer


def test_an_input_in_a_cameras_frame_is_seen_in_the_robots(
    robot: Callable[..., Robot], foreign: Callable[..., Any]
) -> None:
    kind = foreign("tf2_msgs/msg/TFMessage")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    scene = robot(garments=[TSHIRT], input_axes="frame", camera_info="camera_info")
    static = scene.peer.node.create_publisher(kind, "/tf_static", latched)
    data, buffer = world()
    static.publish(data)
    info = scene.peer.node.create_publisher(CameraInfo, "camera_info", 1)
    calibrated = CameraInfo(width=640, height=480, k=[500.0, 0, 320, 0, 500, 240, 0, 0, 1])
    calibrated.header.frame_id = "optical"
    scene.hear("points", PointCloud2)
    pose = np.zeros((24, 3))
    pose[0] = Rotation.from_euler("x", 180, degrees=True).as_rotvec()  # upright, where y points down; faces the camera
    sent = SmplFrame(pose, transl=np.array([0.0, 0.2, 3.0]), stamp_ns=5 * 10**9)
    message = encoder_for("joint_state")(sent, frame_id="optical")

    def sees() -> bool:
        info.publish(calibrated)
        scene.peer.send_raw(message)
        came = scene.heard["points"]
        return bool(came) and "visible" in points_of(came[-1]).dtype.names

    scene.until(sees, "points come, and the camera is known")
    points = points_of(scene.heard["points"][-1])
    got = np.stack([points["x"], points["y"], points["z"]], 1)
    mesh = GarmentPipeline.load([TSHIRT], backbone="skinned", sdf="none")(sent)[TSHIRT]
    place = buffer.lookup("map", "optical", 0)
    np.testing.assert_allclose(got, mesh.vertices @ place.rotation.T + place.translation, atol=1e-5)
    # By hand: 3 m along a view that goes 20° down from 2 m, and the shirt is upright but for these.
    assert got[:, 0].mean() == pytest.approx(1.0 + 3.0 * np.cos(np.radians(20)), abs=0.25)
    assert got[:, 2].max() - got[:, 2].min() > 0.5
    seen = points["visible"].astype(bool)
    assert 0.3 < seen.mean() < 0.65  # about half of a shirt faces the camera
    normals = np.stack([points[f"normal_{axis}"] for axis in "xyz"], 1)
    facing = ((got - [1.0, 2.0, 2.0]) * normals).sum(1) < 0
    assert (facing[seen]).mean() > 0.85

    late = encode_transforms([Transform(4 * 10**9, "map", "other", [0, 0, 0], [0, 0, 0, 1])])
    moving = scene.peer.node.create_publisher(kind, "/tf", 10)

    def dropped() -> bool:
        moving.publish(late)
        scene.peer.send_raw(encoder_for("joint_state")(sent, frame_id="other"))
        report = scene.node.statistics.report()
        return "1.000 s older" in report.reasons.get("transform", "")

    scene.until(dropped, "an input without a transform at its time is counted, with the reason")
    with_tolerance = [Parameter("transform_tolerance", value=2.0)]
    assert scene.node.set_parameters(with_tolerance)[0].successful

    def late_ones() -> bool:
        scene.peer.send_raw(encoder_for("joint_state")(sent, frame_id="other"))
        return scene.node.statistics.report().total["late_transform"] > 0

    scene.until(late_ones, "late transforms are counted")


def test_a_camera_is_found_under_the_name_that_it_is_remapped_to(robot: Callable[..., Robot]) -> None:
    scene = robot(garments=[TSHIRT], camera_info="camera_info", remaps=["camera_info:=/front/camera_info"])
    scene.hear("points", PointCloud2)
    info = scene.peer.node.create_publisher(CameraInfo, "/front/camera_info", 1)
    calibrated = CameraInfo(width=640, height=480, k=[500.0, 0, 320, 0, 500, 240, 0, 0, 1])
    calibrated.header.frame_id = "map"

    def sees() -> bool:
        info.publish(calibrated)
        scene.peer.send(frame(1))
        came = scene.heard["points"]
        return bool(came) and "visible" in points_of(came[-1]).dtype.names

    scene.until(sees, "it is said which points the camera sees", timeout=30.0)


def test_without_transforms_the_frame_is_warned_of(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where tf2_msgs isn't there nothing is lost: people are shown as they were sent."""
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    scene = robot(garments=[TSHIRT])
    scene.hear("points", PointCloud2)
    scene.sends(frame(1), "points", data=encoder_for("joint_state")(frame(1), frame_id="camera"))
    assert scene.heard["points"][-1].header.frame_id == "map"
    scene.peer.forget_reports()
    scene.until(lambda: scene.peer.diagnostics, "the node says how it is")
    assert scene.peer.status("input")[2]["frame"] == "camera, shown as map"
    scene.peer.forget_reports()

    def warned() -> bool:
        scene.peer.send_raw(encoder_for("joint_state")(frame(1), frame_id="camera"))
        return "camera is taken for map" in (scene.peer.status("input") or ("", ""))[1]

    scene.until(warned, "as long as that lasts, the diagnostics warn of it")


def test_one_persons_frame_is_warned_of_whoever_sends_last(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With somebody in the right frame beside them, the level was OK as often as not."""
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    scene = robot("ann", "bob", persons=["ann", "bob"], garments=[TSHIRT])
    scene.hear("garments", MarkerArray, raw=True)

    def told(n: int = 0) -> bool:
        for person, frame_id in (("ann", "camera"), ("bob", "map")):
            scene.peer.send_raw(encoder_for("joint_state")(frame(1), frame_id=frame_id), person)
        return len(scene.peer.diagnostics) >= n

    scene.until(lambda: told() and len(scene.node._listener.scene.persons) == 2, "both are here")
    scene.peer.forget_reports()
    scene.until(lambda: told(5), "the node says how it is")
    said = [one for array in scene.peer.diagnostics for one in array.status if one.name.endswith(": input")]
    assert all("camera is taken for map" in one.message for one in said), [one.message for one in said]


def test_a_cameras_frame_is_written_to_the_log_without_its_control_characters(
    robot: Callable[..., Robot], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    scene = robot(garments=[TSHIRT], camera_info="camera_info")
    scene.hear("points", PointCloud2)
    said, publisher = "", scene.peer.node.create_publisher(CameraInfo, "camera_info", 1)
    camera = CameraInfo(width=640, height=480, k=[500.0, 0, 320, 0, 500, 240, 0, 0, 1])
    camera.header.frame_id = "eye\x1b[2J"

    def warned() -> bool:
        nonlocal said
        publisher.publish(camera)
        said += capfd.readouterr().err
        return "if they are the same place" in said

    scene.until(warned, "it is warned of")
    assert "\x1b" not in said
    assert "eye\\x1b[2J" in said


@pytest.mark.parametrize(("frame_id", "is_told"), [("camera", True), ("camera_optical", False)])
def test_an_output_frame_in_which_people_stand_on_their_heads_is_told(
    robot: Callable[..., Robot], capfd: pytest.CaptureFixture[str], frame_id: str, is_told: bool
) -> None:
    scene = robot(garments=[TSHIRT], input_axes="frame", frame_id=frame_id)
    scene.hear("garments", MarkerArray)
    pose, stamps = np.zeros((24, 3)), itertools.count(10**9, 10**8)
    pose[0, 0] = np.pi  # y is down

    def came() -> bool:
        sent = SmplFrame(pose, stamp_ns=next(stamps))
        scene.peer.send_raw(encoder_for("joint_state")(sent, frame_id=frame_id))
        return len(scene.node._listener.doubts.of_senders) > 0

    scene.until(came, "they are judged")
    assert ("heads are towards -y: input_axes is frame, and frame_id has z up" in capfd.readouterr().err) == is_told


def test_an_input_waits_for_its_transform(robot: Callable[..., Robot], foreign: Callable[..., Any]) -> None:
    """Nobody is where they aren't: not before there are transforms, nor where a camera was before it moved."""
    kind = foreign("tf2_msgs/msg/TFMessage")
    scene = robot(garments=[TSHIRT], input_axes="frame", transform_tolerance=10.0, person_timeout=60.0)
    scene.hear("points", PointCloud2)
    moving = scene.peer.node.create_publisher(kind, "/tf", 10)
    mesh = GarmentPipeline.load([TSHIRT], backbone="skinned", sdf="none")(frame(0))[TSHIRT]

    def sees(stamp_ns: int) -> None:
        sent = replace(frame(0), stamp_ns=stamp_ns)
        scene.peer.send_raw(encoder_for("joint_state")(sent, frame_id="camera"))

    def missed() -> bool:
        sees(1)
        return "none has come: start what sends /tf" in scene.node.statistics.report().reasons["transform"]

    scene.node.set_parameters([Parameter("transform_tolerance", value=0.1)])
    scene.until(missed, "that there are none is said")
    assert scene.heard["points"] == []
    scene.node.set_parameters([Parameter("transform_tolerance", value=10.0)])
    scene.until(lambda: moving.get_subscription_count(), "they are listened to")
    for step in range(5, 10):
        sees(step * 10**9)
        scene.until(lambda: scene.node._listener._waiting, "it waits")
        place = Transform(step * 10**9, "map", "camera", [float(step), 0, 0], [0, 0, 0, 1])
        moving.publish(encode_transforms([place]))
        scene.until(lambda of=step: [m.header.stamp.sec for m in scene.heard["points"]][-1:] == [of], "it comes")
        points = points_of(scene.heard["points"][-1])
        np.testing.assert_allclose(points["x"], mesh.vertices[:, 0] + step, atol=1e-5)
    scene.node.set_parameters([Parameter("transform_tolerance", value=0.1)])
    sees(9 * 10**9 + 10**7)
    scene.until(lambda: len(scene.heard["points"]) == 6, "what has waited in vain comes without any other event")
    assert scene.node.statistics.report().total["late_transform"] == 1


def test_a_flood_of_transforms_leaves_others_a_turn(robot: Callable[..., Robot], foreign: Callable[..., Any]) -> None:
    """Requests waited behind all that had come: for half a minute, where each message held ten thousand."""
    foreign("tf2_msgs/msg/TFMessage")
    scene = robot(garments=[TSHIRT], lazy=False)
    listener, others = scene.node._listener, list[int]()
    listener._listen_to_tf()
    places = [Transform(10**9, "map", f"link_{i}", [0, 0, 0], [0, 0, 0, 1]) for i in range(250)]
    message = encode_transforms(places)
    for _ in range(150):
        listener._inputs["/tf"].callback(message)
    scene.node.executor.create_task(lambda: others.append(len(listener._turns["/tf"])))
    scene.until(lambda: others, "others have their turn")
    assert others[0] > 90
    scene.until(lambda: "/tf" not in listener._turns, "they are taken")
    assert len(listener._tf) == len(places)
    assert scene.node.statistics.report().total["drop.stale_transforms"] == 50
    take = listener._inputs["/tf"].callback
    listener.unsubscribe()
    take(message)  # the executor had it already
    assert not listener._turns


def test_each_person_is_where_their_own_marker_is(robot: Callable[..., Robot], foreign: Callable[..., Any]) -> None:
    """Of two cameras, one at the origin of the map."""
    kind = foreign("tf2_msgs/msg/TFMessage")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    scene = robot("nobody", garments=[TSHIRT], input_type="keypoint_markers", keypoints="coco17", person_timeout=30.0)
    static = scene.peer.node.create_publisher(kind, "/tf_static", latched)
    tracker = scene.peer.node.create_publisher(MarkerArray, "smpl_params", 1)
    data, buffer = world()
    static.publish(data)
    scene.hear("garments", MarkerArray, raw=True)
    there = buffer.lookup("map", "optical", 0)
    wanted = {"ann": np.array([0.0, 0.0, 3.0]), "bob": there.rotation @ [1.5, 0.0, 4.0] + there.translation}
    ticks = iter(range(10**6))

    def are_there() -> bool:
        message = people(1e-4 * next(ticks))
        message.markers[0].header.frame_id, message.markers[1].header.frame_id = "map", "optical"
        tracker.publish(message)
        came = [marker for data in scene.heard["garments"][-1:] for marker in decode_marker_array(data)]
        places = {marker.ns.split("/")[0]: marker.points.mean(0) for marker in came if len(marker.points)}
        return wanted.keys() <= places.keys() and all(
            np.linalg.norm(places[person] - place) < 0.7 for person, place in wanted.items()
        )

    scene.until(are_there, "each is where their camera has them")


def test_whoever_has_left_while_a_frame_of_theirs_waited_is_removed(robot: Callable[..., Robot]) -> None:
    """A low rate, or a slow machine: who was told to have gone was dressed once more, and stayed for ever."""
    scene = robot(garments=[TSHIRT], max_rate=0.5, person_timeout=0.5)
    scene.hear("garments", MarkerArray, raw=True)
    scene.sends(frame(1), "garments")
    held = scene.node.statistics.report().total["frames"]
    scene.peer.send(frame(2))
    scene.until(lambda: scene.node.statistics.report().total["frames"] > held, "what waited is dressed")

    def is_empty() -> bool:
        came = [marker for data in scene.heard["garments"] for marker in decode_marker_array(data)]
        return came[-1].action == 2 and any(marker.stamp_ns == frame(2).stamp_ns for marker in came)

    scene.until(is_empty, "nobody is shown any more", timeout=20.0)


def test_what_was_placed_in_another_frame_is_not_sent_in_this_one(
    robot: Callable[..., Robot], foreign: Callable[..., Any]
) -> None:
    kind = foreign("tf2_msgs/msg/TFMessage")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    scene = robot(garments=[TSHIRT], max_rate=0.5, person_timeout=30.0)
    static = scene.peer.node.create_publisher(kind, "/tf_static", latched)
    level = [0, 0, 0, 1]
    static.publish(
        encode_transforms(
            [Transform(0, "map", "camera", [5, 0, 0], level), Transform(0, "odom", "map", [90, 0, 0], level)]
        )
    )
    scene.hear("garments", MarkerArray, raw=True)
    places: dict[str, set[float]] = {}
    stamps = iter(range(10**9, 10**12, 10**8))

    def are_told(frame_id: str) -> bool:
        sent = encoder_for("joint_state")(frame(1, stamp_ns=next(stamps)), frame_id="camera")
        scene.peer.send_raw(sent)
        for marker in (one for data in scene.heard["garments"] for one in decode_marker_array(data)):
            if len(marker.points):
                places.setdefault(marker.frame_id, set()).add(round(float(marker.points[:, 0].mean()), 1))
        return frame_id in places

    scene.until(lambda: are_told("map"), "they are in the map")
    scene.until(lambda: scene.node._listener.scene._pending, "another frame waits")
    scene.node.set_parameters([Parameter("frame_id", value="odom")])
    scene.until(lambda: not scene.node._listener.scene._pending, "it is taken")
    scene.until(lambda: are_told("odom"), "they are in the frame of now")
    assert {name: min(where) // 10 for name, where in places.items()} == {"map": 0, "odom": 9}


def test_who_is_tracked_is_followed(robot: Callable[..., Robot], foreign: Callable[..., Any]) -> None:
    """REP-155: where somebody says who is tracked, nobody else; each in the frame of their body."""
    kind = foreign(IDS_LIST, "tf2_msgs/msg/TFMessage")
    people = Peer("ann", "bob", topic="/humans/bodies/{}/joint_states")
    people.unwatch()
    scene = robot(follow_humans=True, garments=[TSHIRT], person_timeout=30.0)
    scene.hear("garments", MarkerArray, raw=True)
    scene.until(lambda: people.listeners("ann") and people.listeners("bob"), "nobody says who is tracked")
    tracked = people.node.create_publisher(kind, "/humans/bodies/tracked", 1)

    def says(*ids: str) -> None:
        writer = CdrWriter()
        writer.fields("Ts", 0, "")
        writer.strings(ids)
        tracked.publish(writer.to_bytes())

    def only_ann() -> bool:
        says("ann", "eve")
        return bool(people.listeners("ann")) and not people.listeners("bob")

    scene.until(only_ann, "ann alone is tracked")
    scene.until(lambda: scene.peer.node.count_publishers("ann/points"), "she has topics")
    names = [f"{joint}_ann" for joint in AXES]
    message = JointState(name=names, position=[0.0] * len(names))
    message.header.stamp.sec = 5
    moving = people.node.create_publisher(kind, "/tf", 10)
    place = encode_transforms([Transform(5 * 10**9, "map", "body_ann", [4.0, 5.0, 1.0], [0, 0, 0, 1])])
    people.fall_silent("bob")
    sender = people.node.create_publisher(JointState, "/humans/bodies/ann/joint_states", 1)

    def stands_there() -> bool:
        moving.publish(place)
        sender.publish(message)
        came = [marker for data in scene.heard["garments"] for marker in decode_marker_array(data)]
        return any(abs(marker.points.mean(0) - [4.0, 5.0, 1.25]).max() < 0.15 for marker in came if len(marker.points))

    scene.until(stands_there, "she is dressed where tf has her body")

    def nobody() -> bool:
        says()
        return not people.listeners("ann")

    scene.until(nobody, "nobody is tracked")
    scene.until(lambda: scene.peer.status("input")[:2] == (0, "0.0 Hz"), "an empty room is no fault")
    sender.publish(message)

    def misses_eve() -> bool:
        says("eve")
        return scene.peer.status("input")[:2] == (1, "no input from eve")

    scene.until(misses_eve, "who is tracked, and never sends, is missed")
    people.node.destroy_publisher(tracked)  # its node has died: whoever comes now is known by a topic alone
    scene.until(lambda: people.listeners("ann"), "nobody says any more who is tracked", timeout=30.0)
    people.close()


def test_who_is_tracked_in_flickers_and_crowds_slows_nothing(
    robot: Callable[..., Robot], foreign: Callable[..., Any]
) -> None:
    """Each message made and ended subscriptions, with a line in the log each: 1.6 GB a day, from one peer's 80 Hz."""
    kind = foreign(IDS_LIST)
    people = Peer("ann", topic="/humans/bodies/{}/joint_states")
    scene = robot(follow_humans=True, garments=[TSHIRT], lazy=False)
    scene.until(lambda: people.listeners("ann"), "somebody is listened to")
    node, listener = scene.node, scene.node._listener
    people.node.create_publisher(kind, "/humans/bodies/tracked", 1)
    scene.until(lambda: node.count_publishers("/humans/bodies/tracked"), "somebody may say who is tracked")
    subscription = listener._inputs["ann"]

    def says(*ids: str) -> None:
        writer = CdrWriter()
        writer.fields("Ts", 0, "")
        writer.strings(ids)
        listener._inputs["/humans/bodies/tracked"].callback(writer.to_bytes())

    for _ in range(100):
        says("ann")
        says()
    assert [*listener._inputs] == ["/humans/bodies/tracked", "ann"]
    assert listener._inputs["ann"] is subscription
    says(*(f"{i}" * 60 for i in range(10_000)))
    scene.until(lambda: "ann" not in listener._inputs, "nobody who is tracked is there")
    assert len(listener.expected) == listener.room
    people.close()


def test_the_example_in_python_hears_the_node(robot: Callable[..., Robot], tmp_path: Path) -> None:
    scene = robot(garments=[TSHIRT])
    scene.hear("gripper_target", PoseStamped)
    log = tmp_path / "log.txt"
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}
    with log.open("wb") as file:
        example = subprocess.Popen(
            [sys.executable, str(ROOT / "examples" / "ros" / "sleeve_listener.py")],
            env=environment,
            stdout=file,
            stderr=file,
        )
    try:

        def came() -> bool:
            assert example.poll() is None, log.read_text()
            scene.peer.send(frame(1))
            return bool(scene.heard["gripper_target"]) and "mm off the skin" in log.read_text()

        scene.until(came, "the example says what it has heard")
        example.send_signal(signal.SIGINT)
        assert example.wait(timeout=PATIENCE_S) == 0, log.read_text()
    finally:
        example.kill()
        example.wait()
    target = scene.heard["gripper_target"][-1]
    garment = load_garment(TSHIRT)
    worn = GarmentPipeline.load([TSHIRT], backbone="skinned", sdf="none")(frame(1))[TSHIRT].vertices[:, [2, 0, 1]]
    (sleeve,) = (one for one in Openings(garment).frames(worn) if one.name == "left_sleeve")
    place = np.array([target.pose.position.x, target.pose.position.y, target.pose.position.z])
    assert 0.1 < (place - sleeve.centre) @ sleeve.rotation[:, 2] < 0.2
    q = target.pose.orientation
    into = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()[:, 2]
    assert into @ sleeve.rotation[:, 2] < -0.9


def test_the_example_in_python_ends_in_silence_wherever_a_signal_meets_it(tmp_path: Path) -> None:
    """In the middle of taking a message, and of publishing: rclpy makes other errors of it."""
    program = f"""
import os, runpy, signal, time, rclpy
def spin(node):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        while rclpy.ok():
            time.sleep(0.01)
    except KeyboardInterrupt:
        pass
    raise RuntimeError("Unable to convert call argument '0' to Python object")
rclpy.spin = spin
runpy.run_path({str(ROOT / "examples" / "ros" / "sleeve_listener.py")!r}, run_name="__main__")
"""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, check=False, timeout=PATIENCE_S)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(shutil.which("colcon") is None or shutil.which("ros2") is None, reason="there is no rclcpp here")
def test_the_example_in_cpp_builds(tmp_path: Path) -> None:
    source = ROOT / "examples" / "ros" / "refu_listener_cpp"
    command = ["colcon", "build", "--paths", str(source)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stdout + done.stderr
