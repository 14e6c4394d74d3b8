"""visualization_msgs/MarkerArray with one TRIANGLE_LIST or POINTS per garment, between arrays and CDR bytes.

To encode, the message is laid out once, and each frame writes its points into place; to decode, nothing is copied.
Building a message of 57,000 `Point` objects and serialising it takes hundreds of milliseconds; gathering the vertices
of all triangle corners straight into the message's bytes takes a fraction of one.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from msg_adapters.axes import SMPL_COLUMNS, WORLD_FRAME, InputAxes
from msg_adapters.cdr import HEADER_BYTES, Buffer, CdrReader, CdrWriter, split_stamp
from msg_adapters.errors import DecodeError, EncodeError
from refu_core._numbers import NOT_NUMBERS, as_numbers, as_whole

Rgba = tuple[float, float, float, float]
CLOTH: Rgba = (0.55, 0.63, 0.75, 1.0)
SKIN: Rgba = (0.80, 0.67, 0.58, 1.0)


def numbers(what: str, values: Any) -> NDArray[Any]:
    """Real numbers as an array; raises `EncodeError` for anything else."""
    try:
        array = as_numbers(values)
    except NOT_NUMBERS as error:
        raise EncodeError(f"{what}: wanted an array of numbers, got {type(values).__name__}: {error}") from None
    if array.dtype.kind not in "iuf":
        raise EncodeError(f"{what}: wanted an array of numbers, got {array.dtype} of shape {array.shape}")
    return array


def finite_points(what: str, values: ArrayLike) -> NDArray[Any]:
    """Finite points as an array of shape (K, 3), K > 0. Raises `EncodeError` for anything else."""
    points = numbers(what, values)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise EncodeError(f"{what}: wanted finite points of shape (K, 3), K > 0, got {points.shape}")
    return points


def triangles(what: str, faces: ArrayLike, n_vertices: int) -> NDArray[np.integer[Any]]:
    """Faces as an array of shape (F, 3), F > 0. Raises `EncodeError` for other shapes and missing vertices."""
    array = numbers(f"{what}: faces", faces)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array) or array.dtype.kind not in "iu":
        msg = f"{what}: wanted faces of shape (F, 3) of integers, F > 0, got {array.shape} of {array.dtype}"
        raise EncodeError(msg)
    if array.min() < 0 or array.max() >= n_vertices:
        raise EncodeError(f"{what}: wanted face indices in [0, {n_vertices}), got {array.min()} ... {array.max()}")
    return array


def garment_namespace(garment: str, person: str = "") -> str:
    """Namespace of a garment's marker: `<person>/<garment>`, or the garment's name where there is one person."""
    return f"{person}/{garment}" if person else garment


@dataclass(frozen=True, eq=False)
class MarkerMesh:
    """Topology, name and colour of one marker.

    Raises `EncodeError` when faces or colour can't be drawn: viewers silently drop such a marker.
    """

    ns: str
    """Namespace; it names the marker, whose id is 0."""
    faces: NDArray[np.integer[Any]]
    """Vertex indices of the triangles, shape (F, 3), F > 0."""
    n_vertices: int
    """Number of vertices each frame will bring."""
    color: Rgba = CLOTH
    """Red, green, blue, alpha in [0, 1]."""

    def __post_init__(self) -> None:
        if not isinstance(self.ns, str):
            raise EncodeError(f"wanted a marker's namespace, got {type(self.ns).__name__}")
        try:
            n_vertices = as_whole(self.n_vertices)
        except NOT_NUMBERS as error:
            raise EncodeError(f"{self.ns}: wanted a number of vertices, got {self.n_vertices!r}") from error
        vars(self).update(n_vertices=n_vertices, faces=triangles(self.ns, self.faces, n_vertices))
        color = numbers(f"{self.ns}: colour", self.color)
        if color.shape != (4,) or not ((color >= 0) & (color <= 1)).all():
            msg = f"{self.ns}: wanted a colour of 4 numbers in [0, 1] (red, green, blue, alpha), got {self.color}"
            raise EncodeError(msg)


MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"

LINE_STRIP, POINTS, TRIANGLE_LIST = 4, 8, 11
ADD, DELETE, DELETE_ALL = 0, 2, 3
_IDENTITY_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_LEAD_BYTES = 4  # before the header, so that the payload, and with it every float64, lies on a multiple of 8
_NO_POINTS = np.zeros((0, 3))


def _write_marker(
    writer: CdrWriter,
    *,
    ns: str,
    frame_id: str,
    action: int = ADD,
    stamp_ns: int = 0,
    color: Rgba = (0.0, 0.0, 0.0, 0.0),
    points: NDArray[Any] = _NO_POINTS,
    kind: int = TRIANGLE_LIST,
    size: float = 1.0,
    lifetime_ns: int = 0,
    pose: Sequence[float] = _IDENTITY_POSE,
) -> tuple[int, int]:
    """Append one visualization_msgs/Marker; returns the payload offsets of its stamp and points."""
    stamp_at = writer.fields("Tssiii", stamp_ns, frame_id, ns, 0, kind, action)  # 0: id
    writer.fields("ddddddddddffff", *pose, size, size, size, *color)
    writer.fields("T?", lifetime_ns, False)  # frame_locked
    writer.fields("I", len(points))
    points_at = writer.array("f8", points)
    writer.fields("IsTssI", 0, "", 0, "", "", 0)  # colors, texture_resource, texture
    writer.fields("IsssI?", 0, "", "", "", 0, False)  # uv_coordinates, text, mesh_resource, mesh_file and its materials
    return stamp_at, points_at


class _Slot(NamedTuple):
    """Where a marker's changing parts lie, as views into the message."""

    mesh: MarkerMesh
    corners: NDArray[np.intp]
    """Vertex of each triangle corner, shape (3F,)."""
    stamp_at: int
    points: NDArray[np.float64]
    """Shape (3F, 3)."""
    placed: NDArray[np.float64]
    """Vertices in the axes of the message, shape (V, 3): scratch space."""


