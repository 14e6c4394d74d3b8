"""`garment_node`: dresses the persons whose SMPL parameters arrive, until it is told to stop."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy reads it; its threads wait for busy cores

from refu_ros._program import EXIT_BAD_INPUT, hear, make_room, run, spin

EXIT_DEVICE_LOST = 3
_TOPICS = """\
topics:
  smpl_params   in: a person's body, of the type in input_type; <person>/smpl_params for each of persons
  garments, body, openings                      out: visualization_msgs/MarkerArray
  <person>/points                               out: sensor_msgs/PointCloud2
  <person>/openings/<garment>/<opening>         out: geometry_msgs/PolygonStamped, and frames on /tf with publish_tf
  <person>/mesh/<garment>, <person>/contacts    out: shape_msgs/Mesh, diagnostic_msgs/DiagnosticArray
  collision_object, scene                       out: for MoveIt and Foxglove
  /diagnostics  out: diagnostic_msgs/DiagnosticArray, once a second
services:
  ~/record      std_srvs/SetBool: starts and stops a recording to the parameter record
  ~/dress, ~/record_bag, ~/replay_bag (action)  of refu_msgs, where it is installed
  and those of every lifecycle node"""


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit status. SIGINT and SIGTERM end it after all files are closed."""
    make_room()
    return run("garment_node", args, description=__doc__, listing=_listing, live=_live)


def _listing() -> str:
    from refu_ros._settings import NodeSettings, listing

    return f"{listing(NodeSettings)}\n{_TOPICS}"


def _live() -> int:
    """Runs the node to its end and returns the exit status. Raises if its parameters are wrong."""
    from refu_ros._node import GarmentNode

    node, told = GarmentNode(), list[bool]()
    try:
        if node.settings.autostart and not started(node, partial(hear, told)):
            return EXIT_BAD_INPUT
        hear(told)
        spin(node, until=lambda: told or time.monotonic() >= node.ends_at)
        return EXIT_DEVICE_LOST if node.failed else 0
    finally:
        node.close()
        node.destroy_node()


def started(node: Any, before_it_is_active: Callable[[], object] = lambda: None) -> bool:
    """Configures and activates the node; returns whether that worked. Errors have been logged."""
    from rclpy.lifecycle import TransitionCallbackReturn

    done = TransitionCallbackReturn.SUCCESS
    if node.trigger_configure() != done:
        return False
    before_it_is_active()
    return bool(node.trigger_activate() == done)


if __name__ == "__main__":
    sys.exit(main())
