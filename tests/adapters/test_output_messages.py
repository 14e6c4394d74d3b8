"""Points, openings and meshes as messages: against rosbags' serialiser and, where it is there, rclpy itself."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from itertools import combinations
from types import SimpleNamespace
from typing import Any
from weakref import WeakSet

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from reference import deserialise, header, serialise, stamps, texts, typestore
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from msg_adapters import (
    CAMERA_INFO,
    IDS_LIST,
    MESH,
    POINT_FIELDS,
    TF_MESSAGE,
    DecodeError,
    EncodeError,
    MarkerArrayEncoder,
    MarkerMesh,
    Placement,
    decode_camera_info,
    decode_ids,
    decode_marker_array,
    encode_mesh,
    message_definition,
    points_of,
)
from msg_adapters.markers import SKIN
from msg_adapters.outputs import (
    COLLISION_OBJECT,
    POINT_CLOUD,
    POLYGON,
    SCENE_UPDATE,
    Entity,
    PointCloudEncoder,
    Rim,
    encode_collision_object,
    encode_frames,
    encode_polygon,
    encode_rims,
    encode_scene,
    make_outputs,
)
from msg_adapters.transforms import quaternion_from_matrix

FOREIGN = (COLLISION_OBJECT, SCENE_UPDATE, IDS_LIST)
"""Types of packages that rosbags doesn't know: by our definitions, whose hashes are those of the packages' own."""
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


@pytest.fixture(scope="module", autouse=True)
def _foreign_types() -> None:
    known = typestore().fielddefs
    for name in FOREIGN:
        found = get_types_from_msg(message_definition(name).text, name)
        typestore().register({key: fields for key, fields in found.items() if key not in known})


@pytest.mark.parametrize("message_type", [POINT_CLOUD, POLYGON, MESH, TF_MESSAGE, *FOREIGN])
def test_definitions_are_those_of_their_packages(message_type: str) -> None:
    definition = message_definition(message_type)
    for name, fields in get_types_from_msg(definition.text, message_type).items():
        assert fields == typestore().fielddefs[name]
    # Hashes were taken from the text of each package's own release, which says what a type is made of, all the way.
    assert definition.type_hash == typestore().hash_rihs01(message_type)


def same_again(data: bytes, message_type: str) -> Any:
    """The message that rosbags reads, which it writes as the same bytes."""
    message = deserialise(data, message_type)
    assert serialise(message, message_type) == data
    return message


def test_few_layouts_of_many_people_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each holds a whole message; which people are in it may change with every frame that is lost."""
    garments, kept, n_made = make_outputs()[0], WeakSet[MarkerArrayEncoder](), 0
    fittings = SimpleNamespace(names=["shirt"], colors={"shirt": SKIN}, faces={"shirt": FACES}, counts={"shirt": 4})
    vertices = {"shirt": np.eye(4, 3)}
    crowd = [
        SimpleNamespace(person=f"p{i}", fittings=fittings, vertices=vertices, stamp_ns=i, offset=np.full(3, i))
        for i in range(50)
    ]
    moment: Any = SimpleNamespace(frame_id="map", lifetime_ns=0, watchers=lambda _: 1, now_ns=5)

    def make(meshes: Sequence[MarkerMesh], **how: Any) -> MarkerArrayEncoder:
        nonlocal n_made
        n_made += 1
        kept.add(one := MarkerArrayEncoder(meshes, **how))
        return one

    monkeypatch.setattr("msg_adapters.outputs._table.MarkerArrayEncoder", make)

    def send(people: Sequence[Any]) -> None:
        ((_, data),) = garments.messages(people, moment)
        assert [marker.stamp_ns for marker in decode_marker_array(data)] == [one.stamp_ns for one in people]

    for gone in range(50):
        send([one for one in crowd if one.stamp_ns != gone])
        assert len(kept) == 1
    sets = [[*people] for n in (1, 2, 3, 4) for people in combinations(crowd[:4], n)]
    for _ in range(3):
        n_made = 0
        for people in sets:
            send(people)
    assert n_made == 0  # of few, all are kept


# Points -------------------------------------------------------------------------------------------


