"""Settings as ROS parameters: a dataclass whose fields say what each is for, what it may be, and when it may change."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from typing import Any, TypeVar

from refu_core import RefuError
from refu_core.errors import printable

Settings = TypeVar("Settings")


class SettingsError(RefuError, ValueError):
    """A parameter of a node that has no meaning."""


@dataclass(frozen=True, kw_only=True)
class ParameterSpec:
    """What ROS is told about a parameter."""

    description: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = True
    """Whether it may change while the node runs."""


def parameter(default: Any, description: str, **limits: Any) -> Any:
    """A field that is a parameter."""
    return field(default=default, metadata={"spec": ParameterSpec(description=description, **limits)})


def specs_of(kind: Any) -> dict[str, ParameterSpec]:
    """Each parameter's specification by name."""
    return {item.name: item.metadata["spec"] for item in fields(kind)}


def defaults_of(kind: Any) -> dict[str, Any]:
    """Each parameter's default by name."""
    return {item.name: item.default for item in fields(kind)}


def listing(kind: type) -> str:
    """The parameters, a line each."""
    lines = (
        f"  {name:<16}{spec.description} Default: {defaults_of(kind)[name]!r}" for name, spec in specs_of(kind).items()
    )
    return "\n".join(["parameters:", *lines])


def declare(node: Any, kind: type[Settings]) -> Settings:
    """Declares every parameter, and takes what the node was started with. What it doesn't know is warned of.

    Raises `SettingsError` for values that have no meaning, and rclpy's own errors for values of a wrong type.
    """
    values = {}
    for name, spec in specs_of(kind).items():
        default = defaults_of(kind)[name]
        value = list(default) if isinstance(default, tuple) else default
        values[name] = node.declare_parameter(name, value, _descriptor(default, spec)).value
    # A file of parameters may be for several nodes (`/**`), so it is no error.
    for name in getattr(node, "_parameter_overrides", {}):
        if not node.has_parameter(name) and not name.startswith("qos_overrides."):
            like = get_close_matches(name, values, n=1)
            hint = f": is {like[0]} meant?" if like else ""
            node.get_logger().warning(f"there is no parameter {printable(name)}{hint}")
    return kind(**coerced(kind, values))


def _descriptor(default: Any, spec: ParameterSpec) -> Any:
    from rclpy.node import FloatingPointRange, IntegerRange, ParameterDescriptor

    descriptor = ParameterDescriptor(description=spec.description, read_only=not spec.live)
    if spec.choices:
        descriptor.additional_constraints = " | ".join(spec.choices)
    if spec.low is not None and spec.high is not None:
        if isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high), step=1)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=spec.low, to_value=spec.high, step=0.0)]
    # Whole numbers are fine for floats (`max_rate:=30`); ROS alone would refuse them.
    descriptor.dynamic_typing = isinstance(default[0] if isinstance(default, tuple) else default, float)
    return descriptor


def coerced(kind: type, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of ROS as settings have them: tuples for lists, floats for whole numbers; those alone that are of `kind`.

    Raises `SettingsError` for a value of another type.
    """
    return {
        name: _coerced(name, value, defaults_of(kind)[name]) for name, value in values.items() if name in specs_of(kind)
    }


def _coerced(name: str, value: Any, default: Any) -> Any:
    if isinstance(default, bool):
        right, wanted = isinstance(value, bool), "true or false"
    elif isinstance(default, int):
        right, wanted = isinstance(value, int) and not isinstance(value, bool), "a whole number"
    elif isinstance(default, float):
        right, wanted = _is_number(value), "a number"
    elif isinstance(default, str):
        right, wanted = isinstance(value, str), "a string"
    else:
        items = list(value) if hasattr(value, "__iter__") and not isinstance(value, (str, bytes)) else None
        if isinstance(default[0], str):
            right, wanted = items is not None and all(isinstance(item, str) for item in items), "a list of strings"
        else:
            right = items is not None and len(items) == len(default) and all(map(_is_number, items))
            wanted = f"a list of {len(default)} numbers"
        value = items
    if not right:
        hint = ""
        if value is None:  # what becomes of all these on their way
            of_text = "a list of strings" in wanted
            hint = "an empty list" if of_text else "whole numbers and decimals mixed; write all as decimals"
            hint = f": no value, or {hint}"
        msg = f"{name}: wanted {wanted}, got {value!r}{hint}"
        raise SettingsError(msg)
    return tuple(map(type(default[0]), value)) if isinstance(default, tuple) else type(default)(value)


def _is_number(value: Any) -> bool:
    # ROS's whole numbers have 64 bits; longer ones don't even fit a float.
    return isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**64)


def check(settings: Any) -> None:
    """Raises `SettingsError` for a value out of its range, or that isn't among its choices."""
    for name, spec in specs_of(type(settings)).items():
        value = getattr(settings, name)
        if spec.choices and value not in spec.choices:
            msg = f"{name}: wanted {' or '.join(spec.choices)}, got {value!r}"
            raise SettingsError(msg)
        if spec.low is not None and spec.high is not None:
            for number in value if isinstance(value, tuple) else (value,):
                if not (math.isfinite(number) and spec.low <= number <= spec.high):
                    msg = f"{name}: wanted {spec.low:g} to {spec.high:g}, got {number:g}"
                    raise SettingsError(msg)
