"""The node's parameters: what each means, what it may be, and whether it may change; declared, and converted."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, cast

from msg_adapters import INPUT_TYPES, KEYPOINT_TYPES, POINT_FIELDS, WORLD_FRAME, InputAxes
from refu_core._files import expanded
from refu_core.errors import printable
from refu_core.keypoints import LAYOUTS
from refu_core.options import DressOptions, SettingsError, Spec, check, fixed, setting, specs_of

Settings = TypeVar("Settings")

_PERSON = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,99}")
_FRAME = re.compile(r"[^/\s\x00-\x1f\x7f][^\s\x00-\x1f\x7f]{0,254}")
_SLOWEST_HZ = 0.01
AXES = ("smpl", "frame")


def require_names(persons: Sequence[str], frame_id: str) -> list[str]:
    """Those of the persons that have a name. Raises `SettingsError` for names that topics, or tf2, can't have."""
    named = [*filter(None, persons)]
    if not all(map(_PERSON.fullmatch, named)) or len(set(persons)) < len(persons):
        raise SettingsError(f"persons: wanted distinct names of letters, digits and underscores, got {list(persons)}")
    if not _FRAME.fullmatch(frame_id):
        raise SettingsError(f"frame_id: wanted a name as tf2 has them, no leading slash or spaces, got {frame_id!r}")
    return named


