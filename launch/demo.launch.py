"""A person in motion, dressed, in RViz2: smpl_publisher (or a bag played by rosbag2), the garment node and RViz2.

ros2 launch refu_ros demo.launch.py
ros2 launch refu_ros demo.launch.py motion:=clip.npz input_axes:=frame
ros2 launch refu_ros demo.launch.py bag:=recording input_type:=joint_state rviz:=false
"""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.conditions import IfCondition, UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """The arguments, the player, the garment node, and the viewer."""
    share = Path(get_package_share_directory("refu_ros"))
    frame_id, input_axes, input_type = (LaunchConfiguration(name) for name in ("frame_id", "input_axes", "input_type"))
    no_bag = EqualsSubstitution(LaunchConfiguration("bag"), "")
    arguments = {
        "motion": (str(share / "bags" / "walk"), ".npz, .mcap or rosbag2 directory for smpl_publisher to play"),
        "bag": ("", "rosbag2 directory for `ros2 bag play` to play instead, with all its topics"),
        "input_type": ("multiarray", "message that carries the body: multiarray, joint_state, pose_array, smpl_msgs"),
        "input_axes": ("smpl", "axes of the motion: smpl (y up), or frame (z up, as AMASS's own files)"),
        "in_place": ("true", "hold the person at the place of the first frame"),
        "frame_id": ("map", "frame of the garments"),
        "rviz": ("true", "start RViz2"),
    }
    player = Node(
        package="refu_ros",
        executable="smpl_publisher",
        parameters=[
            {
                "motion": LaunchConfiguration("motion"),
                "input_type": input_type,
                "input_axes": input_axes,
                "in_place": LaunchConfiguration("in_place"),
                "frame_id": frame_id,
            }
        ],
        output="screen",
        condition=IfCondition(no_bag),
    )
    rosbag = ExecuteProcess(
        cmd=["ros2", "bag", "play", "--loop", LaunchConfiguration("bag")],
        output="screen",
        condition=UnlessCondition(no_bag),
    )
    garments = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(share / "launch" / "garments.launch.py")),
        launch_arguments={"input_type": input_type, "input_axes": input_axes, "frame_id": frame_id}.items(),
    )
    # Viewers want the frame to exist; on a robot it is in the tree already.
    frame = Node(
        package="tf2_ros",
        executable="static_transform_publisher",
        arguments=["--frame-id", frame_id, "--child-frame-id", "refu_demo"],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["--display-config", str(share / "rviz" / "refu.rviz"), "--fixed-frame", frame_id],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in arguments.items()
    ]
    return LaunchDescription([*declared, player, rosbag, garments, frame, rviz])
