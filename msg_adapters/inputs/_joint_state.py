"""sensor_msgs/JointState: rotation vector components as joints `<joint>_x|y|z` [rad], in any order.

Optional entries: `beta_0` ... `beta_9` (those left out are zero) and `transl_x|y|z` [m] (all three or none). Names of
other joints (a jaw, fingers) are ignored; `velocity` and `effort` aren't read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.errors import DecodeError
from msg_adapters.inputs._frame import decoding, reading_fields, smpl_frame, stamp_ns_of
from msg_adapters.joints import SMPL_JOINTS
from refu_core.frames import N_BETAS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from msg_adapters.cdr import Buffer
    from refu_core.frames import SmplFrame

MESSAGE_TYPE = "sensor_msgs/msg/JointState"
_POSE_NAMES = tuple(f"{joint}_{axis}" for joint in SMPL_JOINTS for axis in "xyz")
_BETA_NAMES = tuple(f"beta_{i}" for i in range(N_BETAS))
_TRANSL_NAMES = tuple(f"transl_{axis}" for axis in "xyz")
_NAMES = (*_POSE_NAMES, *_BETA_NAMES, *_TRANSL_NAMES)
_SLOTS = {name: slot for slot, name in enumerate(_NAMES)}
_N_POSE, _N_BETA = len(_POSE_NAMES), len(_BETA_NAMES)
_MIN_NAME_BYTES = 4
_SHOWN = 6


def _listing(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _frame(names: Sequence[str], position: NDArray[Any], stamp_ns: int) -> SmplFrame:
    if len(names) != position.size:
        msg = f"{len(names)} names but {position.size} positions; each name needs its angle in position"
        raise DecodeError(msg)
    values = np.zeros(len(_NAMES))
    seen = np.zeros(len(_NAMES), dtype=bool)
    for name, value in zip(names, position.tolist(), strict=True):
        slot = _SLOTS.get(name)
        if slot is None:
            if name.startswith(("beta", "transl")):  # a typing error here would silently leave the body at zero
                msg = f"unknown name {name!r}; wanted beta_0 ... beta_{N_BETAS - 1} and transl_x, transl_y, transl_z"
                raise DecodeError(msg)
            continue
        if seen[slot]:
            msg = f"the name {name} occurs twice"
            raise DecodeError(msg)
        seen[slot] = True
        values[slot] = value
    missing = [name for name, found in zip(_POSE_NAMES, seen, strict=False) if not found]
    if missing:
        msg = f"{len(missing)} of {_N_POSE} names are missing: {_listing(missing)}; wanted x, y, z of 24 joints"
        raise DecodeError(msg)
    transl_seen = int(np.count_nonzero(seen[_N_POSE + _N_BETA :]))
    if transl_seen not in (0, len(_TRANSL_NAMES)):
        msg = f"{transl_seen} of transl_x, transl_y, transl_z given; wanted all three or none"
        raise DecodeError(msg)
    pose, betas, transl = np.split(values, [_N_POSE, _N_POSE + _N_BETA])
    return smpl_frame(pose, betas, transl, stamp_ns=stamp_ns)


def from_bytes(data: Buffer) -> SmplFrame:
    """The frame of a message in CDR."""
    with decoding(MESSAGE_TYPE):
        reader = CdrReader(data)
        stamp_ns = reader.stamp_ns()
        reader.string()
        names = [reader.string() for _ in range(reader.length(item_bytes=_MIN_NAME_BYTES))]
        position = reader.array("f8", reader.length(item_bytes=8))
        for _ in ("velocity", "effort"):
            reader.array("f8", reader.length(item_bytes=8))
        reader.finish()
        return _frame(names, position, stamp_ns)


def from_message(message: Any) -> SmplFrame:
    """The frame of a message object."""
    with decoding(MESSAGE_TYPE):
        with reading_fields(message):
            stamp_ns = stamp_ns_of(message.header)
            names = [str(name) for name in message.name]
            position = np.asarray(message.position, dtype=np.float64).reshape(-1)
        return _frame(names, position, stamp_ns)


def to_bytes(frame: SmplFrame, *, frame_id: str = "map") -> bytes:
    """The message in CDR, with betas and translation."""
    writer = CdrWriter()
    writer.header(frame.stamp_ns, frame_id)
    writer.strings(_NAMES)
    writer.sequence("f8", np.concatenate([frame.pose.ravel(), frame.betas, frame.transl]))
    for _ in ("velocity", "effort"):
        writer.numbers("I", 0)
    return writer.to_bytes()
