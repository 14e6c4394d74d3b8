"""Against ROS itself: what rclpy serialises we decode, what we encode rclpy reads."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from reference import frames, stamps, texts

from msg_adapters import (
    DIAGNOSTIC_ARRAY,
    INPUT_TYPES,
    MARKER_ARRAY,
    DiagnosticStatus,
    MarkerArrayEncoder,
    MarkerMesh,
    decode_marker_array,
    decoder_for,
    encode_diagnostics,
    encoder_for,
)
from refu_core import SmplFrame

serialization = pytest.importorskip("rclpy.serialization", reason="rclpy isn't installed (extra ros)")
# rclpy's parser of message definitions uses a module that Python 3.11 deprecates.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def message_class(message_type: str) -> Any:

    package, _, name = message_type.split("/")
    return getattr(import_module(f"{package}.msg"), name)


@pytest.mark.parametrize("input_type", ["multiarray", "joint_state", "pose_array"])
@given(frame=frames())
def test_inputs(input_type: str, frame: SmplFrame) -> None:
    data = encoder_for(input_type)(frame)
    message = serialization.deserialize_message(data, message_class(INPUT_TYPES[input_type]))
    decode = decoder_for(input_type).from_bytes
    ours, theirs = decode(data), decode(serialization.serialize_message(message))
    np.testing.assert_array_equal(ours.pose, theirs.pose)
    np.testing.assert_array_equal(ours.betas, theirs.betas)
    np.testing.assert_array_equal(ours.transl, theirs.transl)
    assert ours.stamp_ns == theirs.stamp_ns


@given(texts, texts, stamps)
def test_markers(ns: str, frame_id: str, stamp_ns: int) -> None:
    rng = np.random.default_rng(stamp_ns)
    faces = rng.integers(0, 20, (30, 3))
    color = tuple(rng.random(4).astype(np.float32).tolist())
    mesh = MarkerMesh(ns, faces, 20, color=color)
    vertices = rng.normal(size=(20, 3))
    data = MarkerArrayEncoder([mesh], frame_id=frame_id, axes="frame").encode([vertices], stamp_ns=stamp_ns)
    message = serialization.deserialize_message(data, message_class(MARKER_ARRAY))
    (marker,) = message.markers
    assert (marker.ns, marker.id, marker.type, marker.action) == (ns, 0, marker.TRIANGLE_LIST, marker.ADD)
    assert marker.header.frame_id == frame_id
    assert marker.header.stamp.sec * 10**9 + marker.header.stamp.nanosec == stamp_ns
    assert (marker.color.r, marker.color.a, marker.scale.x, marker.pose.orientation.w) == (color[0], color[3], 1.0, 1.0)
    np.testing.assert_array_equal([(p.x, p.y, p.z) for p in marker.points], vertices[faces.ravel()])
    (back,) = decode_marker_array(serialization.serialize_message(message))
    np.testing.assert_array_equal(back.points, vertices[faces.ravel()])
    assert (back.ns, back.frame_id, back.stamp_ns) == (ns, frame_id, stamp_ns)


def test_diagnostics() -> None:
    data = encode_diagnostics([DiagnosticStatus(1, "n", "m", "h", {"k": "v"})], stamp_ns=5)
    (status,) = serialization.deserialize_message(data, message_class(DIAGNOSTIC_ARRAY)).status
    assert (status.level, status.name, status.message, status.hardware_id) == (b"\x01", "n", "m", "h")
    assert (status.values[0].key, status.values[0].value) == ("k", "v")
