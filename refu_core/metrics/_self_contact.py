"""Where a body intersects itself: what the collider is judged by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import as_warp
from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, vertex_normals
from refu_core.metrics._intersect import EdgeGraph, Triangles, as_vertices, crossings, pierced_edges
from refu_core.metrics._self_contact_kernels import self_contact_kernel
from refu_core.sdf import ExactSdf

DEFAULT_NEAR = 0.02
"""A garment vertex this close to a place of self-contact [m] may have nowhere to go."""

_OFF_SURFACE = 1e-4  # [m]; how far off its own surface a body vertex is asked whether another limb has it


@dataclass(frozen=True, eq=False)
class SelfContact:
    """Where a posed body intersects itself and its rest pose doesn't."""

    pairs: NDArray[np.int32]
    """Intersecting body faces, shape (K, 2), in lexicographic order; none of a pair share an edge."""
    faces: NDArray[np.int32]
    """Faces of those pairs, and those buried in another limb, shape (M,), in order."""
    vertices: NDArray[np.float32]
    """The posed body [m], shape (V, 3)."""
    _body: ExactSdf = field(repr=False)

    @property
    def is_free(self) -> bool:
        """The body touches itself nowhere that it doesn't in its rest pose."""
        return not len(self.faces)

    def near(self, points: Any, *, distance: float = DEFAULT_NEAR) -> NDArray[np.bool_]:
        """Which of `points` [m], shape (N, 3), this contact leaves no way out; bool, shape (N,).

        Those within `distance` [m] of a face in contact; and, at any distance, those inside the body whose closest face
        is in contact: to leave by a buried face is to enter another limb.
        """
        queries = as_vertices("points", points)
        near = np.zeros(len(queries), np.bool_)
        if self.is_free or not len(queries):
            return near
        # The detector may have seen other poses since.
        self._body.update(torch.from_numpy(self.vertices))
        in_contact = torch.zeros(len(self._body.faces), dtype=torch.bool)
        in_contact[torch.from_numpy(self.faces).long()] = True
        contact = wp.Mesh(
            as_warp(torch.from_numpy(self.vertices), wp.vec3),
            as_warp(self._body.faces[in_contact].view(-1), wp.int32),
        )
        wp.launch(
            self_contact_kernel,
            dim=len(queries),
            inputs=[
                contact.id,
                self._body.mesh_id,
                as_warp(in_contact, wp.bool),
                as_warp(torch.from_numpy(queries), wp.vec3),
                distance,
            ],
            outputs=[as_warp(torch.from_numpy(near), wp.bool)],
            device="cpu",
        )
        return near


class SelfContactDetector:
    """Finds where a posed body intersects itself, its rest pose's own intersections (toes, ears) left out.

    Faces of a bending joint's crease (groin, armpit, the crook of a knee) that fold into each other count: skin that
    overlaps skin leaves a garment no room, whichever limbs it belongs to.
    """

    def __init__(self, body_faces: Any, rest_vertices: Any) -> None:
        """Prepares for a body with these faces, shape (F, 3), and this rest pose [m], shape (V, 3).

        Raises `MeshError` when the faces aren't a closed, consistently oriented surface, or don't fit the vertices.
        """
        self._body = ExactSdf(body_faces, sign="winding")
        self._faces = self._body.faces.numpy()
        rest = as_vertices("rest_vertices", rest_vertices)
        self._triangles = Triangles(self._faces, rest, self._body.device)
        self._graph = EdgeGraph(Connectivity.of(self._faces, len(rest)))
        pairs, buried = self._contacts(rest)
        self._rest_pairs = self._keys(pairs)
        self._rest_buried = buried

    def detect(self, body_vertices: Any) -> SelfContact:
        """The self-contact of a posed body, `body_vertices` [m], shape (V, 3). Raises `MeshError` for other shapes."""
        vertices = as_vertices("body_vertices", body_vertices)
        if len(vertices) != len(self._rest_buried):
            msg = f"body_vertices must have the rest pose's shape ({len(self._rest_buried)}, 3), got {vertices.shape}"
            raise MeshError(msg)
        pairs, buried = self._contacts(vertices)
        pairs = pairs[~np.isin(self._keys(pairs), self._rest_pairs)]
        covered = np.flatnonzero((buried & ~self._rest_buried)[self._faces].any(axis=1))
        faces = np.union1d(pairs, covered).astype(np.int32)
        return SelfContact(pairs, faces, vertices, self._body)

    def _contacts(self, vertices: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """All intersecting pairs of faces, (K, 2), and the vertices inside another part of the body, (V,)."""
        self._body.update(torch.from_numpy(vertices))
        found = crossings(self._body, vertices, self._triangles, is_body=True)
        if not len(found.pairs):
            return found.pairs, np.zeros(len(vertices), np.bool_)
        pierced = np.concatenate(
            [
                pierced_edges(self._faces, found.pairs[:, 0], found.edge_of_face),
                pierced_edges(self._faces, found.pairs[:, 1], found.edge_of_body),
                self._edges_at(_pinched(self._faces, found.pairs)),
            ]
        )
        above = vertices + _OFF_SURFACE * vertex_normals(vertices, self._faces)
        buried = self._graph.inside(
            pierced, lambda rows: (self._body.closest(torch.from_numpy(above[rows])).sign < 0).numpy()
        )
        return found.pairs, buried

    def _edges_at(self, vertices: NDArray[np.int32]) -> NDArray[np.int64]:
        """All edges that end at one of `vertices`, as vertex pairs (E, 2)."""
        edges = self._faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64)
        ending: NDArray[np.int64] = edges[np.isin(edges, vertices).any(axis=1)]
        return ending

    def _keys(self, pairs: NDArray[np.int32]) -> NDArray[np.int64]:
        keys: NDArray[np.int64] = pairs[:, 0].astype(np.int64) * len(self._faces) + pairs[:, 1]
        return keys


def _pinched(faces: NDArray[np.int32], pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """Vertices in both faces of a pair, (K, 2): their fans cut through themselves, so a crease ends there, and from
    them the skin goes on into both layers without piercing anything."""
    first, second = faces[pairs[:, 0]], faces[pairs[:, 1]]
    return np.unique(first[(first[:, :, None] == second[:, None, :]).any(axis=2)])
