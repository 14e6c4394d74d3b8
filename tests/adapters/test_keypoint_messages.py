"""Messages of keypoints, serialised by rosbags: one person's poses, several persons' markers, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from reference import header, make, serialise

from msg_adapters import (
    KEYPOINT_TYPES,
    BagWriter,
    DecodeError,
    InputStream,
    open_smpl_bag,
)
from msg_adapters.inputs import decode_keypoints
from refu_core import load_body
from refu_core.keypoints import Proportions, Skeleton, keypoint_layout
from refu_core.keypoints._pose import Pose, exp_so3

POSES, MARKERS = KEYPOINT_TYPES["keypoint_poses"], KEYPOINT_TYPES["keypoint_markers"]
K = 17
numbers = hnp.arrays(np.float64, (K, 3), elements=st.floats(-10, 10).map(lambda x: x if abs(x) > 1e-6 else 1.0))


def point(xyz: Any) -> Any:
    return make("geometry_msgs/msg/Point", *map(float, xyz))


def pose(xyz: Any, turn: Any = (0, 0, 0, 0)) -> Any:
    return make("geometry_msgs/msg/Pose", point(xyz), make("geometry_msgs/msg/Quaternion", *map(float, turn)))


def pose_array(points: Any, stamp_ns: int = 5, frame_id: str = "camera") -> bytes:
    return serialise(make(POSES, header(stamp_ns, frame_id), [pose(xyz) for xyz in points]), POSES)


def marker(
    kind: int,
    number: int = 0,
    *,
    ns: str = "",
    frame_id: str = "camera",
    at: Any = (0, 0, 0),
    turn: Any = (0, 0, 0, 0),
    points: Any = (),
    alpha: Any = 1.0,
) -> Any:
    zero = make("builtin_interfaces/msg/Duration", 0, 0)
    alphas = np.broadcast_to(alpha, max(len(points), 1))
    colors = [make("std_msgs/msg/ColorRGBA", 0.0, 0.0, 0.0, float(a)) for a in alphas]
    texture = make("sensor_msgs/msg/CompressedImage", header(0, ""), "", np.zeros(0, np.uint8))
    mesh = make("visualization_msgs/msg/MeshFile", "", np.zeros(0, np.uint8))
    scale = make("geometry_msgs/msg/Vector3", 0.1, 0.1, 0.1)
    spots = [point(xyz) for xyz in points]
    return make(
        "visualization_msgs/msg/Marker", header(7, frame_id), ns, number, kind, 0, pose(at, turn), scale,
        colors[0], zero, False, spots, colors if len(points) else [], "", texture, [], "", "", mesh, False,
    )  # fmt: skip


def marker_array(*markers: Any) -> bytes:
    return serialise(make(MARKERS, list(markers)), MARKERS)


@settings(max_examples=15)
@given(numbers, st.integers(0, 2**31 * 10**9 - 1))
def test_poses(points: Any, stamp_ns: int) -> None:
    (person, seen), *others = decode_keypoints("keypoint_poses", pose_array(points, stamp_ns), K).items()
    assert (person, others, seen.stamp_ns, seen.frame_id) == ("", [], stamp_ns, "camera")
    np.testing.assert_array_equal(seen.points, points)
    assert (seen.confidence == 1).all()


@settings(max_examples=8)
@given(numbers, numbers, hnp.arrays(np.float32, K, elements=st.floats(0, 1, width=32)))
def test_markers(one: Any, two: Any, alpha: Any) -> None:
    lines = marker(5, 1, ns="bones", points=one[:2])
    lists = marker_array(lines, marker(7, 0, ns="ann", points=one, alpha=alpha), marker(8, 0, ns="bob", points=two))
    spheres = [
        marker(2, 100 * p + i, at=xyz, alpha=alpha[i]) for p, x in ((0, one), (4, two)) for i, xyz in enumerate(x)
    ]
    for data, names in ((lists, ["ann", "bob"]), (marker_array(lines, *spheres[::-1]), ["person_4", ""])):
        found = decode_keypoints("keypoint_markers", data, K)
        assert sorted(found) == sorted(names)
        for name, points in zip(sorted(names), (one, two), strict=True):
            np.testing.assert_array_equal(found[name].points, points)
        np.testing.assert_array_equal(found[sorted(names)[0]].confidence, alpha)


def test_points_of_a_list_are_placed_by_its_pose() -> None:
    """A quarter turn about z, by hand; what isn't seen stays so, and a rotation may be of any length."""
    points = np.arange(3.0 * K).reshape(K, 3) * (np.arange(K) > 0)[:, None]
    for turn, placed in (((0, 0, 2, 2), points[:, [1, 0, 2]] * [-1, 1, 1]), ((0, 0, 0, 0), points)):
        data = marker_array(marker(7, points=points, at=(2, 0, 1), turn=turn))
        (seen,) = decode_keypoints("keypoint_markers", data, K).values()
        assert np.isnan(seen.points[0]).all()
        np.testing.assert_allclose(seen.points[1:], placed[1:] + np.array([2, 0, 1]), atol=1e-13)
    odd = marker_array(marker(7, points=points, at=(np.inf, 0, 0), turn=(np.nan, np.inf, 0, 1e-320)))
    assert not np.isfinite(decode_keypoints("keypoint_markers", odd, K)[""].points).all(axis=1).any()


