"""Every input type: bytes and objects, both byte orders, layouts that are wrong, and bytes that are hostile."""

from __future__ import annotations

import random
import struct
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import SMPL_MSG, deserialise, frames, header, input_types, make, serialise, texts, typestore
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from msg_adapters import (
    INPUT_TYPES,
    DecodeError,
    EncodeError,
    decode_ids,
    decode_marker_array,
    decoder_for,
    encoder_for,
    message_definition,
)
from msg_adapters.cdr import MOST_ITEMS, CdrReader, CdrWriter
from msg_adapters.transforms import decode_transforms
from refu_core import SmplFrame
from refu_core.skeleton import JOINT_NAMES

MULTIARRAY, JOINT_STATE, POSE_ARRAY, SMPL = INPUT_TYPES.values()
REST = SmplFrame(np.zeros(72))


def as_sent(frame: SmplFrame, input_type: str) -> SmplFrame:
    """What of a frame an input type carries."""
    if input_type == "multiarray":
        return replace(frame, transl=frame.transl.astype(np.float32), stamp_ns=0)
    return replace(frame, betas=np.zeros(10)) if input_type == "pose_array" else frame


def assert_same_rotations(one: Any, other: Any) -> None:
    """Rotation vectors, shape (24, 3), may differ by full turns."""
    q, r = (Rotation.from_rotvec(vectors).as_quat() for vectors in (one, other))
    np.testing.assert_allclose(q * np.sign(np.sum(q * r, axis=-1, keepdims=True)), r, rtol=0, atol=1e-6)


def assert_same(one: SmplFrame, other: SmplFrame, *, same_vectors: bool = True) -> None:
    (np.testing.assert_array_equal if same_vectors else assert_same_rotations)(one.pose, other.pose)
    np.testing.assert_array_equal(one.betas, other.betas)
    np.testing.assert_array_equal(one.transl, other.transl)
    assert one.stamp_ns == other.stamp_ns


@given(input_types, frames(), texts)
def test_encoders_write_what_the_reference_writes(input_type: str, frame: SmplFrame, frame_id: str) -> None:
    data = encoder_for(input_type)(frame, frame_id=frame_id)
    message = deserialise(data, INPUT_TYPES[input_type])
    assert serialise(message, INPUT_TYPES[input_type]) == data
    if input_type != "multiarray":
        assert message.header.frame_id == frame_id


@given(input_types, frames())
def test_round_trip(input_type: str, frame: SmplFrame) -> None:
    decoded = decoder_for(input_type).from_bytes(encoder_for(input_type)(frame))
    assert_same(decoded, as_sent(frame, input_type), same_vectors=input_type != "pose_array")


@given(input_types, frames(), st.booleans(), st.integers(0, 15))
def test_either_byte_order_and_padding(input_type: str, frame: SmplFrame, little_endian: bool, padding: int) -> None:
    message_type, sent = INPUT_TYPES[input_type], encoder_for(input_type)(frame)
    data = serialise(deserialise(sent, message_type), message_type, little_endian=little_endian)
    decode = decoder_for(message_type).from_bytes
    assert_same(decode(data + bytes(padding)), decode(sent))
    with pytest.raises(DecodeError, match="another type"):
        decode(data + bytes(16))


def test_decoders_by_any_name() -> None:
    for input_type, message_type in INPUT_TYPES.items():
        for name in (input_type, message_type, message_type.replace("/msg/", "/")):
            assert decoder_for(name).input_type == input_type
    with pytest.raises(DecodeError, match=r"got 'image'; there are multiarray"):
        decoder_for("image")


# ------------------------------------------------------------------------------------------------ Float32MultiArray


def multiarray(dims: list[tuple[str, int, int]], data: Any, offset: int = 0) -> bytes:
    dimensions = [make("std_msgs/msg/MultiArrayDimension", *dim) for dim in dims]
    layout = make("std_msgs/msg/MultiArrayLayout", dimensions, offset)
    return serialise(make(MULTIARRAY, layout, np.asarray(data, np.float32)), MULTIARRAY)