@dataclass(frozen=True, kw_only=True)
class NodeSettings(DressOptions):
    """The node's parameters: each field is the parameter of the same name.

    Raises `SettingsError` for a value out of range and for values that can't go together.
    """

    threads: int = fixed(2, "Frames, or people of a frame, processed at once; on a GPU only people.", within=(1, 64))
    on_device_loss: str = setting(
        "cpu", "When the device fails: continue on the cpu, with an ERROR, or stop the node.", choices=("cpu", "stop")
    )
    input_type: str = fixed(
        "multiarray", "Message type and layout of smpl_params.", choices=(*INPUT_TYPES, *KEYPOINT_TYPES)
    )
    keypoints: str = setting(
        "zed38", "Which points of the body the tracker sends, if input_type is one of keypoints.", choices=LAYOUTS
    )
    keypoint_rate: float = fixed(0.0, "Rate of poses from keypoints [Hz]; 0: one per message.", within=(0.0, 240.0))
    keypoint_smoothing: float = setting(
        1.0, "For poses from keypoints: 2 is smoother and later, 0.5 is quicker.", within=(0.1, 10.0)
    )
    input_axes: str = setting(
        "smpl", "Axes of the root: smpl (y up; turned into ROS axes) or frame (those of frame_id).", choices=AXES
    )
    frame_id: str = setting(WORLD_FRAME, "Frame of all outputs; inputs in other frames are transformed to it (tf2).")
    transform_tolerance: float = setting(
        0.1,
        "How long an input waits for its transform, and how much older a transform may be after that [s].",
        within=(0.0, 10.0),
    )
    points_fields: tuple[str, ...] = setting(
        POINT_FIELDS, f"Fields of the points besides x, y and z: {', '.join(POINT_FIELDS)}."
    )
    camera_info: str = fixed("", "A camera's CameraInfo topic: points then say whether it sees them; empty for none.")
    planner_rate: float = setting(
        5.0, "Highest rate of each garment's mesh for planners [Hz]; 0: no limit.", within=(0.0, 1e3)
    )
    publish_tf: bool = fixed(
        False, "Also publish openings as frames on /tf; then any listener there is a reason to compute."
    )
    persons: tuple[str, ...] = fixed(
        ("",), "Persons, each with a topic <person>/smpl_params; one without a name listens to smpl_params."
    )
    follow_humans: bool = fixed(
        False, "Dress everybody with a topic /humans/bodies/<id>/joint_states (REP-155); needs joint_state."
    )
    person_timeout: float = setting(1.0, "A person silent for this long leaves the scene [s].", within=(0.05, 3600.0))
    max_rate: float = setting(0.0, "Most frames a second [Hz]; 0: no limit.", within=(0.0, 1e3))
    marker_lifetime: float = setting(2.0, "Viewers drop what is older than this [s]; 0: never.", within=(0.0, 1e6))
    max_distance: float = setting(0.0, "Nobody farther from frame_id is dressed [m]; 0: no limit.", within=(0.0, 1e6))
    record: str = setting("", "Bag to record inputs, garments and diagnostics to; empty: none.", metavar="DIR")
    record_sync_period: float = fixed(
        1.0, "The most that a power cut can take from a recording [s]; 0: no promise.", within=(0.0, 3600.0)
    )
    bags: str = fixed("", "Folder that requests (refu_msgs) may name bags in; empty: none.", metavar="DIR")
    lazy: bool = fixed(True, "Subscribe to the inputs only while an output has a subscriber, or is recorded.")
    autostart: bool = fixed(True, "Whether the node configures and activates itself.")

    def __post_init__(self) -> None:
        check(self)
        named = require_names(self.persons, self.frame_id)
        if not self.persons or (len(named) < len(self.persons) > 1):
            raise SettingsError(f"persons: wanted one without a name, or names for all, got {list(self.persons)}")
        if self.follow_humans and self.input_type != "joint_state":
            msg = f"follow_humans: REP-155 has bodies as joint_state, but input_type is {self.input_type}"
            raise SettingsError(msg)
        if unknown := sorted(set(self.points_fields) - {"", *POINT_FIELDS}):
            raise SettingsError(f"points_fields: wanted names of {', '.join(POINT_FIELDS)}, got {', '.join(unknown)}")
        for name, path in (("record", self.record), ("weights", self.weights), ("bags", self.bags)):
            if path and not _names_a_folder(path):
                raise SettingsError(f"{name}: wanted the path of a folder, got {path!r}")
        for name, rate in (("max_rate", self.max_rate), ("keypoint_rate", self.keypoint_rate)):
            if 0 < rate < _SLOWEST_HZ:
                raise SettingsError(f"{name}: wanted 0, or {_SLOWEST_HZ:g} and more, got {rate:g}")
        self.check_garments()
        if any(self.style) and (plain := self.of_one_style):
            raise SettingsError(f"style: {', '.join(plain)} has no styles; set it to zeros")

    def changed(self, values: Mapping[str, Any]) -> NodeSettings:
        """These settings with some values as ROS has them (lists, numbers of any kind). Raises `SettingsError`."""
        return replace(self, **coerced(NodeSettings, values))

    @property
    def lifetime_ns(self) -> int:
        """Lifetime of the markers [ns]: as set, but never so short that somebody who is here would flicker."""
        if not self.marker_lifetime:
            return 0
        slowest = 1 / self.max_rate if self.max_rate else 0.0
        return round(1e9 * max(self.marker_lifetime, 2 * self.person_timeout, 2 * slowest))

    @property
    def tolerance_ns(self) -> int:
        """`transform_tolerance` [ns]."""
        return round(1e9 * self.transform_tolerance)

    @property
    def axes(self) -> InputAxes:
        """`input_axes`, checked; keypoints are in the axes of `frame_id`, whichever these are."""
        if self.input_type in KEYPOINT_TYPES:
            return "frame"
        return cast("InputAxes", self.input_axes)


def _names_a_folder(path: str) -> bool:
    try:
        return "\0" not in path and Path(path).expanduser().absolute().name != ""
    except (OSError, RuntimeError):  # the working directory is gone, the home of a user who doesn't exist
        return False


def listing(kind: type) -> str:
    """The parameters, one per line."""
    lines = ["parameters:"]
    for name, one in specs_of(kind).items():
        choices = f" One of {', '.join(one.choices)}." if one.choices else ""
        lines.append(f"  {name:<20}{one.description}{choices} Default: {one.default!r}")
    return "\n".join(lines)


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
        is_text = is_list and kind is not str and isinstance(value, str)  # `ros2 param set` makes this of mixed numbers
        hint = f": no value, or {hint}" if value is None and is_list else f": {hint}" * is_text  # ROS itself makes None
        raise SettingsError(f"{name}: wanted {wanted}, got {value!r}{hint}")
    convert = expanded if spec.is_path else kind
    return tuple(map(convert, items)) if is_list else convert(value)


def _is_of(kind: type, value: Any) -> bool:
    if not isinstance(value, _TYPES[kind][1]) or isinstance(value, bool) != (kind is bool):
        return False
    return not isinstance(value, int) or abs(value) < 2**64  # as ROS has them; longer ones don't even fit a float
