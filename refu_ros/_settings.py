"""The node's parameters: what each means, what it may be, and whether it may change while the node runs.

What loads torch is imported where it is needed: a mistyped parameter is to be answered before that.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from msg_adapters import INPUT_TYPES, KEYPOINT_TYPES, POINT_FIELDS, InputAxes, InputType
from refu_core import RefuError, SmplFrame
from refu_core.frames import N_JOINTS
from refu_core.keypoints import LAYOUTS
from refu_core.modes import DEFAULT_GARMENTS, DEFAULT_MARGIN, MAX_MARGIN, BackboneName, BetasSource, SdfMode
from refu_ros._parameters import ParameterSpec, SettingsError, check, coerced, defaults_of, parameter, specs_of

if TYPE_CHECKING:
    from refu_core import GarmentPipeline, GarmentTemplate

_PERSON = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,99}")
_FRAME = re.compile(r"[^/\s\x00-\x1f\x7f][^\s\x00-\x1f\x7f]{0,254}")
_SLOWEST_HZ = 0.01


@dataclass(frozen=True, kw_only=True)
class PipelineKey:
    """The settings that need another pipeline when they change."""

    garments: tuple[str, ...]
    sdf: str
    backbone: str
    weights: str
    device: str
    collider: bool
    body: str
    betas_from: str
    threads: int

    def __str__(self) -> str:
        weights = f", weights {self.weights}" if self.weights else ""
        raw = "" if self.collider else ", no collider"
        wearer = f" on {self.body or self.betas_from}" if self.body or self.betas_from else ""
        return f"{', '.join(self.garments)}{wearer} ({self.backbone}, {self.sdf}, {self.device}{weights}{raw})"

    def check(self) -> None:
        """Raises `RefuError` for what can't be loaded, as far as that shows without loading it."""
        from refu_core._device import checked_device
        from refu_core.body import BUILTIN_BODIES
        from refu_core.weights import weights_folder

        checked_device(self.device)
        for body in (self.body, self.betas_from):
            if body not in ("", *BUILTIN_BODIES) and not Path(body).is_file():
                msg = f"no body {body!r}: wanted one of {', '.join(BUILTIN_BODIES)}, or an .npz or .pkl file"
                raise SettingsError(msg)
        is_auto = self.backbone == BackboneName.AUTO
        for name in self.garments if self.backbone != BackboneName.SKINNED else ():
            folder = weights_folder(_template(name).name, self.weights or None)
            if is_auto and not self.weights and not folder.exists():
                continue  # it is worn by skinning
            backbone = BackboneName.TAILORNET if is_auto else self.backbone
            path = folder / f"{backbone}-{self.sdf}.safetensors"
            if not path.is_file():
                msg = f"no weights of {backbone} {self.sdf} for {name}: {path} is missing; train them (refu train)"
                raise SettingsError(msg)

    def load(self) -> GarmentPipeline:
        """Loads it, which takes some tenths of a second, and asks it once for all that a subscriber may want.

        Kernels are loaded when they first run, and the frames that come meanwhile would be lost. Raises `RefuError`.
        """
        from refu_core import GarmentPipeline
        from refu_core.outputs import Dressed, Fittings

        named = ((name, getattr(self, name)) for name in PIPELINE_SETTINGS)  # as `load` names them
        asked: dict[str, Any] = {name: None if value == "" else value for name, value in named}
        pipeline = GarmentPipeline.load(**asked)
        frame, fittings = (
            SmplFrame(np.zeros((N_JOINTS, 3), np.float32)),
            Fittings(pipeline, weights=self.weights or None),
        )
        worn = Dressed("", frame, pipeline(frame), fittings, np.eye(3), np.zeros(3))
        for ask in (worn.normals, worn.clearance, worn.sigma, worn.contacts):
            ask()
        return pipeline


PIPELINE_SETTINGS = tuple(item.name for item in fields(PipelineKey))
"""Parameters that need another pipeline when they change."""