@given(st.permutations(["pose", "betas", "transl"]), st.integers(1, 3), st.integers(0, 5), st.integers(0, 4))
def test_multiarray_blocks_in_any_order_with_gaps(order: list[str], count: int, offset: int, gap: int) -> None:
    kept = [label for label in order if label == "pose" or order.index(label) < count]
    values = {"pose": np.arange(72) / 100, "betas": np.arange(10) / 10, "transl": np.arange(3) + 1.5}
    parts = [np.full(offset, 9e9)]
    for label in kept:
        parts += [values[label], np.full(gap, 9e9)]
    dims = [(label, len(values[label]), len(values[label]) + gap if gap else 0) for label in kept]
    frame = decoder_for("multiarray").from_bytes(multiarray(dims, np.concatenate(parts), offset))
    np.testing.assert_array_equal(frame.pose.ravel(), values["pose"].astype(np.float32))
    for label in ("betas", "transl"):
        expected = values[label] if label in kept else np.zeros(len(values[label]))
        np.testing.assert_array_equal(getattr(frame, label), expected.astype(np.float32))


@pytest.mark.parametrize(
    ("dims", "count", "message"),
    [
        ([], 92, "the layout of 92 numbers isn't declared; label layout.dim pose"),
        ([("pose", 72, 72), ("shape", 10, 10)], 82, "unexpected label 'shape'"),
        ([("pose", 72, 72), ("pose", 72, 72)], 144, "unexpected second 'pose'"),
        ([("pose", 69, 69)], 69, r"pose must have .* \(72,\), got \(69,\): 23 joints without the root: put its"),
        ([("pose", 165, 0)], 165, r"got \(165,\): SMPL-X: take the first 66, and append 6 zeros"),
        ([("pose", 72, 0), ("betas", 300, 0)], 372, r"betas must .*, got \(300,\): take the first 10"),
        ([("pose", 165, 0)], 72, "declares 165 numbers, the data has 72"),
        ([("pose", 72, 71)], 72, "stride of pose must be 0 or at least its size 72, got 71"),
        ([("pose", 72, 72)], 85, "declares 72 numbers, the data has 85"),
        ([("pose", 72, 72), ("betas", 10, 10)], 72, "declares 82 numbers, the data has 72"),
        ([("betas", 10, 10)], 10, "declares betas but no pose"),
        ([("pose", 72, 72)] * 17, 72, "17 dimensions"),
    ],
)
def test_multiarray_layouts_that_are_refused(dims: list[tuple[str, int, int]], count: int, message: str) -> None:
    with pytest.raises(DecodeError, match=message):
        decoder_for("multiarray").from_bytes(multiarray(dims, np.zeros(count)))


# ------------------------------------------------------------------------------------------------ JointState


def joint_state(entries: dict[str, float] | list[tuple[str, float]], extra_positions: int = 0) -> bytes:
    pairs = list(entries.items() if isinstance(entries, dict) else entries)
    position = np.array([value for _, value in pairs] + [0.0] * extra_positions)
    empty = np.zeros(0)
    return serialise(make(JOINT_STATE, header(5), [name for name, _ in pairs], position, empty, empty), JOINT_STATE)


JOINTS = {f"{joint}_{axis}": 0.01 * i for i, (joint, axis) in enumerate((j, a) for j in JOINT_NAMES for a in "xyz")}
TRANSL = {"transl_x": 1.0, "transl_y": 2.0, "transl_z": 3.0}


@given(st.permutations(list((JOINTS | TRANSL | {"beta_3": -1.5, "jaw_x": 7.0}).items())))
def test_joint_state_in_any_order(entries: list[tuple[str, float]]) -> None:
    frame = decoder_for("joint_state").from_bytes(joint_state(entries))
    np.testing.assert_allclose(frame.pose.ravel(), np.arange(72) * 0.01, rtol=1e-6)
    np.testing.assert_array_equal(frame.betas, np.eye(10)[3] * -1.5)
    np.testing.assert_array_equal(frame.transl, [1, 2, 3])
    assert frame.stamp_ns == 5


