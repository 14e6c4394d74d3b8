"""The settings as ROS parameters."""

from __future__ import annotations

from typing import Any

from rclpy.node import FloatingPointRange, Node, ParameterDescriptor

from refu_ros._settings import NodeSettings, ParameterSpec, defaults, specs


def declare_settings(node: Node) -> NodeSettings:
    """Declares every parameter, and takes what the node was started with.

    Raises `SettingsError` for values that have no meaning, and rclpy's own errors for values of a wrong type.
    """
    values = {}
    for name, spec in specs().items():
        default = defaults()[name]
        value = list(default) if isinstance(default, tuple) else default
        values[name] = node.declare_parameter(name, value, _descriptor(default, spec)).value
    return NodeSettings.of(values)


def _descriptor(default: Any, spec: ParameterSpec) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=spec.description, read_only=not spec.live)
    if spec.choices:
        descriptor.additional_constraints = " | ".join(spec.choices)
    if spec.low is not None and spec.high is not None:
        descriptor.floating_point_range = [FloatingPointRange(from_value=spec.low, to_value=spec.high, step=0.0)]
    # Whole numbers are fine for floats (`max_rate:=30`); ROS alone would refuse them.
    first = default[0] if isinstance(default, tuple) else default
    descriptor.dynamic_typing = isinstance(first, float) and not isinstance(first, bool)
    return descriptor
