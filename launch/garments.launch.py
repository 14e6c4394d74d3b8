"""Starts the garment node.

ros2 launch refu_ros garments.launch.py garments:="[shirt-male]" frame_id:=camera_color_optical_frame input_axes:=frame
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

CONFIG = Path(get_package_share_directory("refu_ros")) / "config" / "garment_node.yaml"
DEFAULTS: dict[str, Any] = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))["/**/garment_node"]["ros__parameters"]
COMMENTS: dict[str, str] = dict(
    re.findall(r"^ +(\w+):.*?  # (.+?)(?:; live)?$", CONFIG.read_text(encoding="utf-8"), re.MULTILINE)
)
TOPICS = {"input_topic": "smpl_params", "output_topic": "garments", "body_topic": "body"}
OTHERS = {
    "params_file": (str(CONFIG), "YAML file of the node's parameters"),
    "namespace": ("", "namespace of the node and its topics"),
    "log_level": ("info", "debug, info, warn, error or fatal"),
    "use_sim_time": ("", "true: the node's clock is /clock; empty: as in the file"),
}
OF_DEMO = ("motion", "bag", "in_place", "rviz")
"""Arguments of demo.launch.py, which includes this file."""


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
        sample = yaml.safe_dump(default, default_flow_style=True, width=1000).splitlines()[0]
        raise RuntimeError(f"{name}: wanted a value like {sample}, got {text!r}") from None
    return value


def owners(tree: Any, above: str = "") -> Iterator[str]:
    """Whom the parameters in a file are for: names of nodes, with wildcards."""
    for key, below in tree.items() if isinstance(tree, dict) else ():
        if key == "ros__parameters":
            yield above
        else:
            yield from owners(below, f"{above}/{str(key).strip('/')}")


def doubts(file: Path, namespace: str, given: set[str]) -> list[str]:
    """What would be ignored without a word: arguments that don't exist, and a file for other nodes.

    Raises `RuntimeError` where there is no such file. What is wrong in it, the node itself says.
    """
    known = {*DEFAULTS, *OTHERS, *TOPICS, *OF_DEMO}
    near = {name: get_close_matches(name, known, n=1, cutoff=0.8) for name in sorted(given - known)}
    found = [f"there is no argument {name}: is {like[0]} meant?" for name, like in near.items() if like]
    if not file.is_file():
        raise RuntimeError(f"params_file: there is no file {file}")
    try:
        names = [*owners(yaml.safe_load(file.read_text(encoding="utf-8")))]
    except (ValueError, yaml.YAMLError):
        return found
    node = re.sub("/+", "/", f"/{namespace}/garment_node")
    wildcards = {"/**": "(/.+)?", "/*": "/[^/]+"}
    patterns = [re.sub(r"/\*\*?", lambda found: wildcards[found[0]], name) for name in names]
    if names and not any(re.fullmatch(pattern, node) for pattern in patterns):
        found.append(f"params_file: {file} is for {', '.join(names)}; {node} takes nothing of it")
    return found


def node(context: LaunchContext) -> list[Node]:
    """The node with the file of parameters, overridden only by those given on the command line."""
    given = {name: LaunchConfiguration(name).perform(context) for name in (*DEFAULTS, "use_sim_time", *TOPICS)}
    namespace, params_file = (LaunchConfiguration(name).perform(context) for name in ("namespace", "params_file"))
    file = Path(params_file).expanduser()
    for text in doubts(file, namespace, {*context.launch_configurations}):
        get_logger("garments").warning(text)
    return [
        # Not launch's LifecycleNode: that makes a ROS node in launch's own process, and some Ctrl-C then hang or crash.
        Node(
            package="refu_ros",
            executable="garment_node",
            name="garment_node",
            namespace=namespace,
            parameters=[
                str(file),
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