@pytest.mark.parametrize(
    ("entries", "extra", "message"),
    [
        ({k: v for k, v in JOINTS.items() if not k.startswith("head")}, 0, "3 of 72 names are missing: head_x, head_y"),
        ({"panda_joint1": 0.0}, 0, "72 of 72 names are missing: pelvis_x.* and 66 more"),
        ([*JOINTS.items(), ("head_x", 1.0)], 0, "the name head_x occurs twice"),
        (JOINTS, 1, "72 names but 73 positions"),
        (JOINTS | {"betas_0": 1.0}, 0, "unknown name 'betas_0'"),
        (JOINTS | {"transl_x": 1.0}, 0, "1 of transl_x, transl_y, transl_z"),
        (JOINTS | {"left_hip_x": np.inf}, 0, "pose has 1 value that is NaN or infinite"),
        (JOINTS | {"left_hip_x": 1e300}, 0, "beyond the range of float32"),
    ],
)
def test_joint_states_that_are_refused(entries: Any, extra: int, message: str) -> None:
    with pytest.raises(DecodeError, match=message) as caught:
        decoder_for("joint_state").from_bytes(joint_state(entries, extra))
    assert str(caught.value).startswith(JOINT_STATE)


@given(st.lists(st.permutations(list((JOINTS | TRANSL).items())), min_size=1, max_size=2), st.data())
def test_names_are_remembered_without_mixing_up_senders(senders: list[list[tuple[str, float]]], data: Any) -> None:
    """Names that are sent again aren't read again; what is decoded must not depend on who sent before."""
    for _ in range(6):
        entries = list(data.draw(st.sampled_from(senders)))
        kind = data.draw(st.sampled_from(["good", "renamed", "too many", "big-endian"]))
        if kind == "renamed":
            entries[data.draw(st.integers(0, len(entries) - 1))] = ("jaw_x", 0.0)
        raw = joint_state(entries, extra_positions=kind == "too many")
        if kind == "big-endian":
            raw = big_endian_joint_state(entries)
        decode = decoder_for("joint_state").from_bytes
        if kind in ("good", "big-endian"):
            frame = decode(raw)
            np.testing.assert_allclose(frame.pose.ravel(), np.arange(72) * 0.01, rtol=1e-6)
            np.testing.assert_array_equal(frame.transl, [1, 2, 3])
            continue
        with pytest.raises(DecodeError, match=r"are missing|all three or none|75 names but 76 positions"):
            decode(raw)


def big_endian_joint_state(entries: list[tuple[str, float]]) -> bytes:
    out = bytearray(struct.pack(">iI", 0, 5) + struct.pack(">I", 1) + b"\0")
    out += bytes(-len(out) % 4) + struct.pack(">I", len(entries))
    for name, _ in entries:
        out += bytes(-len(out) % 4) + struct.pack(">I", len(name) + 1) + name.encode() + b"\0"
    out += bytes(-len(out) % 4) + struct.pack(">I", len(entries))
    out += bytes(-len(out) % 8) + np.array([value for _, value in entries], ">f8").tobytes()
    return bytes([0, 0, 0, 0]) + bytes(out) + struct.pack(">II", 0, 0)


# ------------------------------------------------------------------------------------------------ PoseArray


def pose_array(quaternions: Any, position: Any = (0, 0, 0)) -> bytes:
    poses = [
        make(
            "geometry_msgs/msg/Pose",
            make("geometry_msgs/msg/Point", *position),
            make("geometry_msgs/msg/Quaternion", *q),
        )
        for q in np.asarray(quaternions, np.float64).tolist()
    ]
    return serialise(make(POSE_ARRAY, header(), poses), POSE_ARRAY)


@given(st.floats(1e-3, 1e100), st.booleans())
def test_quaternions_are_normalised_and_have_no_sign(scale: float, flip: bool) -> None:
    rotvec = np.random.default_rng(3).normal(size=(24, 3))
    quaternions = Rotation.from_rotvec(rotvec).as_quat() * scale * (-1 if flip else 1)
    frame = decoder_for("pose_array").from_bytes(pose_array(quaternions, (1e5, -2, 0.1)))
    assert_same_rotations(frame.pose, rotvec)
    np.testing.assert_array_equal(frame.transl, [1e5, -2, 0.1])


@pytest.mark.parametrize("bad", [(0, 0, 0, 0), (0, np.nan, 0, 1), (np.inf, 0, 0, 1)])
def test_orientations_that_are_no_rotation(bad: tuple[float, ...]) -> None:
    quaternions = np.tile([0.0, 0, 0, 1], (24, 1))
    quaternions[4] = bad
    with pytest.raises(DecodeError, match="the orientation of left_knee isn't a rotation"):
        decoder_for("pose_array").from_bytes(pose_array(quaternions))