def cloud(counts: tuple[int, ...], fields: Any = POINT_FIELDS, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    vertices, normals = ([rng.normal(size=(n, 3)).astype(np.float32) for n in counts] for _ in range(2))
    values: dict[str, Any] = {k: [rng.random(n, np.float32) for n in counts] for k in ("clearance", "sigma")}
    values |= {"normal": normals, "visible": [rng.random(n) > 0.5 for n in counts]}
    return {"vertices": vertices, "values": {name: value for name, value in values.items() if name in fields}}


@given(st.lists(st.integers(1, 50), min_size=1, max_size=4), st.sets(st.sampled_from(POINT_FIELDS)), texts, stamps)
@settings(max_examples=40)
def test_points(counts: list[int], fields: set[Any], frame_id: str, stamp_ns: int) -> None:
    encoder = PointCloudEncoder(counts, frame_id=frame_id, fields=[*fields])
    given = cloud(tuple(counts), fields)
    offset = np.array([1.0, -20.0, 3.0])
    first = encoder.encode(given.pop("vertices"), stamp_ns=5, **given)
    given = cloud(tuple(counts), fields, seed=1)
    data = encoder.encode(given["vertices"], stamp_ns=stamp_ns, offset=offset, values=given["values"])
    assert len(data) == len(first)
    message = same_again(data, POINT_CLOUD)
    assert (message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, message.header.frame_id) == (
        stamp_ns,
        frame_id,
    )
    assert (message.height, message.width, message.is_dense, message.is_bigendian) == (1, sum(counts), True, False)
    assert message.row_step == message.point_step * sum(counts) == len(message.data)
    points = points_of(message)

    def of(*names: str) -> Any:
        return np.stack([points[name] for name in names], axis=-1)

    np.testing.assert_array_equal(of("x", "y", "z"), np.concatenate(given["vertices"]) + offset.astype(np.float32))
    if "normal" in fields:
        normals = np.concatenate(given["values"].pop("normal"))
        np.testing.assert_array_equal(of("normal_x", "normal_y", "normal_z"), normals)
    for name, value in given["values"].items():
        np.testing.assert_array_equal(points[name], np.concatenate(value))
    if "vertex" in fields:
        np.testing.assert_array_equal(points["vertex"], np.concatenate([np.arange(n) for n in counts]))
    if "garment" in fields:
        np.testing.assert_array_equal(points["garment"], np.repeat(np.arange(len(counts)), counts))
    assert all(points.dtype.fields[name][1] % points.dtype[name].itemsize == 0 for name in points.dtype.names)


def test_points_of_many_vertices_have_wider_numbers() -> None:
    for n, kind in (((1 << 16) + 1, np.uint32), (1 << 16, np.uint16)):
        encoder = PointCloudEncoder([n], fields=["vertex"])
        data = encoder.encode([np.zeros((n, 3), np.float32)], stamp_ns=0, values={})
        vertex = points_of(deserialise(data, POINT_CLOUD))["vertex"]
        assert (vertex[-1], vertex.dtype) == (n - 1, kind)


def test_points_that_cannot_be() -> None:
    encoder = PointCloudEncoder([4], fields=["clearance"])
    good, clearance = [np.zeros((4, 3))], {"clearance": [np.zeros(4)]}
    for vertices, values in (
        ([np.zeros((3, 3))], clearance),
        ([np.zeros((4, 2))], clearance),
        (good, {"clearance": [np.zeros(3)]}),
    ):
        with pytest.raises(EncodeError, match="wanted"):
            encoder.encode(vertices, stamp_ns=0, values=values)
    for bad in (np.nan, np.inf):
        with pytest.raises(EncodeError, match="2 of 12 are NaN or infinite"):
            encoder.encode([np.where(np.arange(12) < 2, bad, 0.0).reshape(4, 3)], stamp_ns=0, values=clearance)
    with pytest.raises(EncodeError, match="4 of 12 are NaN or infinite"):
        encoder.encode(good, stamp_ns=0, values=clearance, offset=(0.0, 1e300, 0.0))
    large = np.array([1e39, -1e39, 0.0, 0.0])  # for float32, in which both are infinite
    with pytest.raises(EncodeError, match="vertices: 2 of 12 are NaN or infinite"):
        encoder.encode([large[:, None] * (1, 0, 0)], stamp_ns=0, values=clearance)
    with pytest.raises(EncodeError, match="clearance: 2 of 4 are NaN or infinite"):
        encoder.encode(good, stamp_ns=0, values={"clearance": [large]})
    # A sum that overflows, of numbers that don't, is no reason to refuse them.
    huge = np.full((4, 3), 3e38, np.float32)
    message = deserialise(encoder.encode([huge], stamp_ns=0, values=clearance), POINT_CLOUD)
    assert np.isfinite(points_of(message)["x"]).all()


@given(
    shape=st.tuples(st.integers(0, 4), st.integers(0, 5)),
    steps=st.tuples(st.integers(13, 20), st.integers(0, 9)),
    offsets=st.permutations([0, 4, 8]),
    order=st.sampled_from("<>"),
)
def test_a_cameras_points_come_row_by_row(
    shape: tuple[int, int], steps: tuple[int, int], offsets: list[int], order: str
) -> None:
    """Rows and points with room after them, fields and bytes in any order."""
    (height, width), (step, room) = shape, steps
    row_step = width * step + room
    wanted = np.arange(3.0 * height * width).reshape(height, width, 3)
    data = np.full(height * row_step, 255, np.uint8)
    for (i, j, k), value in np.ndenumerate(wanted):
        at = i * row_step + j * step + offsets[k]
        data[at : at + 4] = np.frombuffer(np.array(value, f"{order}f4").tobytes(), np.uint8)
    field = typestore().types["sensor_msgs/msg/PointField"]
    fields = [field(name, offset, 7, 1) for name, offset in zip("xyz", offsets, strict=True)]
    fields.insert(1, field("rgb", 12, 2, 1))
    cloud = typestore().types[POINT_CLOUD]
    message = cloud(header(), height, width, fields, order == ">", step, row_step, data, False)
    points = points_of(message)
    np.testing.assert_array_equal(np.stack([points[axis] for axis in "xyz"], -1), wanted.reshape(-1, 3))
    message.row_step = width * step - 1
    if height > 1 and width:
        with pytest.raises(DecodeError, match="a row has"):
            points_of(message)


@given(st.data())
def test_damaged_points_are_refused(data: st.DataObject) -> None:
    raw = PointCloudEncoder([3], fields=["vertex"]).encode([np.zeros((3, 3))], stamp_ns=0, values={})
    message = deserialise(raw, POINT_CLOUD)
    numbers = st.integers(0, 2**32 - 1) | st.integers(0, 70)
    for _ in range(data.draw(st.integers(1, 3))):
        name = data.draw(st.sampled_from(["height", "width", "point_step", "row_step", "offset", "datatype", "count"]))
        of = message if hasattr(message, name) else data.draw(st.sampled_from(message.fields))
        setattr(of, name, data.draw(numbers))
    message.data = message.data[: data.draw(st.integers(0, len(message.data)))]
    try:
        points = points_of(message)
    except DecodeError:
        return
    points.tobytes()


# Openings -----------------------------------------------------------------------------------------

rotations = hnp.arrays(np.float64, (3,), elements=st.floats(-4, 4)).map(lambda v: Rotation.from_rotvec(v).as_matrix())


def rim(rotation: Any, name: str = "ann/tshirt-male/neck", stamp_ns: int = 7) -> Rim:
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    centre = np.array([1.0, 2.0, 3.0])
    return Rim(name, stamp_ns, centre, rotation, circle @ rotation.T + centre)


@given(rotations, texts, stamps)
def test_openings(rotation: Any, name: str, stamp_ns: int) -> None:
    one = rim(rotation, name, stamp_ns)
    polygon = same_again(encode_polygon(one.ring, stamp_ns=stamp_ns, frame_id="odom"), POLYGON)
    points = np.array([(p.x, p.y, p.z) for p in polygon.polygon.points])
    np.testing.assert_allclose(points, one.ring, atol=1e-6)
    assert polygon.header.frame_id == "odom"

    data = encode_rims([one, rim(np.eye(3), "b")], frame_id="odom", lifetime_ns=5)
    same_again(data, "visualization_msgs/msg/MarkerArray")
    marker, other = decode_marker_array(data)
    assert (marker.ns, marker.stamp_ns, marker.frame_id, marker.type, marker.lifetime_ns, other.ns) == (
        name,
        stamp_ns,
        "odom",
        4,
        5,
        "b",
    )
    np.testing.assert_allclose(marker.points[:, 2], 0, atol=1e-12)  # in the opening's own plane, and closed
    np.testing.assert_array_equal(marker.points[0], marker.points[-1])
    turn = Rotation.from_quat(marker.pose[3:]).as_matrix()
    np.testing.assert_allclose(marker.points[:-1] @ turn.T + marker.pose[:3], one.ring, atol=1e-9)

    message = same_again(encode_frames([one], frame_id="odom"), TF_MESSAGE)
    (frame,) = message.transforms
    assert (frame.header.frame_id, frame.child_frame_id) == ("odom", name)
    q = frame.transform.rotation
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), rotation, atol=1e-9)