@dataclass(frozen=True, kw_only=True)
class NodeSettings:
    """All parameters; each field is one, of the same name.

    Raises `SettingsError` for a value out of range and for values that can't go together.
    """

    garments: tuple[str, ...] = parameter(DEFAULT_GARMENTS, "Garments that every person wears.")
    body: str = parameter("", "Who wears them: an SMPL file, or a built-in name; empty for the garments' own.")
    betas_from: str = parameter("", "An SMPL file whose betas arrive: the built-in mesh follows them; empty for none.")
    backbone: str = parameter(
        "auto", "What predicts the garment before collisions are handled.", choices=tuple(BackboneName)
    )
    weights: str = parameter(
        "", "Folder with a folder a garment of weights of one's own (refu train); empty for those that ship."
    )
    sdf: str = parameter("hybrid", "How collisions are found.", choices=tuple(SdfMode))
    margin: float = parameter(DEFAULT_MARGIN, "Clearance that is kept from the skin [m].", low=0.0, high=MAX_MARGIN)
    collider: bool = parameter(
        True, "Bring garments off a body whose overlaps are pulled apart, which topic body shows; else off the raw one."
    )
    device: str = parameter("cpu", "Torch device: cpu or cuda.")
    threads: int = parameter(
        2,
        "So many frames, or people of a frame, are worked on at the same time; on a GPU one.",
        low=1,
        high=64,
        live=False,
    )
    on_device_loss: str = parameter(
        "cpu", "When the device fails: go on on the cpu, with an ERROR, or stop the node.", choices=("cpu", "stop")
    )
    style: tuple[float, ...] = parameter(
        (0.0,) * 4, "Garment style γ in standard deviations; zeros are the mean style.", low=-10.0, high=10.0
    )
    betas: tuple[float, ...] = parameter(
        (0.0,) * 10, "Body shape in standard deviations, where betas_source is fixed.", low=-20.0, high=20.0
    )
    betas_source: str = parameter(
        "message",
        "message: betas that arrive are of body or betas_from; builtin: of the built-in body; fixed: parameter betas.",
        choices=tuple(BetasSource),
    )
    input_type: str = parameter(
        "multiarray",
        "Message type and layout of smpl_params.",
        choices=(*INPUT_TYPES, *KEYPOINT_TYPES),
        live=False,
    )
    keypoints: str = parameter(
        "zed38", "Which points of the body the tracker sends, where input_type is of keypoints.", choices=LAYOUTS
    )
    keypoint_rate: float = parameter(
        0.0,
        "Poses of keypoints, predicted, so many a second; 0 for one a message [Hz].",
        low=0.0,
        high=240.0,
        live=False,
    )
    keypoint_smoothing: float = parameter(
        1.0,
        "How much smoother than people usually move poses of keypoints are: 2 is calmer and later.",
        low=0.1,
        high=10.0,
    )
    input_axes: str = parameter(
        "smpl",
        "Axes of root orientation and translation: smpl (y up; turned into ROS axes) or frame (those of frame_id).",
        choices=("smpl", "frame"),
    )
    frame_id: str = parameter("map", "Frame of all that comes out; inputs of other frames are transformed (tf2).")
    transform_tolerance: float = parameter(
        0.1,
        "A transform may be so much older than the input [s]; without one the input is dropped.",
        low=0.0,
        high=10.0,
    )
    points_fields: tuple[str, ...] = parameter(
        POINT_FIELDS, f"What the points have besides x, y and z: of {', '.join(POINT_FIELDS)}."
    )
    camera_info: str = parameter(
        "",
        "A camera's CameraInfo topic: points then say whether it sees them; empty for none.",
        live=False,
    )
    planner_rate: float = parameter(
        5.0, "Meshes for planners: at most so many a second of each garment; 0 for no limit [Hz].", low=0.0, high=1000.0
    )
    publish_tf: bool = parameter(
        False, "Whether openings are frames on /tf, too; whoever listens there is then a reason to compute.", live=False
    )
    persons: tuple[str, ...] = parameter(
        ("",), "Persons, each with a topic <person>/smpl_params; one without a name listens to smpl_params.", live=False
    )
    follow_humans: bool = parameter(
        False, "Dress everybody with a topic /humans/bodies/<id>/joint_states (REP-155); needs joint_state.", live=False
    )
    person_timeout: float = parameter(
        1.0, "A person who hasn't sent for so long leaves the scene [s].", low=0.05, high=3600.0
    )
    max_rate: float = parameter(0.0, "At most so many frames a second; 0 for no limit [Hz].", low=0.0, high=1000.0)
    marker_lifetime: float = parameter(
        2.0,
        "How long viewers show a garment that isn't renewed, should the node end without a word; 0 for ever [s].",
        low=0.0,
        high=1e6,
    )
    max_distance: float = parameter(
        0.0, "A person farther from the origin of frame_id isn't dressed; 0 for no limit [m].", low=0.0, high=1e6
    )
    record: str = parameter("", "Directory that inputs and outputs are recorded to as a bag; empty for none.")
    record_sync_period: float = parameter(
        1.0,
        "A power cut takes no more than so much of a recording [s]; at 0 the disk is waited for at its end alone.",
        low=0.0,
        high=3600.0,
        live=False,
    )
    bags: str = parameter(
        "", "Folder that requests may name bags in (refu_msgs); empty: they may name none.", live=False
    )
    lazy: bool = parameter(
        True,
        "Whether the inputs are subscribed to only while somebody wants the output, or it is recorded.",
        live=False,
    )
    autostart: bool = parameter(True, "Whether the node configures and activates itself.", live=False)

    def __post_init__(self) -> None:
        check(self)
        if not all(_PERSON.fullmatch(name) for name in self.persons if name) or len(set(self.persons)) < len(
            self.persons
        ):
            msg = f"persons: wanted distinct names of letters, digits and underscores, got {list(self.persons)}"
            raise SettingsError(msg)
        if not self.persons or ("" in self.persons and len(self.persons) > 1):
            msg = f"persons: wanted one person without a name, or names for all, got {list(self.persons)}"
            raise SettingsError(msg)
        if self.follow_humans and self.input_type != "joint_state":
            msg = f"follow_humans: REP-155 has bodies as joint_state, but input_type is {self.input_type}"
            raise SettingsError(msg)
        if unknown := sorted(set(self.points_fields) - {"", *POINT_FIELDS}):
            msg = f"points_fields: wanted names of {', '.join(POINT_FIELDS)}, got {', '.join(unknown)}"
            raise SettingsError(msg)
        if not _FRAME.fullmatch(self.frame_id):
            msg = f"frame_id: wanted a name as tf2 has them, without a leading slash or spaces, got {self.frame_id!r}"
            raise SettingsError(msg)
        for name, path in (("record", self.record), ("weights", self.weights), ("bags", self.bags)):
            if path and not _names_a_folder(path):
                msg = f"{name}: wanted the path of a folder, got {path!r}"
                raise SettingsError(msg)
        if 0 < self.max_rate < _SLOWEST_HZ:
            msg = f"max_rate: wanted {_SLOWEST_HZ:g} to 1000, or 0 for no limit, got {self.max_rate:g}"
            raise SettingsError(msg)
        self._check_garments()

    def _check_garments(self) -> None:
        if not self.garments or len(set(self.garments)) < len(self.garments):
            msg = f"garments: wanted distinct names, at least one, got {list(self.garments)}"
            raise SettingsError(msg)
        try:
            templates = {name: _template(name) for name in self.garments}
        except RefuError as error:
            msg = f"garments: {error}"
            raise SettingsError(msg) from error
        if not (self.body or self.betas_from) and len({template.body for template in templates.values()}) > 1:
            cut_for = ", ".join(f"{name} ({template.body})" for name, template in templates.items())
            msg = f"garments: one person wears garments of one body, got {cut_for}"
            raise SettingsError(msg)
        if any(self.style) and (plain := self.of_one_style):
            msg = f"style: {', '.join(plain)} has no styles; set it to zeros"
            raise SettingsError(msg)

    def changed(self, values: Mapping[str, Any]) -> NodeSettings:
        """These settings with some values as ROS has them (lists, numbers of any kind). Raises `SettingsError`."""
        return replace(self, **coerced(NodeSettings, values))

    @property
    def of_one_style(self) -> list[str]:
        """The garments that hear of no style."""
        return [name for name in self.garments if _template(name).styledirs is None]

    @property
    def pipeline(self) -> PipelineKey:
        """What the pipeline depends on."""
        return PipelineKey(**{name: getattr(self, name) for name in PIPELINE_SETTINGS})

    @property
    def betas_are_told(self) -> bool:
        """Whether it is known what betas that arrive are of."""
        return bool(self.body or self.betas_from) or self.betas_source != BetasSource.MESSAGE

    @property
    def lifetime_ns(self) -> int:
        """Of the markers [ns]: as asked, but never so short that somebody who is here would flicker."""
        if not self.marker_lifetime:
            return 0
        slowest = 1 / self.max_rate if self.max_rate else 0.0
        return round(1e9 * max(self.marker_lifetime, 2 * self.person_timeout, 2 * slowest))

    @property
    def axes(self) -> InputAxes:
        """`input_axes`, checked; keypoints are in the axes of `frame_id`, whichever these are."""
        if self.input_type in KEYPOINT_TYPES:
            return "frame"
        return cast("InputAxes", self.input_axes)

    @property
    def known_betas(self) -> tuple[float, ...] | None:
        """The shape of people whose keypoints come; None where the lengths of their bones tell it."""
        return self.betas if self.betas_source == "fixed" else None

    @property
    def layout(self) -> InputType:
        """`input_type`, checked."""
        return cast("InputType", self.input_type)


def specs() -> dict[str, ParameterSpec]:
    """Each parameter's specification by name."""
    return specs_of(NodeSettings)


def defaults() -> dict[str, Any]:
    """Each parameter's default by name."""
    return defaults_of(NodeSettings)


@cache
def _template(name: str) -> GarmentTemplate:
    from refu_core import load_garment

    return load_garment(name)


def _names_a_folder(path: str) -> bool:
    try:
        return "\0" not in path and Path(path).expanduser().absolute().name != ""
    except RuntimeError:  # the home of a user that there isn't
        return False
