"""MarkerArray decoding without copies, and the way back from triangle corners to vertices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters.cdr import Buffer, CdrReader
from msg_adapters.errors import DecodeError

_MIN_MARKER_BYTES = 180


@dataclass(frozen=True, eq=False)
class Marker:
    """The parts of visualization_msgs/Marker that triangle lists and points use."""

    stamp_ns: int
    frame_id: str
    ns: str
    id: int
    type: int
    action: int
    pose: tuple[float, ...]
    """Position xyz [m] and orientation xyzw."""
    scale: tuple[float, ...]
    color: tuple[float, ...]
    """Red, green, blue, alpha."""
    lifetime_ns: int
    frame_locked: bool
    points: NDArray[np.float64]
    """Triangle corners [m], shape (3F, 3), or the points of POINTS, (V, 3), in the axes of `pose`: a read-only view of
    the message."""
    colors: NDArray[np.float32]
    """Colour of each corner, shape (3F, 4), or (0, 4): a read-only view of the message."""

    def placed(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points [m], shape (N, 3), from the axes of `pose` to those of `frame_id`."""
        quaternion = np.array(self.pose[3:])
        with np.errstate(all="ignore"):  # what isn't finite stays so
            if quaternion[:3].any():  # a quaternion that nobody has set means no rotation
                if not np.isfinite(quaternion).all():
                    return np.full_like(points, np.nan)
                quaternion /= np.abs(quaternion).max()  # its square is finite, and not zero
                points = points @ Rotation.from_quat(quaternion).as_matrix().T
            return points + self.pose[:3]


def _marker(reader: CdrReader) -> Marker:
    named = reader.fields("Tssiii")
    pose, scale, color = reader.fields("ddddddd"), reader.fields("ddd"), reader.fields("ffff")
    kept = reader.fields("T?")  # lifetime, frame_locked
    points = reader.array("f8", 3 * reader.length(item_bytes=24)).reshape(-1, 3)
    colors = reader.array("f4", 4 * reader.length(item_bytes=16)).reshape(-1, 4)
    reader.fields("sTss")  # texture_resource, texture
    reader.skip(reader.length(item_bytes=1))
    reader.array("f4", 2 * reader.length(item_bytes=8))  # uv_coordinates
    reader.fields("sss")  # text, mesh_resource, mesh_file
    reader.skip(reader.length(item_bytes=1))
    reader.fields("?")  # mesh_use_embedded_materials
    return Marker(*named, pose, scale, color, *kept, points, colors)  # type: ignore[call-arg]


def decode_marker_array(data: Buffer) -> list[Marker]:
    """The markers of a `visualization_msgs/MarkerArray` in CDR; points and colours are views of `data`.

    Raises `DecodeError` for anything that isn't one.
    """
    reader = CdrReader(data)
    markers = [_marker(reader) for _ in range(reader.length(item_bytes=_MIN_MARKER_BYTES))]
    reader.finish()
    return markers


def vertices_from_points(
    points: NDArray[np.floating[Any]], faces: NDArray[np.integer[Any]], *, n_vertices: int | None = None
) -> NDArray[np.float64]:
    """Vertices, shape (V, 3), of a mesh whose triangle corners are `points`, shape (3F, 3), with known `faces`, (F, 3).

    Raises `DecodeError` when the corners can't come from these faces, or a vertex is in none.
    """
    corners = np.asarray(faces).reshape(-1)
    if points.shape != (corners.size, 3) or not corners.size:
        msg = f"wanted the ({corners.size}, 3) corners of {corners.size // 3} triangles, got points {points.shape}"
        raise DecodeError(msg)
    count = int(corners.max()) + 1 if n_vertices is None else n_vertices
    used = np.zeros(count, dtype=bool)
    used[corners] = True
    if not used.all():
        raise DecodeError(f"vertex {int(np.argmin(used))} of {count} is in no triangle; its position can't be known")
    vertices = np.empty((count, 3))
    vertices[corners] = points
    if not np.array_equal(vertices[corners], points):
        raise DecodeError("the points' shared corners differ: they were made with other faces")
    return vertices