def test_openings_that_cannot_be() -> None:
    with pytest.raises(EncodeError, match="wanted finite points"):
        encode_polygon(np.full((3, 3), np.nan), stamp_ns=0)
    with pytest.raises(EncodeError, match="wanted finite points"):
        encode_polygon(np.zeros(3), stamp_ns=0)
    with pytest.raises(EncodeError, match=r"wanted numbers that float32 can hold, got magnitudes up to 1e\+39"):
        encode_polygon(np.diag([1.0, -1e39, 1.0]), stamp_ns=0)
    bad = rim(np.eye(3))
    bad.ring[0] = np.inf
    with pytest.raises(EncodeError, match="neck: wanted finite points"):
        encode_rims([bad])


# Meshes -------------------------------------------------------------------------------------------


@given(hnp.arrays(np.float64, (4, 3), elements=st.floats(-5, 5)), rotations, texts, stamps)
def test_meshes(vertices: Any, rotation: Any, name: str, stamp_ns: int) -> None:
    mesh = same_again(encode_mesh(vertices, FACES), MESH)
    np.testing.assert_array_equal([t.vertex_indices for t in mesh.triangles], FACES)
    np.testing.assert_array_equal([(p.x, p.y, p.z) for p in mesh.vertices], vertices)
    placement = Placement(rotation, np.array([1.0, 2.0, 3.0]))
    frames = {"neck": placement, "hem": Placement()}
    kind = {"stamp_ns": stamp_ns, "frame_id": "odom", "placement": placement}
    added = same_again(
        encode_collision_object(name, mesh=(vertices, FACES), subframes=frames, **kind), COLLISION_OBJECT
    )
    assert (added.id, added.operation, added.header.frame_id) == (name, added.ADD, "odom")
    assert (added.pose.position.x, added.pose.position.z) == (1.0, 3.0)
    q = added.pose.orientation
    np.testing.assert_allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), rotation, atol=1e-9)
    assert added.subframe_names == ["neck", "hem"]
    assert len(added.subframe_poses) == 2
    assert (len(added.meshes), len(added.mesh_poses), added.mesh_poses[0].orientation.w) == (1, 1, 1.0)
    np.testing.assert_array_equal([(p.x, p.y, p.z) for p in added.meshes[0].vertices], vertices)
    removed = same_again(encode_collision_object(name, **kind), COLLISION_OBJECT)
    assert (removed.id, removed.operation, removed.meshes) == (name, added.REMOVE, [])


