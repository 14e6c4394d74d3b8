"""ROS4HRI's joint angles on an SMPL skeleton, against the forward kinematics of its URDF."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from reference import header, make, serialise
from scipy.spatial.transform import Rotation

from msg_adapters import INPUT_TYPES, DecodeError, decoder_for, frame_id_of, vertices_ros_from_smpl
from refu_core.body import BUILTIN_BODIES, SmplBody, load_body
from refu_core.skeleton import JOINT_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

JOINT_STATE = INPUT_TYPES["joint_state"]
UNIT = 1.65 / 7.5  # a person of 1.65 m is seven heads and a half

# What the URDF of human_description says: joint, parent joint, place in the parent [heads], axis; None is fixed.
URDF: list[tuple[str, str, tuple[float, float, float], tuple[int, int, int] | None]] = [
    ("waist", "body", (0, 0, 0), (0, 1, 0)),
    ("torso", "waist", (0, 0, 2.75), None),
    ("r_head", "torso", (0, 0, 0.25), (1, 0, 0)),
    ("y_head", "r_head", (0, 0, 0), (0, 0, 1)),
    ("p_head", "y_head", (0, 0, 0), (0, -1, 0)),
]
for side, sign in (("l", 1), ("r", -1)):
    URDF += [
        (f"{side}_y_shoulder", "torso", (0, sign * 0.8, 0), (0, 0, -sign)),
        (f"{side}_p_shoulder", f"{side}_y_shoulder", (0, 0, 0), (sign, 0, 0)),
        (f"{side}_r_shoulder", f"{side}_p_shoulder", (0, 0, 0), (0, 0, sign)),
        (f"{side}_elbow", f"{side}_r_shoulder", (0, 0, -1.6), (0, -1, 0)),
        (f"{side}_wrist", f"{side}_elbow", (0, 0, -1), None),
        (f"{side}_y_hip", "body", (0, sign * 0.6, 0), (0, 0, -1)),
        (f"{side}_p_hip", f"{side}_y_hip", (0, 0, 0), (sign, 0, 0)),
        (f"{side}_r_hip", f"{side}_p_hip", (0, 0, 0), (0, -1, 0)),
        (f"{side}_knee", f"{side}_r_hip", (0, 0, -1.5), (0, -1, 0)),
        (f"{side}_ankle", f"{side}_knee", (0, 0, -2), None),
    ]
JOINTS = [joint for joint, _, _, axis in URDF if axis is not None]
LEGS = {"hip": "r_hip", "knee": "knee", "ankle": "knee", "foot": "knee"}
angles_of_joints = hnp.arrays(np.float64, len(JOINTS), elements=st.floats(-3.3, 3.3))


def links(angles: Any) -> dict[str, tuple[Rotation, NDArray[np.float64]]]:
    """Orientation and position [m] of the link behind each joint, in the frame body_<id>."""
    given = dict(zip(JOINTS, angles, strict=True))
    placed = {"body": (Rotation.identity(), np.zeros(3))}
    for joint, parent, place, axis in URDF:
        turn, origin = placed[parent]
        own = Rotation.from_rotvec(given[joint] * np.array(axis)) if axis else Rotation.identity()
        placed[joint] = turn * own, origin + turn.apply(UNIT * np.array(place))
    return placed


def joint_state(entries: Any) -> bytes:
    names, values = zip(*entries, strict=True)
    empty = np.zeros(0)
    return serialise(make(JOINT_STATE, header(5), list(names), np.array(values), empty, empty), JOINT_STATE)


def entries_of(angles: Any, body: str = "jdkah") -> list[tuple[str, float]]:
    return [(f"{joint}_{body}", float(angle)) for joint, angle in zip(JOINTS, angles, strict=True)]


@cache
def smpl_body(name: str) -> SmplBody:
    return load_body(name)


def posed(angles: Any, body: str = "neutral") -> tuple[dict[str, Rotation], dict[str, NDArray[np.float64]]]:
    """World rotation and position [m] of each SMPL joint in ROS axes."""
    frame = decoder_for("joint_state").from_bytes(joint_state(entries_of(angles)))
    output = smpl_body(body)(frame.pose[None], transl=frame.transl[None].astype(np.float32))
    to_ros = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    turns = Rotation.from_matrix(output.transforms.rotation[0].numpy())
    places = vertices_ros_from_smpl(output.joints[0].numpy())
    return (
        {name: to_ros * turns[i] * to_ros.inv() for i, name in enumerate(JOINT_NAMES)},
        dict(zip(JOINT_NAMES, places, strict=True)),
    )


def angle(one: Any, other: Any) -> float:
    """Between two directions [degrees]."""
    cosine = np.dot(one, other) / np.linalg.norm(one) / np.linalg.norm(other)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@given(angles_of_joints, st.sampled_from(BUILTIN_BODIES))
def test_limbs_point_where_the_urdf_has_them(angles: Any, body: str) -> None:
    """Arms exactly; legs as far as the body's own stance at rest is off the vertical."""
    human, (_, places) = links(angles), posed(angles, body)
    for side, smpl in (("l", "left"), ("r", "right")):
        for urdf_bone, smpl_bone, tolerance in (
            (("r_shoulder", "elbow"), ("shoulder", "elbow"), 0.2),
            (("elbow", "wrist"), ("elbow", "wrist"), 0.2),
            (("r_hip", "knee"), ("hip", "knee"), 4.2),
            (("knee", "ankle"), ("knee", "ankle"), 3.6),
        ):
            start, end = (human[f"{side}_{name}"][1] for name in urdf_bone)
            ours = places[f"{smpl}_{smpl_bone[1]}"] - places[f"{smpl}_{smpl_bone[0]}"]
            assert angle(end - start, ours) < tolerance, (side, smpl_bone)


