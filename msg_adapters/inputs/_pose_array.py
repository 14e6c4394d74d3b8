"""geometry_msgs/PoseArray: SMPL's 24 local rotations as quaternions; the first pose's position is the translation.

The other positions aren't read (bone lengths come from the betas, which this type doesn't carry: they are zero).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters.axes import WORLD_FRAME
from msg_adapters.cdr import Buffer, CdrReader, CdrWriter
from msg_adapters.errors import DecodeError, decoding
from refu_core.frames import N_JOINTS, SmplFrame
from refu_core.skeleton import JOINT_NAMES

MESSAGE_TYPE = "geometry_msgs/msg/PoseArray"
_POSE_NUMBERS = 7  # position xyz, orientation xyzw
_MIN_NORM = 1e-6


def read_poses(data: Buffer) -> tuple[int, str, NDArray[Any]]:
    """Stamp [ns], frame_id and poses, (K, 7), of a message in CDR."""
    reader = CdrReader(data)
    stamp_ns, frame_id = reader.fields("Ts")
    poses = reader.array("f8", reader.length(item_bytes=_POSE_NUMBERS * 8) * _POSE_NUMBERS)
    reader.finish()
    return stamp_ns, frame_id, poses.reshape(-1, _POSE_NUMBERS)


def from_bytes(data: Buffer) -> SmplFrame:
    """The frame of a message in CDR; quaternions are normalised."""
    with decoding(MESSAGE_TYPE):
        stamp_ns, _, poses = read_poses(data)
        if len(poses) != N_JOINTS:
            hint = "points of a tracker are the input type keypoint_poses"
            raise DecodeError(f"wanted {N_JOINTS} poses, one for each joint of SMPL, got {len(poses)}; {hint}")
        quaternions = poses[:, 3:].astype(np.float64)
        largest = np.abs(quaternions).max(axis=1)
        for joint in np.flatnonzero(~((largest >= _MIN_NORM) & np.isfinite(largest))):
            got = f"the orientation of {JOINT_NAMES[joint]} isn't a rotation: {quaternions[joint].tolist()}"
            raise DecodeError(f"{got}; an identity is (0, 0, 0, 1)")
        pose: NDArray[Any] = Rotation.from_quat(quaternions / largest[:, None]).as_rotvec()  # their squares are finite
        return SmplFrame(pose, transl=poses[0, :3], stamp_ns=stamp_ns)


def to_bytes(frame: SmplFrame, *, frame_id: str = WORLD_FRAME) -> bytes:
    """The message in CDR; the betas aren't in it."""
    poses = np.zeros((N_JOINTS, _POSE_NUMBERS))
    poses[0, :3] = frame.transl
    poses[:, 3:] = Rotation.from_rotvec(frame.pose).as_quat()
    writer = CdrWriter()
    writer.fields("Ts", frame.stamp_ns, frame_id)
    writer.sequence("f8", poses)
    return writer.to_bytes()
