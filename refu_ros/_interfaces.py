"""ROS message and service classes by name."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from msg_adapters import QosProfile
from refu_core import RefuError


def interface(name: str) -> Any:
    """The class of a type such as `std_msgs/msg/Header`. Raises `RefuError` where its package isn't there."""
    package, kind, type_name = name.split("/")
    try:
        return getattr(import_module(f"{package}.{kind}"), type_name)
    except (ImportError, AttributeError) as error:  # the latter: a folder of definitions, which Python takes for it
        msg = f"{name} isn't importable: install or source {package} ({error})"
        raise RefuError(msg) from error


def ros_qos(profile: QosProfile) -> QoSProfile:
    """The same as rclpy has it."""
    reliability = ReliabilityPolicy.RELIABLE if profile.reliability == "reliable" else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=profile.depth, reliability=reliability)