@pytest.mark.parametrize("count", [0, 23, 25])
def test_pose_arrays_of_other_lengths(count: int) -> None:
    data = pose_array(np.tile([0.0, 0, 0, 1], (count, 1)))
    with pytest.raises(DecodeError, match=f"wanted 24 poses, one for each joint of SMPL, got {count}"):
        decoder_for("pose_array").from_bytes(data)


@given(st.floats(0, np.pi), st.floats(-1, 1), st.floats(-1, 1))
def test_rotation_vectors_survive_quaternions(angle: float, x: float, y: float) -> None:
    axis = np.array([x, y, 1.0]) / np.linalg.norm([x, y, 1.0])
    pose = np.zeros((24, 3))
    pose[5] = angle * axis
    back = decoder_for("pose_array").from_bytes(encoder_for("pose_array")(SmplFrame(pose))).pose[5]
    # At exactly pi both signs are the same rotation.
    assert min(np.abs(back - angle * axis).max(), np.abs(back + angle * axis).max() + (angle < 3.1415)) < 1e-6


# ------------------------------------------------------------------------------------------------ smpl_msgs/Smpl


@given(frames(), st.permutations(SMPL_MSG.strip().splitlines()[1:]), st.sampled_from(["float32", "float64"]))
def test_smpl_is_read_by_the_definition_it_came_with(frame: SmplFrame, fields: list[str], kind: str) -> None:
    fields = [field.replace("float64", kind) for field in fields]
    definition = "\n".join(["# made up", "std_msgs/Header header  # stamp", *fields, "=" * 80, "MSG: std_msgs/Header"])
    writer = CdrWriter()
    writer.fields("Ts", frame.stamp_ns, "map")
    values = {"body_pose": frame.pose[1:], "global_orient": frame.pose[0], "betas": frame.betas, "transl": frame.transl}
    for field in fields:
        writer.array({"float32": "f4", "float64": "f8"}[kind], values.get(field.split()[1], np.zeros(72)))
    decoded = decoder_for("smpl_msgs", definition=definition).from_bytes(writer.to_bytes())
    assert_same(decoded, frame if kind == "float64" else replace(frame, transl=frame.transl.astype(np.float32)))


@pytest.mark.parametrize(
    ("definition", "message"),
    [
        ("float64[69] body_pose", "starts with 'std_msgs/Header header'"),
        ("std_msgs/Header header\nfloat64[] body_pose", r"got 'float64\[\] body_pose'"),
        (
            "std_msgs/Header header\nfloat64[63] body_pose",
            r"wanted global_orient\[3\] in the definition, got no such field",
        ),
    ],
)
def test_smpl_definitions_that_are_refused(definition: str, message: str) -> None:
    with pytest.raises(DecodeError, match=message):
        decoder_for("smpl_msgs", definition=definition)


@pytest.mark.parametrize(
    "message_type", [*INPUT_TYPES.values(), "visualization_msgs/MarkerArray", "diagnostic_msgs/DiagnosticArray"]
)
def test_definitions_are_those_of_jazzy(message_type: str) -> None:
    definition = message_definition(message_type)
    full_name = message_type if "/msg/" in message_type else message_type.replace("/", "/msg/")
    ours = get_types_from_msg(definition.text, full_name)
    for name, fields in ours.items():
        assert fields == typestore().fielddefs[name]
    assert definition.type_hash == typestore().hash_rihs01(full_name)


# ------------------------------------------------------------------------------------------------ hostile input


def damaged(whole: bytes, rng: random.Random) -> bytes:
    """A message with something cut off, overwritten or put in, once or several times."""
    data = bytearray(whole)
    for _ in range(rng.randint(1, 4)):
        at = rng.randint(0, len(data))
        kind = rng.choice(("cut", "bytes", "length", "double", "insert"))
        if kind == "cut":
            del data[at:]
        elif kind == "insert":
            data[at:at] = rng.randbytes(rng.randint(1, 9))
        else:
            new = {
                "bytes": rng.randbytes(rng.randint(1, 8)),
                "length": struct.pack("<I", rng.choice((0, 1, 71, 73, 2**16, 2**31 - 1, 2**32 - 1))),
                "double": struct.pack("<d", rng.choice((np.nan, np.inf, -1e308, 5e-324))),
            }[kind]
            at -= at % 4
            data[at : at + len(new)] = new
    return bytes(data)