def test_different_people_have_different_names() -> None:
    written = ["ann", "王", "李", "a/1", "a_1", "x" * 80, "x" * 81]
    lists = [marker(7, 0, ns=name, points=np.ones((K, 3))) for name in written]
    found = decode_keypoints("keypoint_markers", marker_array(*lists), K)
    assert len(found) == len(written)
    assert "ann" in found
    assert all(re.fullmatch("[A-Za-z][A-Za-z0-9_]*", name) for name in found)


def test_what_is_not_seen_is_nan() -> None:
    points = np.ones((K, 3))
    points[3] = 0
    points[4, 1] = np.nan
    (seen,) = decode_keypoints("keypoint_poses", pose_array(points), K).values()
    np.testing.assert_array_equal(np.isnan(seen.points).any(axis=1), [i in (3, 4) for i in range(K)])
    (seen,) = decode_keypoints("keypoint_markers", marker_array(marker(2, 5, at=(1, 2, 3))), K).values()
    assert np.isfinite(seen.points).all(axis=1).tolist() == [i == 5 for i in range(K)]
    assert decode_keypoints("keypoint_poses", pose_array([]), K) == {}
    assert decode_keypoints("keypoint_markers", marker_array(), K) == {}


@pytest.mark.parametrize(
    ("kind", "data", "said"),
    [
        ("keypoint_poses", pose_array(np.ones((33, 3))), "wanted 17 poses, .* got 33; set keypoints"),
        ("keypoint_markers", marker_array(marker(7, points=np.ones((38, 3)))), "wanted 17 points, .* got 38"),
        ("keypoint_markers", marker_array(marker(2, 118)), "is keypoint 18, wanted 0 to 16"),
        ("keypoint_markers", marker_array(marker(5, points=np.ones((4, 3)))), "1 markers, none of them keypoints"),
        ("keypoint_poses", pose_array(np.ones((K, 3)))[:-9], "geometry_msgs/msg/PoseArray: "),
    ],
)
def test_what_is_refused(kind: str, data: bytes, said: str) -> None:
    with pytest.raises(DecodeError, match=said):
        decode_keypoints(kind, data, K)


@settings(max_examples=15)
@given(st.text(max_size=80), st.integers(-(2**31), 2**31 - 2))
def test_names_do_for_topics(namespace: str, number: int) -> None:
    people = [marker(7, number + i, ns=namespace.replace("\0", ""), points=np.ones((K, 3))) for i in range(2)]
    for count in (1, 2):
        try:
            names = [*decode_keypoints("keypoint_markers", marker_array(*people[:count]), K)]
        except UnicodeEncodeError:
            return
        assert len(names) == count
        assert all(name == "" or (name.isidentifier() and name.isascii() and name[0] != "_") for name in names)


