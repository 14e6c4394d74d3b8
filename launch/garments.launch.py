"""Starts the garment node.

ros2 launch refu_ros garments.launch.py garments:="[shirt-male]" frame_id:=camera_color_optical_frame input_axes:=frame
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

from launch import LaunchContext, LaunchDescription

CONFIG = Path(get_package_share_directory("refu_ros")) / "config" / "garment_node.yaml"
DEFAULTS: dict[str, Any] = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))["/**/garment_node"]["ros__parameters"]
COMMENTS: dict[str, str] = dict(re.findall(r"^ +(\w+):.*?  # (.+)$", CONFIG.read_text(encoding="utf-8"), re.MULTILINE))
TOPICS = {"input_topic": "smpl_params", "output_topic": "garments", "body_topic": "body"}
OTHERS = {
    "params_file": (str(CONFIG), "YAML file of the node's parameters"),
    "namespace": ("", "namespace of the node and its topics"),
    "log_level": ("info", "debug, info, warn, error or fatal"),
    "use_sim_time": ("", "true: the node's clock is /clock; empty: as in the file"),
}


def parsed(name: str, text: str) -> Any:
    """A parameter's text as a value of its default's type."""
    default = DEFAULTS.get(name, False)
    if isinstance(default, str):
        return text
    try:
        value = yaml.safe_load(text)
        if isinstance(default, float):
            value = float(value)
        elif isinstance(default, list) and isinstance(default[0], float):
            value = [float(item) for item in value]
        if not isinstance(value, type(default)):
            raise TypeError
    except (TypeError, ValueError, yaml.YAMLError):
        msg = f"{name}: wanted a value like {yaml.safe_dump(default, default_flow_style=True).split()[0]}, got {text!r}"
        raise RuntimeError(msg) from None
    return value


def node(context: LaunchContext) -> list[LifecycleNode]:
    """The node with the file of parameters, overridden only by those given on the command line."""
    given = {name: LaunchConfiguration(name).perform(context) for name in (*DEFAULTS, "use_sim_time", *TOPICS)}
    return [
        LifecycleNode(
            package="refu_ros",
            executable="garment_node",
            name="garment_node",
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                str(Path(LaunchConfiguration("params_file").perform(context)).expanduser()),
                {name: parsed(name, text) for name, text in given.items() if text and name not in TOPICS},
            ],
            remappings=[(topic, given[name]) for name, topic in TOPICS.items() if given[name]],
            ros_arguments=["--log-level", LaunchConfiguration("log_level")],
            output="screen",
            # A recording is flushed and closed on SIGINT; a slow disk gets more than launch's usual 5 s for it.
            sigterm_timeout="15",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """The arguments, and the node."""
    arguments = OTHERS | {name: ("", f"{topic}, by another name") for name, topic in TOPICS.items()}
    arguments |= {name: ("", f"{COMMENTS[name]}; empty: as in the file") for name in DEFAULTS}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in arguments.items()
            ),
            OpaqueFunction(function=node),
        ]
    )
