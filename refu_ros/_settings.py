"""The node's parameters: what each means, what it may be, and whether it may change while the node runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from msg_adapters import INPUT_TYPES, KEYPOINT_TYPES, POINT_FIELDS, WORLD_FRAME, InputAxes
from refu_core.keypoints import LAYOUTS
from refu_core.options import DressOptions, SettingsError, check, fixed, setting
from refu_ros._parameters import coerced

_PERSON = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,99}")
_FRAME = re.compile(r"[^/\s\x00-\x1f\x7f][^\s\x00-\x1f\x7f]{0,254}")
_SLOWEST_HZ = 0.01
AXES = ("smpl", "frame")


def require_persons(persons: Sequence[str]) -> list[str]:
    """Those of the persons that have a name. Raises `SettingsError` unless names are distinct and good for topics."""
    named = [*filter(None, persons)]
    if not all(map(_PERSON.fullmatch, named)) or len(set(persons)) < len(persons):
        raise SettingsError(f"persons: wanted distinct names of letters, digits and underscores, got {list(persons)}")
    return named


@dataclass(frozen=True, kw_only=True)
class NodeSettings(DressOptions):
    """The node's parameters: each field is the parameter of the same name.

    Raises `SettingsError` for a value out of range and for values that can't go together.
    """

    threads: int = fixed(2, "Frames, or people of a frame, processed at once; on a GPU people alone.", within=(1, 64))
    on_device_loss: str = setting(
        "cpu", "When the device fails: go on on the cpu, with an ERROR, or stop the node.", choices=("cpu", "stop")
    )
    input_type: str = fixed(
        "multiarray", "Message type and layout of smpl_params.", choices=(*INPUT_TYPES, *KEYPOINT_TYPES)
    )
    keypoints: str = setting(
        "zed38", "Which points of the body the tracker sends, where input_type is of keypoints.", choices=LAYOUTS
    )
    keypoint_rate: float = fixed(
        0.0, "Poses of keypoints, predicted, so many a second; 0 for one a message [Hz].", within=(0.0, 240.0)
    )
    keypoint_smoothing: float = setting(
        1.0, "How much smoother than people usually move poses of keypoints are: 2 is later.", within=(0.1, 10.0)
    )
    input_axes: str = setting(
        "smpl", "Axes of the root: smpl (y up; turned into ROS axes) or frame (those of frame_id).", choices=AXES
    )
    frame_id: str = setting(WORLD_FRAME, "Frame of all that comes out; inputs of other frames are transformed (tf2).")
    transform_tolerance: float = setting(
        0.1,
        "An input waits so long for its transform, and then takes one as much older [s]; or is dropped.",
        within=(0.0, 10.0),
    )
    points_fields: tuple[str, ...] = setting(
        POINT_FIELDS, f"What the points have besides x, y and z: of {', '.join(POINT_FIELDS)}."
    )
    camera_info: str = fixed("", "A camera's CameraInfo topic: points then say whether it sees them; empty for none.")
    planner_rate: float = setting(
        5.0, "Meshes for planners: at most so many a second of each garment; 0 for no limit [Hz].", within=(0.0, 1e3)
    )
    publish_tf: bool = fixed(
        False, "Whether openings are frames on /tf, too; whoever listens there is then a reason to compute."
    )
    persons: tuple[str, ...] = fixed(
        ("",), "Persons, each with a topic <person>/smpl_params; one without a name listens to smpl_params."
    )
    follow_humans: bool = fixed(
        False, "Dress everybody with a topic /humans/bodies/<id>/joint_states (REP-155); needs joint_state."
    )
    person_timeout: float = setting(
        1.0, "A person who hasn't sent for so long leaves the scene [s].", within=(0.05, 3600.0)
    )
    max_rate: float = setting(0.0, "At most so many frames a second; 0 for no limit [Hz].", within=(0.0, 1e3))
    marker_lifetime: float = setting(
        2.0, "Viewers drop a garment that isn't renewed for so long; 0 for never [s].", within=(0.0, 1e6)
    )
    max_distance: float = setting(
        0.0, "A person farther from the origin of frame_id isn't dressed; 0 for no limit [m].", within=(0.0, 1e6)
    )
    record: str = setting("", "Directory that inputs and outputs are recorded to as a bag; empty for none.")
    record_sync_period: float = fixed(
        1.0, "A power cut takes no more than so much of a recording; 0 for no promise [s].", within=(0.0, 3600.0)
    )
    bags: str = fixed("", "Folder that requests may name bags in (refu_msgs); empty: they may name none.")
    lazy: bool = fixed(
        True, "Whether the inputs are subscribed to only while somebody wants the output, or it is recorded."
    )
    autostart: bool = fixed(True, "Whether the node configures and activates itself.")

    def __post_init__(self) -> None:
        check(self)
        named = require_persons(self.persons)
        if not self.persons or (len(named) < len(self.persons) > 1):
            msg = f"persons: wanted one person without a name, or names for all, got {list(self.persons)}"
            raise SettingsError(msg)
        if self.follow_humans and self.input_type != "joint_state":
            msg = f"follow_humans: REP-155 has bodies as joint_state, but input_type is {self.input_type}"
            raise SettingsError(msg)
        if unknown := sorted(set(self.points_fields) - {"", *POINT_FIELDS}):
            raise SettingsError(f"points_fields: wanted names of {', '.join(POINT_FIELDS)}, got {', '.join(unknown)}")
        if not _FRAME.fullmatch(self.frame_id):
            msg = f"frame_id: wanted a name as tf2 has them, without a leading slash or spaces, got {self.frame_id!r}"
            raise SettingsError(msg)
        for name, path in (("record", self.record), ("weights", self.weights), ("bags", self.bags)):
            if path and not _names_a_folder(path):
                raise SettingsError(f"{name}: wanted the path of a folder, got {path!r}")
        if 0 < self.max_rate < _SLOWEST_HZ:
            raise SettingsError(f"max_rate: wanted {_SLOWEST_HZ:g} to 1000, or 0 for no limit, got {self.max_rate:g}")
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
    except RuntimeError:  # the home of a user who doesn't exist
        return False