class MarkerArrayEncoder:
    """Encodes frames of a fixed set of meshes as `visualization_msgs/MarkerArray` in CDR.

    One encoder serves one thread at a time. Viewers forget a mesh that isn't renewed for `lifetime_ns`; 0: never.

    Raises `EncodeError` for no mesh at all, and for two meshes of one namespace.
    """

    def __init__(
        self,
        meshes: Sequence[MarkerMesh],
        *,
        frame_id: str = WORLD_FRAME,
        axes: InputAxes = "smpl",
        lifetime_ns: int = 0,
    ) -> None:
        names = [mesh.ns for mesh in meshes]
        if not names or len(set(names)) != len(names):
            raise EncodeError(f"wanted meshes with distinct namespaces, got {names}")
        if axes not in SMPL_COLUMNS:
            raise EncodeError(f"wanted axes {' or '.join(SMPL_COLUMNS)}, got {axes!r}")
        self._columns = SMPL_COLUMNS[axes]
        self._anew = partial(type(self), tuple(meshes), frame_id=frame_id, axes=axes, lifetime_ns=lifetime_ns)
        writer = CdrWriter()
        writer.fields("I", len(meshes))
        write = partial(_write_marker, writer, frame_id=frame_id, lifetime_ns=lifetime_ns)
        places = [write(ns=one.ns, color=one.color, points=np.zeros((one.faces.size, 3))) for one in meshes]
        blank = writer.to_bytes()
        # float64 storage guarantees the alignment that the views below rely on.
        storage = np.zeros(-(-(_LEAD_BYTES + len(blank)) // 8), np.float64).view(np.uint8)
        self._message = storage[_LEAD_BYTES : _LEAD_BYTES + len(blank)]
        self._message[:] = np.frombuffer(blank, np.uint8)
        payload = self._message[HEADER_BYTES:]
        self._payload = payload.data
        self._slots = []
        for mesh, (stamp_at, points_at) in zip(meshes, places, strict=True):
            corners = np.ascontiguousarray(mesh.faces, dtype=np.intp).reshape(-1)
            points = payload[points_at : points_at + corners.size * 24].view("<f8").reshape(-1, 3)
            self._slots.append(_Slot(mesh, corners, stamp_at, points, np.empty((mesh.n_vertices, 3))))

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy, or what another process gets, is made anew: views of a message don't stay views of it."""
        return self._anew, ()

    def encode(
        self, vertices: Sequence[ArrayLike], *, stamp_ns: int | Sequence[int], transl: ArrayLike | None = None
    ) -> bytes:
        """One frame. Raises `EncodeError` for a wrong shape, a vertex that isn't finite, a stamp that fits no ROS time.

        Args:
            vertices: for each mesh its vertices [m], shape (V, 3), float32 or float64, in SMPL axes (or, with
                `axes="frame"`, in the axes of the frame).
            stamp_ns: time of the measurement [ns], one for all meshes or one for each.
            transl: added in float64 [m], in the same axes: shape (3,) for all meshes or (M, 3) for each.
        """
        n = len(self._slots)
        if len(vertices) != n:
            raise EncodeError(f"wanted vertices of {n} meshes, got {len(vertices)}")
        each: Any = stamp_ns if np.ndim(stamp_ns) else [stamp_ns] * n
        stamps = [split_stamp(stamp) for stamp in each]
        if len(stamps) != n:
            raise EncodeError(f"wanted a stamp for all meshes or {n} stamps, got {len(stamps)}")
        offsets = np.zeros(3) if transl is None else numbers("transl", transl).astype(np.float64)
        if offsets.shape not in ((3,), (n, 3)):
            raise EncodeError(f"wanted a translation of shape (3,) or ({n}, 3), got {offsets.shape}")
        offsets = np.broadcast_to(offsets, (n, 3))
        for i, slot in enumerate(self._slots):
            struct.pack_into("<iI", self._payload, slot.stamp_at, *stamps[i])
            self._write_points(slot, numbers(slot.mesh.ns, vertices[i]), offsets[i])
        return self._message.tobytes()

    def _write_points(self, slot: _Slot, vertices: NDArray[Any], offset: NDArray[np.float64]) -> None:
        mesh = slot.mesh
        if vertices.shape != (mesh.n_vertices, 3) or vertices.dtype not in (np.float32, np.float64):
            wanted = f"wanted vertices ({mesh.n_vertices}, 3) of float32 or float64"
            raise EncodeError(f"{mesh.ns}: {wanted}, got {vertices.shape} of {vertices.dtype}")
        with np.errstate(invalid="ignore", over="ignore"):
            for out, column in enumerate(self._columns):
                np.add(vertices[:, column], offset[column], out=slot.placed[:, out], dtype=np.float64)
            # A sum is finite only if every term is: one pass, nothing allocated.
            total = slot.placed.sum()
        if not np.isfinite(total):
            bad = int(np.count_nonzero(~np.isfinite(slot.placed).all(axis=1)))
            msg = f"{mesh.ns}: {bad} of {mesh.n_vertices} vertices are NaN or infinite; viewers would drop the marker"
            raise EncodeError(msg)
        # mode="clip" writes in place ("raise" would buffer the output); the indices were checked with the mesh.
        np.take(slot.placed, slot.corners, axis=0, out=slot.points, mode="clip")


def encode_lists(
    kind: int,
    lists: Sequence[tuple[str, int, Sequence[float], NDArray[np.float64]]],
    *,
    frame_id: str,
    color: Rgba,
    size: float,
    lifetime_ns: int = 0,
) -> bytes:
    """A MarkerArray with one marker for each of `lists`, of type `kind`: `LINE_STRIP` or `POINTS`, `size` [m] wide.

    Each of `lists` is a namespace, a stamp [ns], a pose as position [m] and quaternion xyzw, and the points in that
    pose [m], shape (K, 3). Raises `EncodeError` where these, or the stamp, can't be in a message.
    """
    writer = CdrWriter()
    writer.fields("I", len(lists))
    write = partial(
        _write_marker, writer, frame_id=frame_id, color=color, kind=kind, size=size, lifetime_ns=lifetime_ns
    )
    for ns, stamp_ns, pose, points in lists:
        if not np.isfinite(pose).all():
            raise EncodeError(f"{ns}: wanted a finite pose, got {pose}")
        write(ns=ns, stamp_ns=stamp_ns, points=finite_points(ns, points), pose=pose)
    return writer.to_bytes()


def encode_delete(names: Sequence[str], *, stamp_ns: int, frame_id: str = WORLD_FRAME) -> bytes:
    """A MarkerArray that removes the markers of these namespaces: a person has left.

    Raises `EncodeError` when the stamp doesn't fit the message.
    """
    writer = CdrWriter()
    writer.fields("I", len(names))
    for ns in names:
        _write_marker(writer, ns=ns, action=DELETE, frame_id=frame_id, stamp_ns=stamp_ns)
    return writer.to_bytes()


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
    markers = [_marker(reader) for _ in reader.items(item_bytes=_MIN_MARKER_BYTES)]
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