def test_meshes_that_cannot_be() -> None:
    points = np.zeros((4, 3))
    for vertices, faces in (
        (np.full((4, 3), np.nan), FACES),
        (np.zeros((4, 2)), FACES),
        (points, FACES + 1),
        (points, FACES - 1),
        (points, FACES[:0]),
        (points, FACES.astype(float)),
    ):
        with pytest.raises(EncodeError, match="wanted"):
            encode_mesh(vertices, faces)


@given(texts, texts, stamps)
def test_scenes(name: str, frame_id: str, stamp_ns: int) -> None:
    vertices = np.random.default_rng(stamp_ns).normal(size=(4, 3)).astype(np.float32)
    entity = Entity(MarkerMesh(name, FACES, 4, color=(0.25, 0.5, 0.75, 1.0)), vertices, np.array([1, 2, 3.0]), stamp_ns)
    data = encode_scene([entity, entity], deleted=["gone"], stamp_ns=9, frame_id=frame_id, lifetime_ns=2 * 10**9)
    scene = same_again(data, SCENE_UPDATE)
    (deletion,) = scene.deletions
    assert (deletion.id, deletion.type, deletion.timestamp.nanosec) == ("gone", deletion.MATCHING_ID, 9)
    for one in scene.entities:
        assert (one.id, one.frame_id, one.lifetime.sec) == (name, frame_id, 2)
        assert one.timestamp.sec * 10**9 + one.timestamp.nanosec == stamp_ns
        (triangles,) = one.triangles
        assert (triangles.pose.position.y, triangles.pose.orientation.w, triangles.color.b) == (2.0, 1.0, 0.75)
        np.testing.assert_array_equal(triangles.indices, FACES.ravel())
        np.testing.assert_array_equal([(p.x, p.y, p.z) for p in triangles.points], vertices)
    with pytest.raises(EncodeError, match="finite"):
        encode_scene([Entity(entity.mesh, vertices * np.float32(np.nan), entity.position, 0)])


