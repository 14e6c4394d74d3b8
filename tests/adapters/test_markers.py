"""MarkerArrays: byte for byte what a reference serialiser writes, and back to vertices."""

from __future__ import annotations

import copy
import pickle
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import deserialise, header, make, serialise, stamps, texts

from msg_adapters import (
    DIAGNOSTIC_ARRAY,
    MARKER_ARRAY,
    POINTS,
    DecodeError,
    DiagnosticStatus,
    EncodeError,
    MarkerArrayEncoder,
    MarkerMesh,
    decode_marker_array,
    encode_diagnostics,
    garment_namespace,
    vertices_from_points,
    vertices_ros_from_smpl,
    vertices_smpl_from_ros,
)
from msg_adapters.markers import encode_delete, encode_lists

TRIANGLE = np.array([[0, 1, 2]])
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def reference_marker(
    *,
    ns: str,
    marker_id: int,
    action: int,
    stamp_ns: int,
    frame_id: str,
    color: Any,
    points: Any,
    colors: Any,
    kind: int = 11,
    size: float = 1.0,
) -> Any:
    """The message as ROS code would build it: one object a point."""
    point, rgba = "geometry_msgs/msg/Point", "std_msgs/msg/ColorRGBA"
    pose = make(
        "geometry_msgs/msg/Pose", make(point, 0.0, 0.0, 0.0), make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    )
    empty = np.zeros(0, np.uint8)
    return make(
        "visualization_msgs/msg/Marker",
        header(stamp_ns, frame_id),
        ns,
        marker_id,
        kind,
        action,
        pose,
        make("geometry_msgs/msg/Vector3", size, size, size),
        make(rgba, *color),
        make("builtin_interfaces/msg/Duration", 0, 0),
        False,
        [make(point, *p) for p in points],
        [make(rgba, *c) for c in colors],
        "",
        make("sensor_msgs/msg/CompressedImage", header(0, ""), "", empty),
        [],
        "",
        "",
        make("visualization_msgs/msg/MeshFile", "", empty),
        False,
    )


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, Any]:
    """Random meshes with a frame of vertices and translations."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    meshes, vertices = [], []
    for i in range(draw(st.integers(1, 3))):
        n = draw(st.integers(1, 30))
        faces = rng.integers(0, n, (draw(st.integers(1, 40)), 3)).astype(
            draw(st.sampled_from([np.int32, np.int64, np.uint16]))
        )
        color = tuple(rng.random(4).astype(np.float32).tolist())
        mesh = MarkerMesh(f"{i}{draw(texts)}", faces, n, color=color)
        meshes.append(mesh)
        vertices.append(rng.normal(size=(n, 3)).astype(draw(st.sampled_from([np.float32, np.float64]))))
    transl = draw(st.sampled_from([None, "one", "each"]))
    offsets = {"one": rng.normal(size=3) * 1e5, "each": rng.normal(size=(len(meshes), 3))}
    return {
        "meshes": meshes,
        "vertices": vertices,
        "transl": offsets.get(transl) if transl else None,
        "axes": draw(st.sampled_from(["smpl", "frame"])),
        "frame_id": draw(texts),
        "stamp_ns": draw(stamps),
    }


@settings(max_examples=80)
@given(scenes())
def test_bytes_are_the_reference_serialisers(scene: dict[str, Any]) -> None:
    encoder = MarkerArrayEncoder(scene["meshes"], frame_id=scene["frame_id"], axes=scene["axes"])
    # A frame before leaves no trace.
    encoder.encode([np.full_like(v, 7) for v in scene["vertices"]], stamp_ns=1)
    frame = {key: scene[key] for key in ("stamp_ns", "transl")}
    data = encoder.encode(scene["vertices"], **frame)
    offsets = np.zeros(3) if scene["transl"] is None else scene["transl"]
    offsets = np.broadcast_to(offsets, (len(scene["meshes"]), 3))
    markers = []
    for mesh, vertices, offset in zip(scene["meshes"], scene["vertices"], offsets, strict=True):
        placed = vertices.astype(np.float64) + offset
        placed = placed[:, [2, 0, 1]] if scene["axes"] == "smpl" else placed
        corners = mesh.faces.ravel()
        markers.append(
            reference_marker(
                ns=mesh.ns,
                marker_id=0,
                action=0,
                stamp_ns=scene["stamp_ns"],
                frame_id=scene["frame_id"],
                color=mesh.color,
                points=placed[corners],
                colors=[],
            )
        )
    assert data == serialise(make(MARKER_ARRAY, markers), MARKER_ARRAY)
    for decoded, marker, mesh in zip(decode_marker_array(data), markers, scene["meshes"], strict=True):
        assert (decoded.ns, decoded.id, decoded.type, decoded.action) == (mesh.ns, 0, 11, 0)
        assert (decoded.stamp_ns, decoded.frame_id) == (scene["stamp_ns"], scene["frame_id"])
        assert (decoded.pose, decoded.scale, decoded.color) == ((0, 0, 0, 0, 0, 0, 1), (1, 1, 1), mesh.color)
        np.testing.assert_array_equal(decoded.points, [(p.x, p.y, p.z) for p in marker.points])
        assert decoded.colors.shape == (0, 4)


def test_colours_of_points_are_read() -> None:
    """As trackers of keypoints send them: alpha is the confidence."""
    colors = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    rest: dict[str, Any] = {"ns": "a", "marker_id": 1, "action": 0, "stamp_ns": 5, "frame_id": "map", "kind": 7}
    marker = reference_marker(color=(0.0,) * 4, points=np.eye(3), colors=colors, **rest)
    (decoded,) = decode_marker_array(serialise(make(MARKER_ARRAY, [marker]), MARKER_ARRAY))
    np.testing.assert_array_equal(decoded.colors, colors)
    np.testing.assert_array_equal(decoded.points, np.eye(3))


@given(texts, texts, stamps, st.integers(1, 9))
def test_points(ns: str, frame_id: str, stamp_ns: int, count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3))
    color = (0.25, 0.5, 1.0, 1.0)
    rows = [(ns, stamp_ns, IDENTITY, points)]
    data = encode_lists(POINTS, rows, frame_id=frame_id, color=color, size=0.01)
    rest: dict[str, Any] = {"ns": ns, "stamp_ns": stamp_ns, "frame_id": frame_id, "color": color, "colors": []}
    wanted = reference_marker(marker_id=0, action=0, points=points, kind=8, size=0.01, **rest)
    assert data == serialise(make(MARKER_ARRAY, [wanted]), MARKER_ARRAY)
    (marker,) = decode_marker_array(data)
    assert marker.type == POINTS
    np.testing.assert_array_equal(marker.points, points)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((4, 2)), np.full((2, 3), np.nan)])
def test_points_that_cant_be_drawn_are_refused(points: Any) -> None:
    with pytest.raises(EncodeError, match="finite points"):
        encode_lists(POINTS, [("a", 0, IDENTITY, points)], frame_id="", color=(1.0,) * 4, size=0.01)


@given(st.lists(texts, max_size=3), texts, stamps)
def test_deletions(names: list[str], frame_id: str, stamp_ns: int) -> None:
    rest: dict[str, Any] = {"stamp_ns": stamp_ns, "frame_id": frame_id, "color": (0.0,) * 4, "points": [], "colors": []}
    gone = [reference_marker(ns=ns, marker_id=0, action=2, **rest) for ns in names]
    assert encode_delete(names, stamp_ns=stamp_ns, frame_id=frame_id) == serialise(
        make(MARKER_ARRAY, gone), MARKER_ARRAY
    )


@given(
    st.lists(st.builds(DiagnosticStatus, st.integers(0, 3), texts, texts, texts, st.dictionaries(texts, texts))), stamps
)
def test_diagnostics(statuses: list[DiagnosticStatus], stamp_ns: int) -> None:
    data = encode_diagnostics(statuses, stamp_ns=stamp_ns, frame_id="f")
    message = deserialise(data, DIAGNOSTIC_ARRAY)
    assert serialise(message, DIAGNOSTIC_ARRAY) == data
    read = [(s.level, s.name, s.message, s.hardware_id, {v.key: v.value for v in s.values}) for s in message.status]
    assert read == [(s.level, s.name, s.message, s.hardware_id, s.values) for s in statuses]


def test_far_from_the_origin_keeps_its_shape() -> None:
    vertices = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)
    encoder = MarkerArrayEncoder([MarkerMesh("m", TRIANGLE, 3)])
    near, far = (encoder.encode([vertices], stamp_ns=0, transl=[x, 0, 0]) for x in (0.0, 1e5))
    shift = decode_marker_array(far)[0].points - decode_marker_array(near)[0].points
    np.testing.assert_allclose(shift, np.tile([0.0, 1e5, 0.0], (3, 1)), rtol=0, atol=1e-10)  # SMPL's x is ROS's y


def test_axes_are_rep_103() -> None:
    forward, left, up = np.eye(3)
    np.testing.assert_array_equal(
        vertices_ros_from_smpl(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])), [forward, left, up]
    )
    points = np.random.default_rng(1).normal(size=(2, 5, 3))
    np.testing.assert_array_equal(vertices_smpl_from_ros(vertices_ros_from_smpl(points)), points)


def test_namespaces() -> None:
    assert garment_namespace("skirt-female") == "skirt-female"
    assert garment_namespace("skirt-female", "anna") == "anna/skirt-female"


def test_vertices_come_back() -> None:
    rng = np.random.default_rng(2)
    faces = np.concatenate([np.arange(30).reshape(10, 3), rng.integers(0, 30, (50, 3))])
    vertices = rng.normal(size=(30, 3)).astype(np.float32)
    data = MarkerArrayEncoder([MarkerMesh("m", faces, 30)]).encode([vertices], stamp_ns=0)
    points = decode_marker_array(data)[0].points
    np.testing.assert_array_equal(vertices_smpl_from_ros(vertices_from_points(points, faces)), vertices)
    with pytest.raises(DecodeError, match="made with other faces"):
        vertices_from_points(points, np.roll(faces, 1, axis=0))
    with pytest.raises(DecodeError, match="vertex 30 of 31 is in no triangle"):
        vertices_from_points(points, faces, n_vertices=31)
    with pytest.raises(DecodeError, match="corners of 59 triangles"):
        vertices_from_points(points, faces[1:])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_vertices_that_are_not_finite_are_refused(value: float, dtype: type) -> None:
    encoder = MarkerArrayEncoder([MarkerMesh("shirt", TRIANGLE, 3)])
    vertices = np.zeros((3, 3), dtype)
    vertices[1, 2] = value
    with pytest.raises(EncodeError, match="shirt: 1 of 3 vertices are NaN or infinite"):
        encoder.encode([vertices], stamp_ns=0)
    with pytest.raises(EncodeError, match="3 of 3 vertices"):
        encoder.encode([np.zeros((3, 3))], stamp_ns=0, transl=[0, value, 0])
    with pytest.raises(EncodeError, match="2 of 3 vertices"):
        encoder.encode([np.diag([value, -value, 0])], stamp_ns=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"vertices": [np.zeros((4, 3))]}, r"wanted vertices \(3, 3\) of float32 or float64, got \(4, 3\)"),
        ({"vertices": [np.zeros((3, 3), int)]}, "of int64"),
        ({"vertices": []}, "of 1 meshes, got 0"),
        ({"transl": np.zeros((2, 3))}, r"translation of shape \(3,\) or \(1, 3\), got \(2, 3\)"),
        ({"stamp_ns": 2**63}, "32 bits of seconds"),
        ({"stamp_ns": 1.5}, "whole number of nanoseconds, got 1.5"),
        ({"stamp_ns": None}, "whole number of nanoseconds, got None"),
    ],
)
def test_frames_that_are_refused(arguments: dict[str, Any], message: str) -> None:
    encoder = MarkerArrayEncoder([MarkerMesh("m", TRIANGLE, 3)])
    with pytest.raises(EncodeError, match=message):
        encoder.encode(**({"vertices": [np.zeros((3, 3))], "stamp_ns": 0} | arguments))


@pytest.mark.parametrize(
    ("faces", "n_vertices", "color", "message"),
    [
        (np.zeros((0, 3), int), 3, (1, 1, 1, 1), "F > 0"),
        (np.zeros((1, 4), int), 3, (1, 1, 1, 1), r"got \(1, 4\)"),
        (np.zeros((1, 3)), 3, (1, 1, 1, 1), "of integers"),
        (TRIANGLE, 2, (1, 1, 1, 1), r"indices in \[0, 2\), got 0 ... 2"),
        (TRIANGLE, 3, (1, 1, 1, 2), r"4 numbers in \[0, 1\]"),
        (TRIANGLE, 3, (1, 1, 1), r"4 numbers in \[0, 1\]"),
        (TRIANGLE, 3, (1, 1, 1, np.nan), r"4 numbers in \[0, 1\]"),
    ],
)
def test_meshes_that_are_refused(faces: Any, n_vertices: int, color: Any, message: str) -> None:
    with pytest.raises(EncodeError, match=message):
        MarkerMesh("m", faces, n_vertices, color=color)


def test_encoders_that_are_refused() -> None:
    mesh = MarkerMesh("m", TRIANGLE, 3)
    for meshes in ([], [mesh, mesh]):
        with pytest.raises(EncodeError, match="distinct"):
            MarkerArrayEncoder(meshes)
    with pytest.raises(EncodeError, match="wanted axes smpl or frame, got 'opengl'"):
        MarkerArrayEncoder([mesh], axes="opengl")  # type: ignore[arg-type]


@settings(max_examples=600)
@given(st.integers(0, 600), st.binary(max_size=8), st.booleans())
def test_damaged_markers(at: int, new: bytes, cut: bool) -> None:
    data = bytearray(MarkerArrayEncoder([MarkerMesh("m", TRIANGLE, 3)]).encode([np.zeros((3, 3))], stamp_ns=0))
    at %= len(data)
    data[at : at + len(new)] = new
    if cut:
        del data[at:]
    try:
        markers = decode_marker_array(bytes(data))
    except DecodeError:
        return
    assert all(marker.points.shape[1] == 3 for marker in markers)


def test_absurd_marker_counts() -> None:
    with pytest.raises(DecodeError, match="claims 4294967295 items"):
        decode_marker_array(struct.pack("<4sI", b"\0\1\0\0", 2**32 - 1) + bytes(400))


@pytest.mark.parametrize("copied", [lambda one: pickle.loads(pickle.dumps(one)), copy.deepcopy, copy.copy])
def test_an_encoder_can_be_sent_to_a_process(copied: Callable[[MarkerArrayEncoder], MarkerArrayEncoder]) -> None:
    mesh = MarkerMesh("m", TRIANGLE, 3)
    encoder = MarkerArrayEncoder([mesh], frame_id="map", axes="frame", lifetime_ns=7)
    other = copied(encoder)
    near, far = np.eye(3), 5 * np.eye(3)
    wanted = encoder.encode([near], stamp_ns=1)
    before = other.encode([near], stamp_ns=1)
    assert encoder.encode([far], stamp_ns=2) != wanted  # nothing is shared
    assert before == wanted
    assert other.encode([near], stamp_ns=1) == wanted
