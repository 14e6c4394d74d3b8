"""Settings as ROS parameters: declared with their descriptions, and converted from ROS values."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any, TypeVar

from refu_core.errors import printable
from refu_core.options import SettingsError, Spec, specs_of

Settings = TypeVar("Settings")


def listing(kind: type) -> str:
    """The parameters, one per line."""
    specs = specs_of(kind).items()
    return "\n".join(
        ["parameters:", *(f"  {name:<20}{one.description} Default: {one.default!r}" for name, one in specs)]
    )


def declare(node: Any, kind: type[Settings]) -> Settings:
    """Declares every parameter, returns what the node was started with, and warns of unknown parameters.

    Raises `SettingsError` for values that have no meaning, and rclpy's own errors for values of a wrong type.
    """
    values = {}
    for name, spec in specs_of(kind).items():
        default = list(spec.default) if isinstance(spec.default, tuple) else spec.default
        values[name] = node.declare_parameter(name, default, _descriptor(spec)).value
    # A file of parameters may be for several nodes (`/**`), so an unknown one is no error.
    for name in getattr(node, "_parameter_overrides", {}):
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            like = get_close_matches(name, values, n=1)
            hint = f": is {like[0]} meant?" if like else ""
            node.get_logger().warning(f"there is no parameter {printable(name)}{hint}")
    return kind(**coerced(kind, values))


def parameter(name: str, value: Any) -> Any:
    """A parameter of ROS that holds a setting."""
    from rclpy.parameter import Parameter

    return Parameter(name, value=list(value) if isinstance(value, tuple) else value)


def _descriptor(spec: Spec) -> Any:
    from rclpy.node import FloatingPointRange, IntegerRange, ParameterDescriptor

    descriptor = ParameterDescriptor(description=spec.description, read_only=not spec.live)
    descriptor.additional_constraints = " | ".join(spec.choices)
    if spec.within is not None:
        low, high = spec.within
        if isinstance(spec.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    # Whole numbers are fine for floats (`max_rate:=30`); ROS alone would refuse them.
    descriptor.dynamic_typing = spec.kind is float
    return descriptor


_TYPES: dict[type, tuple[str, Any]] = {
    bool: ("true or false", bool),
    int: ("a whole number", int),
    float: ("a number", (int, float)),
    str: ("a string", str),
}
"""For each type of parameter, what is wanted in words, and the types of values that are accepted."""


def coerced(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """ROS values as settings have them: tuples for lists, floats for whole numbers. Names not in `kind` are dropped.

    Raises `SettingsError` for a value of another type.
    """
    specs = specs_of(kind)
    return {name: _coerced(name, value, specs[name]) for name, value in values.items() if name in specs}


def _coerced(name: str, value: Any, spec: Spec) -> Any:
    kind, is_list = spec.kind, isinstance(spec.default, tuple)
    wanted, items = _TYPES[kind][0], [value]
    if is_list:
        wanted = "a list of strings" if kind is str else f"a list of {len(spec.default)} numbers"
        items = list(value) if hasattr(value, "__iter__") and not isinstance(value, (str, bytes)) else [None]
        if kind is not str and len(items) != len(spec.default):
            items = [None]
    if not all(_is_of(kind, item) for item in items):
        hint = "an empty list" if kind is str else "whole numbers and decimals mixed; write all as decimals"
        hint = f": no value, or {hint}" if value is None and is_list else ""  # ROS turns these into None
        raise SettingsError(f"{name}: wanted {wanted}, got {value!r}{hint}")
    return tuple(map(kind, items)) if is_list else kind(value)


def _is_of(kind: type, value: Any) -> bool:
    if not isinstance(value, _TYPES[kind][1]) or isinstance(value, bool) != (kind is bool):
        return False
    return not isinstance(value, int) or abs(value) < 2**64  # as ROS has them; longer ones don't even fit a float
