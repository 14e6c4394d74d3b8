"""Meshes with their triangles as indices, in CDR.

For planners: shape_msgs/Mesh and moveit_msgs/CollisionObject. For Foxglove: foxglove_msgs/SceneUpdate, a third of what
a MarkerArray takes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_adapters.cdr import CdrWriter
from msg_adapters.errors import EncodeError
from msg_adapters.markers import MarkerMesh
from msg_adapters.rotations import quaternion_from_matrix
from msg_adapters.transforms import Placement

MESH = "shape_msgs/msg/Mesh"
COLLISION_OBJECT = "moveit_msgs/msg/CollisionObject"
Operation = Literal["add", "remove", "append", "move"]
_OPERATIONS: dict[Operation, int] = {"add": 0, "remove": 1, "append": 2, "move": 3}


def encode_mesh(vertices: ArrayLike, faces: ArrayLike) -> bytes:
    """A `shape_msgs/Mesh` of vertices [m], shape (V, 3), and triangles, shape (F, 3): it has no header.

    Raises `EncodeError` for arrays of other shapes, and for vertices that aren't finite or that faces name in vain.
    """
    writer = CdrWriter()
    _mesh(writer, vertices, faces)
    return writer.to_bytes()


def encode_collision_object(
    name: str,
    operation: Operation,
    *,
    stamp_ns: int,
    frame_id: str = "map",
    placement: Placement | None = None,
    mesh: tuple[ArrayLike, ArrayLike] | None = None,
    subframes: Mapping[str, Placement] | None = None,
) -> bytes:
    """A `moveit_msgs/CollisionObject`, as MoveIt's planning scene takes it.

    Args:
        name: the object's id.
        operation: `add` puts it in, in the place of one of that name; `move` sets the pose of one that is there, and
            has no mesh; `remove` takes it out.
        stamp_ns: time of the measurement [ns].
        frame_id: of the header.
        placement: of the object in that frame.
        mesh: vertices relative to the object [m], shape (V, 3), and triangles, shape (F, 3); for `add` and `append`.
        subframes: of the object, relative to it, by name; MoveIt plans to `<object>/<name>`.

    Raises:
        EncodeError: no such operation, a mesh that is missing, one too many, or one that can't be.
    """
    if operation not in _OPERATIONS or (mesh is not None) != (operation in ("add", "append")):
        what = "a mesh" if mesh is not None else "no mesh"
        msg = f"wanted add or append with a mesh, or move or remove without one, got {operation!r} with {what}"
        raise EncodeError(msg)
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
    writer.fields("B", _OPERATIONS[operation])
    return writer.to_bytes()


def _pose(writer: CdrWriter, placement: Placement) -> None:
    writer.array("f8", placement.translation)
    writer.array("f8", quaternion_from_matrix(placement.rotation))


def _mesh(writer: CdrWriter, vertices: ArrayLike, faces: ArrayLike) -> None:
    points, triangles = np.asarray(vertices), np.asarray(faces)
    if points.ndim != 2 or points.shape[1:] != (3,) or not np.isfinite(points).all():
        msg = f"wanted finite vertices of shape (V, 3), got {points.shape}"
        raise EncodeError(msg)
    if triangles.ndim != 2 or triangles.shape[1:] != (3,) or triangles.dtype.kind not in "iu" or not len(triangles):
        msg = f"wanted triangles of shape (F, 3) of integers, F > 0, got {triangles.dtype} of shape {triangles.shape}"
        raise EncodeError(msg)
    if triangles.min() < 0 or triangles.max() >= len(points):
        msg = f"wanted triangles of vertices 0 to {len(points) - 1}, got {triangles.min()} to {triangles.max()}"
        raise EncodeError(msg)
    writer.sequence("u4", triangles)
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
    frame_id: str = "map",
    lifetime_ns: int = 0,
) -> bytes:
    """A `foxglove_msgs/SceneUpdate`: the entities are shown, and those named in `deleted` are no longer.

    `stamp_ns` is the time of the deletions [ns]; viewers forget what isn't renewed for `lifetime_ns`, 0: never.
    Raises `EncodeError` for vertices that aren't finite or too few, and a stamp that doesn't fit a ROS time.
    """
    writer = CdrWriter()
    writer.fields("I", len(deleted))
    for name in deleted:
        writer.fields("TBs", stamp_ns, _MATCHING_ID, name)
    writer.fields("I", len(entities))
    for one in entities:
        _write(writer, one, frame_id, lifetime_ns)
    return writer.to_bytes()


def _write(writer: CdrWriter, one: Entity, frame_id: str, lifetime_ns: int) -> None:
    mesh, vertices = one.mesh, one.vertices
    if vertices.shape != (mesh.n_vertices, 3) or not np.isfinite(vertices).all():
        msg = f"{mesh.ns}: wanted finite vertices of shape ({mesh.n_vertices}, 3), got {vertices.shape}"
        raise EncodeError(msg)
    writer.fields("TssT?", one.stamp_ns, frame_id, mesh.ns, lifetime_ns, False)  # frame_locked
    writer.fields("IIIIII", *[0] * 6)  # metadata, arrows, cubes, spheres, cylinders, lines
    writer.fields("I", 1)
    writer.array("f8", [*one.position, *_IDENTITY])
    writer.sequence("f8", vertices)
    writer.array("f8", mesh.color)
    writer.fields("I", 0)  # colors
    writer.sequence("u4", mesh.faces.ravel())
    writer.fields("II", 0, 0)  # texts, models
