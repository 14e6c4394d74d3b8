"""sensor_msgs/JointState: rotation vector components as joints `<joint>_x|y|z` [rad], in any order, or ROS4HRI's.

Optional entries: `beta_0` ... `beta_9` (those left out are zero) and `transl_x|y|z` [m] (all three or none). Names of
other joints (a jaw, fingers) are ignored; `velocity` and `effort` aren't read.

ROS4HRI's are 20 angles, `<joint>_<id>` for each of `AXES`: those of its `human_description` (REP-155), as
`hri_body_detect` publishes them. It has no spine, collars, wrists, ankles or root: the waist's angle is spread
over SMPL's three spine joints, the head's over neck and head, and the others stay at rest. The person stands upright in
the frame `body_<id>`, with the pelvis at its origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters.axes import WORLD_FRAME, vertices_smpl_from_ros
from msg_adapters.cdr import Buffer, CdrReader, CdrWriter
from msg_adapters.errors import DecodeError, decoding
from refu_core.frames import MAX_ANGLE, N_BETAS, SmplFrame
from refu_core.recordings import PELVIS
from refu_core.skeleton import JOINT_NAMES

MESSAGE_TYPE = "sensor_msgs/msg/JointState"
_POSE_NAMES = tuple(f"{joint}_{axis}" for joint in JOINT_NAMES for axis in "xyz")
_BETA_NAMES = tuple(f"beta_{i}" for i in range(N_BETAS))
_TRANSL_NAMES = tuple(f"transl_{axis}" for axis in "xyz")
_NAMES = (*_POSE_NAMES, *_BETA_NAMES, *_TRANSL_NAMES)
_SLOTS = {name: slot for slot, name in enumerate(_NAMES)}
_SHOWN = 6
_MOST_REMEMBERED = 1 << 16  # bytes of names; SMPL's are 1.5 kB

AXES = {
    "waist": (0, 1, 0), "r_head": (1, 0, 0), "y_head": (0, 0, 1), "p_head": (0, -1, 0),
    "l_y_shoulder": (0, 0, -1), "l_p_shoulder": (1, 0, 0), "l_r_shoulder": (0, 0, 1), "l_elbow": (0, -1, 0),
    "r_y_shoulder": (0, 0, 1), "r_p_shoulder": (-1, 0, 0), "r_r_shoulder": (0, 0, -1), "r_elbow": (0, -1, 0),
    "l_y_hip": (0, 0, -1), "l_p_hip": (1, 0, 0), "l_r_hip": (0, -1, 0), "l_knee": (0, -1, 0),
    "r_y_hip": (0, 0, -1), "r_p_hip": (-1, 0, 0), "r_r_hip": (0, -1, 0), "r_knee": (0, -1, 0),
}  # fmt: skip
"""Axis of each joint in ROS axes, as in the URDF; each limb is listed from the trunk outwards."""


def _joints(*names: str) -> list[int]:
    return [JOINT_NAMES.index(name) for name in names]


_AXES = vertices_smpl_from_ros(np.array([*AXES.values()], np.float64))
_SPINE, _HEAD = _joints("spine1", "spine2", "spine3"), _joints("neck", "head")
_BALLS = _joints("left_shoulder", "right_shoulder", "left_hip", "right_hip")
_HINGES = _joints("left_elbow", "right_elbow", "left_knee", "right_knee")
_REST = Rotation.from_rotvec([[0, 0, -np.pi / 2], [0, 0, np.pi / 2], [0, 0, 0], [0, 0, 0]])
"""Rotations from SMPL's limbs at rest, where the arms point sideways, to ROS4HRI's, where they hang."""


def _body_in(names: Sequence[str]) -> str | None:
    """The id of the body whose joints these are, None for other names; raises `DecodeError` for several bodies."""
    bodies = [name.removeprefix("waist_") for name in names if name.startswith("waist_")]
    if len(bodies) > 1:
        raise DecodeError(f"wanted the joints of one body, got {len(bodies)} names that begin with waist_")
    return bodies[0] if bodies else None


def _pose_of(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vectors of SMPL's joints [rad], shape (24, 3), from the angles of `AXES` [rad], shape (20,).

    Raises `DecodeError` for an angle that isn't finite, or larger than any joint's.
    """
    bad = np.flatnonzero(~(np.abs(angles) <= MAX_ANGLE))
    if bad.size:
        raise DecodeError(f"{[*AXES][bad[0]]} has the angle {angles[bad[0]]:g}, wanted radians")
    vectors = angles[:, None] * _AXES
    turns = Rotation.from_rotvec(vectors)
    first, second, third, hinge = (turns[4 + joint :: 4] for joint in range(4))  # of the four limbs
    pose = np.zeros((len(JOINT_NAMES), 3))
    pose[_SPINE] = vectors[0] / len(_SPINE)
    pose[_HEAD] = (turns[1] * turns[2] * turns[3]).as_rotvec() / len(_HEAD)
    pose[_BALLS] = (first * second * third * _REST).as_rotvec()
    pose[_HINGES] = (_REST.inv() * hinge * _REST).as_rotvec()
    return pose


