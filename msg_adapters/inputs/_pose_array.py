"""geometry_msgs/PoseArray: SMPL's 24 local rotations as quaternions; the first pose's position is the translation.

The other positions aren't read (bone lengths come from the betas, which this type doesn't carry: they are zero).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.cdr import Buffer, CdrReader, CdrWriter
from msg_adapters.errors import DecodeError
from msg_adapters.inputs._frame import decoding, reading_fields, smpl_frame, stamp_ns_of
from msg_adapters.joints import SMPL_JOINTS
from msg_adapters.rotations import quaternion_from_rotvec, rotvec_from_quaternion
from refu_core.frames import N_JOINTS, SmplFrame

MESSAGE_TYPE = "geometry_msgs/msg/PoseArray"
_POSE_NUMBERS = 7  # position xyz, orientation xyzw
_MIN_NORM = 1e-6


def _frame(poses: NDArray[np.float64], stamp_ns: int) -> SmplFrame:
    """The frame of poses, shape (24, 7): position [m] and quaternion xyzw."""
    quaternions = poses[:, 3:]
    for joint, quaternion in zip(SMPL_JOINTS, quaternions, strict=True):
        if not np.isfinite(quaternion).all() or np.abs(quaternion).max() < _MIN_NORM:
            msg = f"the orientation of {joint} isn't a rotation: {quaternion.tolist()}; an identity is (0, 0, 0, 1)"
            raise DecodeError(msg)
    return smpl_frame(rotvec_from_quaternion(quaternions), None, poses[0, :3], stamp_ns=stamp_ns)


def _check_count(count: int) -> None:
    if count != N_JOINTS:
        msg = (
            f"wanted {N_JOINTS} poses, one for each joint of SMPL, got {count}; points of a tracker are the input type "
            "keypoint_poses"
        )
        raise DecodeError(msg)


def from_bytes(data: Buffer) -> SmplFrame:
    """The frame of a message in CDR; quaternions are normalised."""
    with decoding(MESSAGE_TYPE):
        reader = CdrReader(data)
        stamp_ns, _ = reader.fields("Ts")
        _check_count(reader.length(item_bytes=_POSE_NUMBERS * 8))
        poses = reader.array("f8", N_JOINTS * _POSE_NUMBERS).reshape(N_JOINTS, _POSE_NUMBERS)
        reader.finish()
        return _frame(poses.astype(np.float64), stamp_ns)


def from_message(message: Any) -> SmplFrame:
    """The frame of a message object; quaternions are normalised."""
    with decoding(MESSAGE_TYPE):
        with reading_fields(message):
            stamp_ns = stamp_ns_of(message.header)
            _check_count(len(message.poses))
            pairs = [(pose.position, pose.orientation) for pose in message.poses]
            poses = np.array([(p.x, p.y, p.z, q.x, q.y, q.z, q.w) for p, q in pairs], dtype=np.float64)
        return _frame(poses, stamp_ns)


def to_bytes(frame: SmplFrame, *, frame_id: str = "map") -> bytes:
    """The message in CDR; the betas aren't in it."""
    poses = np.zeros((N_JOINTS, _POSE_NUMBERS))
    poses[0, :3] = frame.transl
    poses[:, 3:] = quaternion_from_rotvec(frame.pose)
    writer = CdrWriter()
    writer.fields("Ts", frame.stamp_ns, frame_id)
    writer.sequence("f8", poses)
    return writer.to_bytes()