@given(angles_of_joints)
def test_trunk_head_and_legs_turn_as_the_urdf_does(angles: Any) -> None:
    """Which says what directions don't: the twist."""
    human, (turns, places) = links(angles), posed(angles)
    pairs = {"spine3": "torso", "left_collar": "torso", "head": "p_head", "pelvis": "body"}
    pairs |= {f"{smpl}_{a}": f"{side}_{b}" for side, smpl in (("l", "left"), ("r", "right")) for a, b in LEGS.items()}
    for smpl, urdf in pairs.items():
        assert np.degrees((turns[smpl].inv() * human[urdf][0]).magnitude()) < 0.1, smpl
    assert np.linalg.norm(places["pelvis"]) < 0.005  # in the origin of body_<id>


@given(angles_of_joints)
def test_forearms_turn_as_the_urdf_does(angles: Any) -> None:
    """SMPL's arms are lowered from the T-pose, by a quarter turn about the axis that looks forward."""
    human, (turns, _) = links(angles), posed(angles)
    for side, smpl, lowered in (("l", "left", np.pi / 2), ("r", "right", -np.pi / 2)):
        rest = Rotation.from_rotvec([lowered, 0, 0])
        for a, b in (("shoulder", "r_shoulder"), ("elbow", "elbow"), ("hand", "elbow")):
            wanted = human[f"{side}_{b}"][0] * rest.inv()
            assert np.degrees((turns[f"{smpl}_{a}"].inv() * wanted).magnitude()) < 0.1, (smpl, a)


def test_a_person_at_rest_stands_with_hanging_arms() -> None:
    """Said without the URDF, so that one mistake can't be in both: x forward, y left, z up."""
    _, at = posed(np.zeros(20))
    assert at["head"][2] > at["left_shoulder"][2] > at["left_elbow"][2] > at["left_wrist"][2] > at["left_ankle"][2]
    assert at["left_wrist"][1] > at["pelvis"][1] > at["right_wrist"][1]
    for joint, moved, axis in (("l_elbow", "left_wrist", 0), ("r_elbow", "right_wrist", 0), ("waist", "head", 0)):
        bent = posed(np.eye(20)[JOINTS.index(joint)])[1]
        assert bent[moved][axis] > at[moved][axis] + 0.1, joint  # forward
    assert posed(-np.eye(20)[JOINTS.index("l_knee")])[1]["left_ankle"][0] < at["left_ankle"][0] - 0.1  # backward
    for side, smpl, outward in (("l", "left", 1), ("r", "right", -1)):
        for joint, end in (("p_shoulder", "wrist"), ("p_hip", "ankle")):
            spread = posed(np.eye(20)[JOINTS.index(f"{side}_{joint}")])[1]
            assert outward * (spread[f"{smpl}_{end}"] - at[f"{smpl}_{end}"])[1] > 0.1, (side, joint)


@given(st.permutations([*entries_of(np.arange(20) / 10), ("jaw_jdkah", 9.0)]))
def test_joints_in_any_order(entries: Any) -> None:
    decode = decoder_for("joint_state").from_bytes
    frame, expected = decode(joint_state(entries)), decode(joint_state(entries_of(np.arange(20) / 10)))
    np.testing.assert_array_equal(frame.pose, expected.pose)
    assert frame.stamp_ns == 5
    assert not frame.betas.any()


REST = entries_of(np.zeros(20))


@given(st.permutations([*REST, ("jaw_jdkah", 9.0)]))
def test_a_body_is_in_its_own_frame(entries: Any) -> None:
    assert frame_id_of(joint_state(entries), "joint_state") == "body_jdkah"
    smpl = [(f"{joint}_{axis}", 0.1) for joint in JOINT_NAMES for axis in "xyz"]
    assert frame_id_of(joint_state([*smpl, *entries]), "joint_state") == "map"
    assert frame_id_of(joint_state([*entries, *smpl]), "joint_state") == "map"


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (REST[:-2], "2 of 20 names are missing: r_r_hip_jdkah, r_knee_jdkah; wanted the 20 joints of ROS4HRI"),
        (REST[1:], "72 of 72 names are missing: pelvis_x.*or ROS4HRI's waist_<id>"),
        ([*REST, REST[3]], "the name p_head_jdkah occurs twice"),
        ([*REST, *entries_of(np.zeros(20), "other")], "of one body, got 2 names that begin with waist_"),
        ([*REST[:-1], ("r_knee_other", 0.0)], "1 of 20 names are missing: r_knee_jdkah"),
        ([*REST[:-1], ("r_knee_jdkah", np.nan)], "r_knee has the angle nan, wanted radians"),
        ([*REST[:-1], ("r_knee_jdkah", -1e300)], r"r_knee has the angle -1e\+300, wanted radians"),
    ],
)
def test_bodies_that_are_refused(entries: Any, message: str) -> None:
    with pytest.raises(DecodeError, match=message):
        decoder_for("joint_state").from_bytes(joint_state(entries))


def test_smpl_names_keep_their_meaning() -> None:
    """A message with SMPL's joints is read as such, whatever else is in it."""
    entries = [(f"{joint}_{axis}", 0.1) for joint in JOINT_NAMES for axis in "xyz"]
    frame = decoder_for("joint_state").from_bytes(joint_state([*entries, *REST]))
    np.testing.assert_array_equal(frame.pose, np.full((24, 3), 0.1, np.float32))
