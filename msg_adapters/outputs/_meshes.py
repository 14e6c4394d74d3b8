"""Meshes with their triangles as indices, in CDR.

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
from msg_adapters.markers import MarkerMesh, finite_points, triangles
from msg_adapters.transforms import Placement, quaternion_from_matrix

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

    Args:
        name: the object's id.
        stamp_ns: time of the measurement [ns].
        frame_id: the header's frame.
        placement: of the object in that frame.
        mesh: vertices relative to the object [m], shape (V, 3), and triangles, shape (F, 3), which replace those of an
            object of that name; without a mesh the object is removed.
        subframes: frames of the object, relative to it, by name; MoveIt plans to `<object>/<name>`.

    Raises `EncodeError` for an invalid mesh.
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
