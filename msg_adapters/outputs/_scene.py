"""foxglove_msgs/SceneUpdate in CDR: meshes with their triangles as indices, a third of what a MarkerArray takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msg_adapters.cdr import CdrWriter
from msg_adapters.errors import EncodeError
from msg_adapters.markers import MarkerMesh

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
