"""`garment_node` that is sent keypoints: people are dressed by the names in the markers, at a rate of their own."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from geometry_msgs.msg import Point
from harness import GARMENTS, PATIENCE_S, NodeProcess, Peer
from rclpy.qos import QoSProfile
from visualization_msgs.msg import Marker, MarkerArray

from refu_core.keypoints import Proportions, Skeleton, keypoint_layout
from refu_core.keypoints._pose import Pose, exp_so3

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


def people(seconds: float) -> MarkerArray:
    """Two persons, one of whom walks off, as lists of spheres in a camera's frame."""
    bones = Skeleton(keypoint_layout("coco17"), Proportions.builtin("male"))
    turns, message = np.zeros((24, 3)), MarkerArray()
    turns[0, 0], turns[16, 2], turns[17, 2] = np.pi, -1.0, 1.0  # y down
    for ns, place in (("ann", [0.3 * seconds, 0, 3]), ("bob", [1.5, 0, 4])):
        points = bones.posed(Pose(np.array(place), exp_so3(turns), np.zeros(10))).points
        marker = Marker(ns=ns, type=Marker.SPHERE_LIST)
        marker.header.frame_id = "camera"
        marker.header.stamp.sec, marker.header.stamp.nanosec = 100 + int(seconds), int(seconds % 1 * 1e9)
        marker.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
        message.markers.append(marker)
    return message


def stamp_of(message: MarkerArray) -> int:
    stamp = message.markers[0].header.stamp
    return int(stamp.sec * 10**9 + stamp.nanosec)


def test_people_of_a_tracker_are_dressed(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    parameters = {"input_type": "keypoint_markers", "keypoints": "coco17", "keypoint_rate": 30, "frame_id": "camera"}
    parameters |= {"backbone": "skinned", "sdf": "none"}
    with NodeProcess(tmp_path / "log.txt", **parameters) as node:
        peer = Peer("nobody")
        tracker = peer.node.create_publisher(MarkerArray, "smpl_params", QoSProfile(depth=1))
        try:
            peer.spin_until(tracker.get_subscription_count, "the node listens")
            start, wanted = time.monotonic(), {f"{person}/{name}" for person in ("ann", "bob") for name in GARMENTS}
            sent, stamps = set[int](), set[int]()
            while not (wanted <= peer.shown() and len(stamps - sent) > 2):  # between messages, too
                assert time.monotonic() < start + PATIENCE_S, node.log
                tracker.publish(message := people(time.monotonic() - start))
                sent.add(stamp_of(message))
                peer.spin(0.1)
                stamps = {m.stamp_ns for markers in peer.garments for m in markers if m.ns.startswith("bob")}
            for markers in peer.garments[-3:]:
                for marker in (one for one in markers if one.action == 0):
                    height = marker.points[:, 1].mean() + marker.pose[1]
                    assert marker.frame_id == "camera"
                    assert -1.0 < height < 1.0  # in the camera's axes, not turned into ROS's
            peer.spin_until(lambda: not peer.shown(), "people who aren't seen any more leave")
            assert "Traceback" not in node.log
        finally:
            peer.close()
