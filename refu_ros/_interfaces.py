"""ROS message and service classes by name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.type_support import check_for_type_support

from msg_adapters import QosProfile
from refu_core import RefuError


def interface(name: str) -> Any:
    """The class of a type such as `std_msgs/msg/Header`.

    Raises `RefuError` where its package isn't there, or is broken: made for another Python, or a library is missing.
    """
    package, kind, type_name = name.split("/")
    try:
        found = getattr(import_module(f"{package}.{kind}"), type_name)
        check_for_type_support(found)
    except (ImportError, AttributeError) as error:  # AttributeError: Python took a folder of definitions for it
        raise RefuError(f"{name} isn't importable: install or source {package} ({error})") from error
    except Exception as error:  # rosidl's own class, whose import would load a parser of definitions
        msg = f"{name} is of no use: install or build {package} anew, for this ROS and Python ({error})"
        raise RefuError(msg) from error
    return found


def ros_qos(profile: QosProfile) -> QoSProfile:
    """The same profile as rclpy's class."""
    return QoSProfile(depth=profile.depth, reliability=ReliabilityPolicy.get_from_short_key(profile.reliability))
