"""A robot that dresses somebody: where a sleeve ends, which way it faces, and how much room there is in it.

    ros2 run refu_ros smpl_publisher & ros2 run refu_ros garment_node &
    python examples/ros/sleeve_listener.py                              # -r openings/…:=… for another opening

The node computes only what is subscribed to here.
"""

from __future__ import annotations

import signal

import numpy as np
import rclpy
from geometry_msgs.msg import PolygonStamped, PoseStamped
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

from msg_adapters import points_of

AHEAD_M = 0.15
"""How far in front of the opening the gripper waits, along its normal [m]."""


class SleeveListener(Node):  # type: ignore[misc]
    """Publishes where a gripper should wait, and says how close the cloth is to the skin."""

    def __init__(self) -> None:
        super().__init__("sleeve_listener")
        self._target = self.create_publisher(PoseStamped, "gripper_target", 1)
        self.create_subscription(PolygonStamped, "openings/tshirt_male/left_sleeve", self._on_opening, 1)
        self.create_subscription(PointCloud2, "points", self._on_points, 1)

    def _on_opening(self, message: PolygonStamped) -> None:
        ring = np.array([(p.x, p.y, p.z) for p in message.polygon.points])
        away = ring - ring.mean(axis=0)
        normal = np.cross(away, np.roll(away, -1, axis=0)).sum(axis=0)  # counter-clockwise: it points out
        normal /= np.linalg.norm(normal)
        side = np.cross([0.0, 0.0, 1.0], normal)
        side /= max(np.linalg.norm(side), 1e-9)
        rotation = np.stack([np.cross(side, -normal), side, -normal], axis=1)  # z goes into the sleeve
        place, turn = ring.mean(axis=0) + AHEAD_M * normal, Rotation.from_matrix(rotation).as_quat()
        target = PoseStamped(header=message.header)
        target.pose.position.x, target.pose.position.y, target.pose.position.z = place.tolist()
        q = target.pose.orientation
        q.x, q.y, q.z, q.w = turn.tolist()
        self._target.publish(target)

    def _on_points(self, message: PointCloud2) -> None:
        points = points_of(message)  # a view: nothing is copied
        clearance = points["clearance"][points["garment"] == 0]
        text = f"{len(points)} points; cloth is {1e3 * np.median(clearance):.0f} mm off the skin (median)"
        self.get_logger().info(text, throttle_duration_sec=1.0)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda *_: None)  # Python's handler raises in the middle of a message
    rclpy.init()  # installs its own handler, which ends `spin`
    try:
        rclpy.spin(SleeveListener())
    except Exception:
        if rclpy.ok():  # otherwise it was told to end, perhaps while publishing
            raise
