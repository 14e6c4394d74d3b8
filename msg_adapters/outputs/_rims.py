"""Openings of garments: geometry_msgs/PolygonStamped, visualization_msgs/MarkerArray and tf2_msgs/TFMessage in CDR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_adapters.axes import WORLD_FRAME
from msg_adapters.cdr import CdrWriter
from msg_adapters.markers import LINE_STRIP, encode_lists, finite_points
from msg_adapters.transforms import Transform, encode_transforms, quaternion_from_matrix

POLYGON = "geometry_msgs/msg/PolygonStamped"
_COLOR, _WIDTH_M = (0.95, 0.55, 0.1, 1.0), 0.004
"""Colour and width of the lines."""


@dataclass(frozen=True, eq=False)
class Rim:
    """Where one opening of a garment is, in the axes of a header's frame."""

    name: str
    """Name of the marker's namespace and of the frame: `[<person>/]<garment>/<opening>`."""
    stamp_ns: int
    centre: NDArray[np.float64]
    """[m], shape (3,)."""
    rotation: NDArray[np.float64]
    """Columns are x, y and z of the opening, shape (3, 3): z points out of the garment."""
    ring: NDArray[np.float64]
    """Vertices of the rim in order [m], shape (K, 3)."""


def encode_polygon(ring: ArrayLike, *, stamp_ns: int, frame_id: str = WORLD_FRAME) -> bytes:
    """A `geometry_msgs/PolygonStamped` of points [m], shape (K, 3).

    Raises `EncodeError` for points that aren't finite or of another shape, and a stamp that doesn't fit a ROS time.
    """
    writer = CdrWriter()
    writer.fields("Ts", stamp_ns, frame_id)
    writer.sequence("f4", finite_points("polygon", ring))
    return writer.to_bytes()


def encode_rims(rims: Sequence[Rim], *, frame_id: str = WORLD_FRAME, lifetime_ns: int = 0) -> bytes:
    """A MarkerArray with one closed LINE_STRIP per rim; its pose is the opening's frame, and its points lie in that.

    Raises `EncodeError` for rims that can't be drawn.
    """
    strips = []
    for rim in rims:
        with np.errstate(invalid="ignore"):  # what isn't finite is refused below
            local = (rim.ring - rim.centre) @ rim.rotation
        pose = [*rim.centre.tolist(), *quaternion_from_matrix(rim.rotation).tolist()]
        strips.append((rim.name, rim.stamp_ns, pose, np.concatenate([local, local[:1]])))
    return encode_lists(LINE_STRIP, strips, frame_id=frame_id, color=_COLOR, size=_WIDTH_M, lifetime_ns=lifetime_ns)


def encode_frames(rims: Sequence[Rim], *, frame_id: str = WORLD_FRAME) -> bytes:
    """A `tf2_msgs/TFMessage` with one frame per rim. Raises `EncodeError` for a stamp that doesn't fit a ROS time."""
    return encode_transforms(
        [Transform(rim.stamp_ns, frame_id, rim.name, rim.centre, quaternion_from_matrix(rim.rotation)) for rim in rims]
    )
