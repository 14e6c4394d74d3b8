"""Meshes with their triangles as indices, and openings of garments, in CDR.

For planners: shape_msgs/Mesh and moveit_msgs/CollisionObject. For Foxglove: foxglove_msgs/SceneUpdate, a third of
the size of a MarkerArray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_adapters.axes import WORLD_FRAME
from msg_adapters.cdr import CdrWriter
from msg_adapters.errors import EncodeError
from msg_adapters.markers import LINE_STRIP, MarkerMesh, encode_lists, finite_points, triangles
from msg_adapters.transforms import Placement, Transform, encode_transforms, quaternion_from_matrix

MESH = "shape_msgs/msg/Mesh"
COLLISION_OBJECT = "moveit_msgs/msg/CollisionObject"
_ADD, _REMOVE = 0, 1


def encode_mesh(vertices: ArrayLike, faces: ArrayLike) -> bytes:
    """A `shape_msgs/Mesh` of vertices [m], shape (V, 3), and triangles, shape (F, 3): it has no header.

    Raises `EncodeError` for arrays of other shapes, for vertices that aren't finite, and for faces of missing vertices.
    """
    writer = CdrWriter()
    _mesh(writer, vertices, faces)
    return writer.to_bytes()


def encode_collision_object(
    name: str,
    *,
    stamp_ns: int,
    frame_id: str = WORLD_FRAME,
    placement: Placement | None = None,
    mesh: tuple[ArrayLike, ArrayLike] | None = None,
    subframes: Mapping[str, Placement] | None = None,
) -> bytes:
    """A `moveit_msgs/CollisionObject`, as MoveIt's planning scene takes it.

    `mesh` is vertices relative to the object [m], shape (V, 3), and triangles, shape (F, 3), which replace those of an
    object of this name; without it the object is removed. `placement` is the object's in `frame_id`, `subframes` are
    relative to the object; MoveIt plans to `<object>/<name>`. Raises `EncodeError` for an invalid mesh.
    """
    writer = CdrWriter()
    frames = subframes or {}
    writer.fields("Ts", stamp_ns, frame_id)
    _pose(writer, placement or Placement())
    writer.fields("sssII", name, "", "", 0, 0)  # id, type, primitives, primitive_poses
    if mesh is None:
        writer.fields("II", 0, 0)  # meshes, mesh_poses
    else:
        writer.fields("I", 1)
        _mesh(writer, *mesh)
        writer.fields("I", 1)
        _pose(writer, Placement())
    writer.fields("II", 0, 0)  # planes, plane_poses
    writer.strings([*frames])
    writer.fields("I", len(frames))
    for frame in frames.values():
        _pose(writer, frame)
    writer.fields("B", _REMOVE if mesh is None else _ADD)
    return writer.to_bytes()


def _pose(writer: CdrWriter, placement: Placement) -> None:
    writer.array("f8", placement.translation)
    writer.array("f8", quaternion_from_matrix(placement.rotation))


def _mesh(writer: CdrWriter, vertices: ArrayLike, faces: ArrayLike) -> None:
    points = finite_points("mesh", vertices)
    writer.sequence("u4", triangles("mesh", faces, len(points)))
    writer.sequence("f8", points)


SCENE_UPDATE = "foxglove_msgs/msg/SceneUpdate"
_MATCHING_ID = 0
_IDENTITY = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Entity:
    """One mesh of a scene; its id is the mesh's `ns`."""

    mesh: MarkerMesh
    vertices: NDArray[np.floating]
    """[m] relative to `position`, in the axes of the frame, shape (V, 3)."""
    position: NDArray[np.float64]
    """[m] in the frame, shape (3,)."""
    stamp_ns: int


def encode_scene(
    entities: Sequence[Entity],
    *,
    deleted: Sequence[str] = (),
    stamp_ns: int = 0,
    frame_id: str = WORLD_FRAME,
    lifetime_ns: int = 0,
) -> bytes:
    """A `foxglove_msgs/SceneUpdate`: it shows the entities and removes those named in `deleted`.

    `stamp_ns` is the time of the deletions [ns]; viewers forget what isn't renewed for `lifetime_ns`, 0: never.
    Raises `EncodeError` for vertices that aren't finite, a wrong number of them, and a stamp that fits no ROS time.
    """
    writer = CdrWriter()
    writer.fields("I", len(deleted))
    for name in deleted:
        writer.fields("TBs", stamp_ns, _MATCHING_ID, name)
    writer.fields("I", len(entities))
    for one in entities:
        mesh, vertices = one.mesh, finite_points(one.mesh.ns, one.vertices)
        if len(vertices) != mesh.n_vertices:
            raise EncodeError(f"{mesh.ns}: wanted {mesh.n_vertices} vertices, got {len(vertices)}")
        writer.fields("TssT?", one.stamp_ns, frame_id, mesh.ns, lifetime_ns, False)  # frame_locked
        writer.fields("IIIIII", *[0] * 6)  # metadata, arrows, cubes, spheres, cylinders, lines
        writer.fields("I", 1)
        writer.array("f8", [*one.position, *_IDENTITY])
        writer.sequence("f8", vertices)
        writer.array("f8", mesh.color)
        writer.fields("I", 0)  # colors
        writer.sequence("u4", mesh.faces.ravel())
        writer.fields("II", 0, 0)  # texts, models
    return writer.to_bytes()


POLYGON = "geometry_msgs/msg/PolygonStamped"
_COLOR, _WIDTH_M = (0.95, 0.55, 0.1, 1.0), 0.004


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
