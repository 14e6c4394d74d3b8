"""sensor_msgs/CameraInfo: what a camera sees of the world, without distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msg_adapters.cdr import Buffer, CdrReader
from msg_adapters.errors import DecodeError

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_MOST_PIXELS = 1 << 15
"""Largest width or height of a picture: what the camera sees is drawn into one, which has to fit into memory."""
_LARGEST = 1e9
"""Largest focal length, and distance to the centre [pixels]: with more, places in the picture overflow float32."""


@dataclass(frozen=True)
class Camera:
    """A calibrated camera; its frame is an optical one: x to the right, y down, z forward."""

    frame_id: str
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    focal: tuple[float, float]
    """fx and fy [pixels]."""
    centre: tuple[float, float]
    """cx and cy [pixels] from the picture's corner; a CameraInfo has them from the middle of the first pixel."""


def decode_camera_info(data: Buffer) -> Camera:
    """The camera of a `sensor_msgs/CameraInfo` in CDR. Raises `DecodeError` if it is uncalibrated or too large."""
    reader = CdrReader(data)
    _, frame_id, height, width, _ = reader.fields("TsIIs")
    reader.array("f8", reader.length(item_bytes=8))
    k = reader.array("f8", 9 + 9 + 12)  # k, r, p
    reader.fields("IIIIII?")  # binning, region of interest
    reader.finish()
    focal, centre = (float(k[0]), float(k[4])), (float(k[2]) + 0.5, float(k[5]) + 0.5)
    sizes = 0 < width <= _MOST_PIXELS and 0 < height <= _MOST_PIXELS
    if not ((np.abs(k[:9]) <= _LARGEST).all() and min(focal) > 1 / _LARGEST and sizes):
        msg = f"the camera in {frame_id!r} isn't calibrated: {width} x {height} pixels, focal lengths {focal}"
        raise DecodeError(msg)
    return Camera(frame_id.lstrip("/"), width, height, focal, centre)