# People -------------------------------------------------------------------------------------------


@given(st.lists(texts, max_size=5), stamps)
def test_ids(ids: list[str], stamp_ns: int) -> None:
    make = typestore().types
    time = make["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    message = make[IDS_LIST](make["std_msgs/msg/Header"](time, "map"), ids)
    assert decode_ids(serialise(message, IDS_LIST)) == ids
    assert decode_ids(serialise(message, IDS_LIST, little_endian=False)) == ids
    with pytest.raises(DecodeError):
        decode_ids(b"\0\1\0\0" + b"\xff" * 16)


# rclpy --------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
def test_rclpy_reads_them() -> None:
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy isn't installed (extra ros)")

    def read(data: bytes, message_type: str) -> Any:
        package, _, name = message_type.split("/")
        return serialization.deserialize_message(data, getattr(import_module(f"{package}.msg"), name))

    given = cloud((7, 5))
    data = PointCloudEncoder((7, 5)).encode(given.pop("vertices"), stamp_ns=5, **given)
    message = read(data, POINT_CLOUD)
    np.testing.assert_array_equal(points_of(message), points_of(deserialise(data, POINT_CLOUD)))
    polygon = read(encode_polygon(np.eye(3), stamp_ns=3), POLYGON)
    assert [(p.x, p.y, p.z) for p in polygon.polygon.points] == [*map(tuple, np.eye(3))]
    mesh = read(encode_mesh(np.eye(4, 3), FACES), MESH)
    np.testing.assert_array_equal([t.vertex_indices for t in mesh.triangles], FACES)
    assert mesh.vertices[1].y == 1.0
    message.point_step = 1
    with pytest.raises(DecodeError, match="aren't in"):
        points_of(message)


@given(rotations)
def test_quaternions_of_matrices(rotation: Any) -> None:
    quaternion = quaternion_from_matrix(rotation)
    assert quaternion[3] >= 0
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), rotation, atol=1e-12)


# Cameras ------------------------------------------------------------------------------------------


@given(texts, st.integers(1, 5000), st.integers(1, 5000), st.floats(1, 1e4), st.lists(st.floats(-1, 1), max_size=8))
def test_cameras(frame_id: str, width: int, height: int, focal: float, distortion: list[float]) -> None:
    make = typestore().types
    region = make["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    k = np.array([focal, 0, 3.5, 0, 2 * focal, 2.5, 0, 0, 1])
    numbers = np.array(distortion), k, np.eye(3).ravel(), np.zeros(12)
    message = make[CAMERA_INFO](header(5, frame_id), height, width, "plumb_bob", *numbers, 0, 0, region)
    camera = decode_camera_info(serialise(message, CAMERA_INFO))
    assert camera == decode_camera_info(serialise(message, CAMERA_INFO, little_endian=False))
    assert (camera.width, camera.height, camera.focal) == (width, height, (focal, 2 * focal))
    assert camera.centre == (4.0, 3.0)  # from the corner, not the first middle
    assert camera.frame_id == frame_id.lstrip("/")
    for size in (0, (1 << 15) + 1, 2**32 - 1):  # a picture of 1 x 200 million pixels took 1.6 GB
        message.height = size
        with pytest.raises(DecodeError, match=f"isn't calibrated: {width} x {size} pixels"):
            decode_camera_info(serialise(message, CAMERA_INFO))
    message.height = height
    for k[0] in (0, np.nan, 1e-320, 1e300):  # the last two overflowed where the picture is drawn
        with pytest.raises(DecodeError, match="isn't calibrated"):
            decode_camera_info(serialise(message, CAMERA_INFO))
    with pytest.raises(DecodeError):
        decode_camera_info(serialise(message, CAMERA_INFO)[:-40])