def assert_frame_or_decode_error(input_type: str, data: bytes) -> None:
    try:
        frame = decoder_for(input_type).from_bytes(data)
    except DecodeError:
        return
    assert np.isfinite(frame.pose).all()


@pytest.mark.parametrize("input_type", INPUT_TYPES)
def test_damaged_messages(input_type: str) -> None:
    """Thousands: Hypothesis, which looks for the shortest of them, does so in tests/fuzz, at thirty times the cost."""
    whole, rng = encoder_for(input_type)(REST, frame_id="map"), random.Random(0)
    for _ in range(2500):
        assert_frame_or_decode_error(input_type, damaged(whole, rng))


@settings(max_examples=500)
@given(input_types, st.binary(max_size=200), st.sampled_from([b"", b"\0\1\0\0", b"\0\0\0\0"]))
def test_random_bytes(input_type: str, data: bytes, start: bytes) -> None:
    assert_frame_or_decode_error(input_type, start + data)


@pytest.mark.parametrize("input_type", INPUT_TYPES)
def test_every_truncation(input_type: str) -> None:
    data = encoder_for(input_type)(REST)
    for length in range(len(data)):
        with pytest.raises(DecodeError):
            decoder_for(input_type).from_bytes(data[:length])


def test_absurd_lengths_allocate_nothing() -> None:
    claims = struct.pack("<4sIII", b"\0\1\0\0", 2**32 - 1, 2**32 - 1, 2**32 - 1)
    tracemalloc.start()
    for input_type in INPUT_TYPES:
        with pytest.raises(DecodeError, match=r"claims|wanted|more bytes"):
            decoder_for(input_type).from_bytes(claims + bytes(64))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize(
    "decode",
    [decoder_for("joint_state").from_bytes, decode_ids, decode_transforms, decode_marker_array],
    ids=["joint_state", "ids", "transforms", "markers"],
)
def test_what_is_read_one_by_one_is_of_bounded_length(decode: Any) -> None:
    """Ten megabytes of it took up to seven seconds."""
    head = b"" if decode in (decode_transforms, decode_marker_array) else bytes(12)
    count = struct.pack("<I", MOST_ITEMS + 1)
    with pytest.raises(DecodeError, match=f"wanted up to {MOST_ITEMS} items"):
        decode(b"\0\1\0\0" + head + count + bytes(200 * MOST_ITEMS))


def test_strings_must_be_utf8_and_end() -> None:
    good = CdrWriter()
    good.fields("s", "é")
    assert CdrReader(good.to_bytes()).string() == "é"
    for raw, message in ((b"\xff\0", "UTF-8"), (b"ab", "ends in NUL")):
        with pytest.raises(DecodeError, match=message):
            CdrReader(b"\0\1\0\0" + struct.pack("<I", len(raw)) + raw).string()


@pytest.mark.parametrize("stamp_ns", [2**31 * 10**9, -(2**31) * 10**9 - 1])
def test_stamps_that_no_message_can_hold(stamp_ns: int) -> None:
    with pytest.raises(EncodeError, match="32 bits of seconds"):
        encoder_for("joint_state")(replace(REST, stamp_ns=stamp_ns))


def test_a_place_that_no_message_of_float32_can_hold() -> None:
    far = replace(REST, transl=np.array([0.0, 1e39, 0.0]))
    with pytest.raises(EncodeError, match="wanted numbers that float32 can hold"):
        encoder_for("multiarray")(far)
    assert decoder_for("pose_array").from_bytes(encoder_for("pose_array")(far)).transl[1] == 1e39


def test_a_style_travels_in_a_multiarray() -> None:
    styled = SmplFrame(pose=np.zeros(72), style=[0.5, -1, 2, 0])
    decoded = decoder_for("multiarray").from_bytes(encoder_for("multiarray")(styled))
    np.testing.assert_array_equal(decoded.style, styled.style)
    plain = decoder_for("multiarray").from_bytes(encoder_for("multiarray")(SmplFrame(pose=np.zeros(72))))
    assert plain.style is None
