"""A person in motion, dressed, in RViz2: smpl_publisher (or a bag played by rosbag2), the garment node and RViz2.

ros2 launch refu_ros demo.launch.py
ros2 launch refu_ros demo.launch.py motion:=clip.npz persons:="[ann, bob]"
ros2 launch refu_ros demo.launch.py bag:=recording input_type:=joint_state rviz:=false
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from posixpath import join

import yaml
from ament_index_python.packages import PackageNotFoundError, get_package_prefix, get_package_share_directory
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription, OpaqueFunction, Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.logging import get_logger
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity

SHARE = Path(get_package_share_directory("refu_ros"))
OWN = {
    "motion": (str(SHARE / "bags" / "walk"), "file of motion, .mcap or rosbag2 directory for smpl_publisher to play"),
    "bag": ("", "rosbag2 directory for `ros2 bag play` to play instead, all its topics by their recorded names"),
    "in_place": ("true", "hold the person at the place of the first frame"),
    "rviz": ("true", "start RViz2; the demo ends when it is closed"),
}
"""Arguments of the demo alone; it also takes all those of garments.launch.py."""
SHARED = {
    "input_type": ("multiarray", "message that carries the body: multiarray, joint_state, pose_array, smpl_msgs"),
    "input_axes": ("smpl", "axes that are sent: smpl (y up; files are turned), or frame (as a file has them)"),
    "frame_id": ("map", "frame of the garments"),
}
"""Arguments that the player and the viewer need as well, with the defaults that the node shares with them."""


FOLLOWED = ("namespace", "persons", "follow_humans", "use_sim_time", "input_topic", "output_topic", "body_topic")
"""Arguments of garments.launch.py that player and viewer follow."""


def missing(package: str) -> str:
    """What to do about a package that isn't there; empty when it is."""
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        debian = f"ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{package.replace('_', '-')}"
        return f"the package {package} isn't installed: sudo apt install {debian}"
    return ""


def is_true(text: str) -> bool:
    """Whether launch's own conditions take the text as true."""
    return text.strip().lower() in ("true", "1")


def check(context: LaunchContext) -> None:
    """Raises before anything is started: on an error, launch leaves running what it has started."""
    if LaunchConfiguration("bag").perform(context) and (problem := missing("ros2bag")):
        raise RuntimeError(problem)


def ends_the_demo(reason: str) -> Callable[..., Shutdown | None]:
    """A process's `on_exit` that ends the demo, but only once: launch stumbles over a second shutdown."""
    return lambda _event, context: None if context.is_shutdown else Shutdown(reason=reason)


def player(given: dict[str, str]) -> LaunchDescriptionEntity:
    """The process that sends the motion, on the topics the node listens to."""
    end = ends_the_demo("the player has ended")
    sim_time = is_true(given["use_sim_time"])
    if given["bag"]:
        bag = str(Path(given["bag"]).expanduser())
        command = ["ros2", "bag", "play", "--loop", *(["--clock"] if sim_time else []), bag]
        return ExecuteProcess(cmd=command, output="screen", on_exit=end)
    persons = [name for name in yaml.safe_load(given["persons"] or "[]") if name]
    remappings = [("smpl_params", given["input_topic"])] if given["input_topic"] else []
    if is_true(given["follow_humans"]):
        persons = persons or ["demo"]
        remappings = [(f"{name}/smpl_params", f"/humans/bodies/{name}/joint_states") for name in persons]
    parameters = {name: given[name] for name in ("motion", *SHARED)}
    parameters |= {"in_place": is_true(given["in_place"]), "use_sim_time": sim_time}
    return Node(
        package="refu_ros",
        executable="smpl_publisher",
        namespace=given["namespace"],
        parameters=[parameters | ({"persons": persons} if persons else {})],
        remappings=remappings,
        output="screen",
        on_exit=end,
    )


def viewer(given: dict[str, str]) -> list[LaunchDescriptionEntity]:
    """RViz2 and a transform for the frame it shows (a robot's tree has one); empty if either isn't installed."""
    problems = [problem for package in ("rviz2", "tf2_ros") if (problem := missing(package))]
    for problem in problems:
        get_logger("demo").warning(f"{problem}; going on without a viewer, as with rviz:=false")
    if problems:
        return []
    frame = ["--frame-id", given["frame_id"], "--child-frame-id", "refu_demo"]
    display = ["--display-config", str(SHARE / "rviz" / "refu.rviz"), "--fixed-frame", given["frame_id"]]
    topics = {"garments": given["output_topic"] or "garments", "body": given["body_topic"] or "body"}
    topics |= {name: name for name in ("openings", "points")}
    return [
        Node(package="tf2_ros", executable="static_transform_publisher", arguments=frame),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=display,
            parameters=[{"use_sim_time": is_true(given["use_sim_time"])}],
            # posixpath: a name that begins with / is the whole name.
            remappings=[(f"/{name}", join("/", given["namespace"], topic)) for name, topic in topics.items()],
            on_exit=ends_the_demo("RViz2 has ended"),
        ),
    ]


def beside_the_node(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The player, and the viewer if it is wanted."""
    given = {name: LaunchConfiguration(name).perform(context) for name in (*OWN, *SHARED, *FOLLOWED)}
    return [player(given), *(viewer(given) if is_true(given["rviz"]) else [])]


def generate_launch_description() -> LaunchDescription:
    """The arguments, the garment node, the player and the viewer."""
    garments = PythonLaunchDescriptionSource(str(SHARE / "launch" / "garments.launch.py"))
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in (OWN | SHARED).items()
    ]
    return LaunchDescription(
        [
            *declared,
            OpaqueFunction(function=check),
            IncludeLaunchDescription(garments),
            OpaqueFunction(function=beside_the_node),
        ]
    )
