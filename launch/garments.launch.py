"""Starts the garment node.

ros2 launch refu_ros garments.launch.py garments:="[shirt-male]" frame_id:=camera_color_optical_frame input_axes:=frame
"""

from __future__ import annotations

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

TEXTS = (
    "backbone",
    "betas_source",
    "device",
    "frame_id",
    "input_axes",
    "input_type",
    "on_device_loss",
    "record",
    "sdf",
    "weights",
)
NUMBERS = ("margin", "max_distance", "max_rate", "person_timeout")
YAML = ("betas", "follow_humans", "garments", "lazy", "persons", "style")
PARAMETERS = TEXTS + NUMBERS + YAML


def node(context: LaunchContext) -> list[Node]:
    """The node with the file of parameters, and on top of it only those that were given on the command line."""
    given = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    parse = dict.fromkeys(TEXTS, str) | dict.fromkeys(NUMBERS, float) | dict.fromkeys(YAML, yaml.safe_load)
    overrides = {name: parse[name](text) for name, text in given.items() if text}
    return [
        Node(
            package="refu_ros",
            executable="garment_node",
            name="garment_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), overrides],
            output="screen",
            # A recording is flushed and closed on SIGINT; a slow disk gets more than launch's usual 5 s for it.
            sigterm_timeout="15",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """The arguments, and the node."""
    share = Path(get_package_share_directory("refu_ros"))
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=str(share / "config" / "garment_node.yaml"),
                description="YAML file of the node's parameters",
            ),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node and its topics"),
            *(
                DeclareLaunchArgument(name, default_value="", description=f"the node's {name}; empty: as in the file")
                for name in PARAMETERS
            ),
            OpaqueFunction(function=node),
        ]
    )