def standing(layout: str, place: float = 0.0) -> Any:
    bones = Skeleton(keypoint_layout(layout), Proportions.builtin("male"))
    turns = np.zeros((24, 3))
    turns[16, 2], turns[17, 2] = -1.0, 1.0
    return bones.posed(Pose(np.array([place, 1.0, 0.0]), exp_so3(turns), np.zeros(10))).points


def test_a_stream_takes_the_names_that_decoders_take() -> None:
    for name in ("multiarray", "std_msgs/Float32MultiArray", "std_msgs/msg/Float32MultiArray"):
        assert InputStream(name).message_type == "std_msgs/msg/Float32MultiArray"
    assert InputStream("keypoint_markers").message_type == "visualization_msgs/msg/MarkerArray"
    with pytest.raises(DecodeError, match="wanted an input type, got 'nothing'"):
        InputStream("nothing")


def test_a_message_of_more_people_than_are_followed_is_refused() -> None:
    stream = InputStream("keypoint_markers")
    stream.follow(load_body("male"), "coco17")
    data = marker_array(*(marker(7, ns=f"p{i}", points=standing("coco17", i)) for i in range(65)))
    with pytest.raises(DecodeError, match="65 people in a message; up to 64"):
        stream.frames(data, 5)


def test_streams_and_bags(tmp_path: Path) -> None:
    stream = InputStream("keypoint_markers")
    stream.follow(load_body("male"), "coco17")
    people = ("a", "camera", 0.0), ("b", "lidar", 2.0)
    data = marker_array(*(marker(7, ns=ns, frame_id=at, points=standing("coco17", x)) for ns, at, x in people))
    frames, frame_ids = stream.frames(data, 5, sender="left")
    assert sorted(frames) == ["left_a", "left_b"]
    assert frame_ids == {"left_a": "camera", "left_b": "lidar"}
    assert frames["left_b"].transl[0] - frames["left_a"].transl[0] == pytest.approx(2, abs=1e-6)
    assert sorted(stream.predicted(10**8)) == ["left_a", "left_b"]
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/skeletons", POSES)
        for i in range(3):
            stamp = 10**9 + i * 33_000_000
            writer.write("/skeletons", pose_array(standing("coco17"), stamp), log_time_ns=stamp)
    records = list(open_smpl_bag(tmp_path / "a.mcap", input_type="keypoint_poses"))
    assert [record.stamp_ns for record in records] == [10**9, 1_033_000_000, 1_066_000_000]
    assert all(record.frame is None and record.error is None for record in records)


def test_no_two_people_of_a_message_have_one_name() -> None:
    """Of `1a` and `person_1a` only one was dressed."""
    spaces = ["1a", "person_1a", "1", "person_1"]
    places = np.ones((len(spaces), K, 3)) * np.arange(1, 5)[:, None, None]
    lists = [marker(7, ns=ns, points=spots) for ns, spots in zip(spaces, places, strict=True)]
    sphere = marker(2, number=100, at=(9, 9, 9))  # the driver of Azure Kinect would call this person_1, too
    named = [
        {name: seen.points[0, 0] for name, seen in decode_keypoints("keypoint_markers", sent, K).items()}
        for sent in (marker_array(*lists, sphere), marker_array(sphere, *lists[::-1]))
    ]
    assert named[0] == named[1], "whose marker comes first changes no name"
    assert sorted(named[0].values()) == [1, 2, 3, 4, 9]
    assert (named[0]["person_1a"], named[0]["person_1"]) == (2, 4), "who is called so keeps the name"
    assert decode_keypoints("keypoint_markers", marker_array(lists[0]), K).keys() == {"person_1a"}