@dataclass(frozen=True, eq=False)
class _Layout:
    """Which position holds which value, from the names of a message."""

    n_names: int
    given: NDArray[np.intp]
    """Positions that are read, in the order of the message."""
    slots: NDArray[np.intp]
    """Their places in `_NAMES`, or in `AXES`; one for each of `given`."""
    is_ros4hri: bool

    @classmethod
    def of(cls, names: Sequence[str]) -> _Layout:
        """The layout of a message with these names. Raises `DecodeError` if they make no body."""
        body = None if any(name in _SLOTS for name in names) else _body_in(names)
        if body is not None:
            slots = {f"{joint}_{body}": slot for slot, joint in enumerate(AXES)}
            required, what = tuple(slots), f"wanted the {len(slots)} joints of ROS4HRI's human_description"
        else:
            slots, required = _SLOTS, _POSE_NAMES
            what = "wanted x, y, z of 24 joints, or ROS4HRI's waist_<id> and the others"
            misspelt = [name for name in names if name.startswith(("beta", "transl")) and name not in _SLOTS]
            if misspelt:  # if ignored, they would silently leave these values at zero
                known = f"beta_0 ... beta_{N_BETAS - 1} and transl_x, transl_y, transl_z"
                raise DecodeError(f"unknown name {misspelt[0]!r}; wanted {known}")
        places: dict[str, tuple[int, int]] = {}
        for position, name in enumerate(names):
            if name in places:
                raise DecodeError(f"the name {name} occurs twice")
            if name in slots:
                places[name] = position, slots[name]
        if missing := [name for name in required if name not in places]:
            more = f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
            msg = f"{len(missing)} of {len(required)} names are missing: {', '.join(missing[:_SHOWN])}{more}; {what}"
            raise DecodeError(msg)
        n_transl = sum(name in places for name in _TRANSL_NAMES)
        if n_transl not in (0, len(_TRANSL_NAMES)):
            raise DecodeError(f"{n_transl} of transl_x, transl_y, transl_z given; wanted all three or none")
        given, wanted = zip(*places.values(), strict=True)
        return cls(len(names), np.array(given, np.intp), np.array(wanted, np.intp), body is not None)

    def frame(self, position: NDArray[Any], stamp_ns: int) -> SmplFrame:
        """The frame of a message's positions, one for each name."""
        values: NDArray[Any] = np.zeros(len(_NAMES))
        values[self.slots] = position[self.given]
        if self.is_ros4hri:
            turns: NDArray[Any] = _pose_of(values[: len(AXES)])
            return SmplFrame(turns, transl=-PELVIS, stamp_ns=stamp_ns)
        pose, betas, transl = np.split(values, [len(_POSE_NAMES), -len(_TRANSL_NAMES)])
        return SmplFrame(pose, betas, transl, stamp_ns=stamp_ns)


_last: tuple[tuple[str, bytes], _Layout] | None = None
"""The last message's names and their layout: reading 85 strings takes four times as long as the rest of a message, and
a sender names its joints the same way in all of its messages."""


def from_bytes(data: Buffer) -> SmplFrame:
    global _last  # a single assignment: another thread's at the same time does no harm
    with decoding(MESSAGE_TYPE):
        reader, last = CdrReader(data), _last
        stamp_ns, _ = reader.fields("Ts")
        reader.align(4)
        place = reader.place
        if last is not None and reader.repeats(last[0]):
            layout = last[1]
        else:
            layout = _Layout.of(reader.strings())
            raw = reader.since(place)
            if len(raw[1]) <= _MOST_REMEMBERED:
                _last = raw, layout
        position = reader.array("f8", reader.length(item_bytes=8))
        for _ in ("velocity", "effort"):
            reader.array("f8", reader.length(item_bytes=8))
        reader.finish()
        if layout.n_names != position.size:
            msg = f"{layout.n_names} names but {position.size} positions; each name needs its angle in position"
            raise DecodeError(msg)
        return layout.frame(position, stamp_ns)


def body_of(data: Buffer) -> str | None:
    """The id of the ROS4HRI body in a message that could be decoded; None if its joints are SMPL's."""
    reader, names = CdrReader(data), []
    reader.fields("Ts")
    for _ in reader.items(item_bytes=4):
        names.append(reader.string())
        if names[-1] in _SLOTS:  # usually the first one already is
            return None
    return _body_in(names)


def to_bytes(frame: SmplFrame, *, frame_id: str = WORLD_FRAME) -> bytes:
    """The message in CDR, with betas and translation."""
    writer = CdrWriter()
    writer.fields("Ts", frame.stamp_ns, frame_id)
    writer.strings(_NAMES)
    writer.sequence("f8", np.concatenate([frame.pose.ravel(), frame.betas, frame.transl]))
    writer.fields("II", 0, 0)  # velocity, effort
    return writer.to_bytes()
