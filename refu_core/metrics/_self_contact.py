"""Where a body intersects itself, by which the collider is judged."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from refu_core._warp import Unpicklable
from refu_core.body import Surface
from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, vertex_normals
from refu_core.metrics._collisions import SheetChecker, as_vertices
from refu_core.sdf import Winding

DEFAULT_NEAR = 0.02
"""A garment vertex this close to a place of self-contact [m] may have nowhere to go."""

_OFF_SURFACE = 1e-4  # [m]; how far off its own surface a body vertex is tested for being in another limb


@dataclass(frozen=True, eq=False)
class SelfContact:
    """Where a posed body intersects itself and its rest pose doesn't."""

    pairs: NDArray[np.int32]
    """Pairs of intersecting body faces, shape (K, 2), in lexicographic order; the two never share an edge."""
    faces: NDArray[np.int32]
    """Faces of those pairs, and those buried in another limb, shape (M,), in order."""
    vertices: NDArray[np.float32]
    """The posed body [m], shape (V, 3)."""
    _body_faces: NDArray[np.int32] = field(repr=False)

    @property
    def is_free(self) -> bool:
        """Whether the body touches itself nowhere that it doesn't in its rest pose."""
        return not len(self.faces)

    def near(self, points: Any, *, distance: float = DEFAULT_NEAR) -> NDArray[np.bool_]:
        """Which of `points` [m], shape (N, 3), have no way out because of this contact; bool, shape (N,).

        Those within `distance` [m] of a face in contact; and, at any distance, those inside the body whose closest face
        is in contact: leaving through a buried face would lead into another limb.
        """
        queries = as_vertices("points", points)
        if self.is_free or not len(queries):
            return np.zeros(len(queries), np.bool_)
        vertices, places = self.vertices.astype(np.float64), queries.astype(np.float64)
        contact = Surface(vertices, self._body_faces[self.faces])
        away: NDArray[Any] = np.linalg.norm(contact.at(contact.closest(places)) - places, axis=1)
        closest = Surface(vertices, self._body_faces).closest(places).face
        is_within = _are_inside(Winding(torch.from_numpy(self._body_faces)), self.vertices, queries)
        return (away <= distance) | (np.isin(closest, self.faces) & is_within)


class SelfContactDetector(Unpicklable):
    """Finds where a posed body intersects itself, its rest pose's own intersections (toes, ears) left out.

    Faces of a bending joint's crease (groin, armpit, the crook of a knee) that fold into each other count: skin that
    overlaps skin leaves a garment no room, whichever limbs it belongs to.
    """

    def __init__(self, body_faces: Any, rest_vertices: Any) -> None:
        """Prepares for a body with these faces, shape (F, 3), and this rest pose [m], shape (V, 3).

        Raises `MeshError` when the faces aren't a closed, consistently oriented surface, or don't fit the vertices.
        """
        self._sheet = SheetChecker(body_faces)
        self._faces = self._sheet.faces
        self._winding = Winding(torch.from_numpy(self._faces))
        rest = as_vertices("rest_vertices", rest_vertices)
        self._around = Connectivity.of(self._faces, len(rest)).adjacency_matrix()
        pairs, self._rest_buried = self._contacts(rest)
        self._rest_pairs = self._keys(pairs)

    def detect(self, body_vertices: Any) -> SelfContact:
        """The self-contact of a posed body, `body_vertices` [m], shape (V, 3). Raises `MeshError` for other shapes."""
        vertices = as_vertices("body_vertices", body_vertices)
        if (n := len(self._rest_buried)) != len(vertices):
            raise MeshError(f"body_vertices must have the rest pose's shape ({n}, 3), got {vertices.shape}")
        pairs, buried = self._contacts(vertices)
        pairs = pairs[~np.isin(self._keys(pairs), self._rest_pairs)]
        # Skin enters another part by crossing its skin: what seems buried without that is a fold that nearly touches.
        crosses = np.zeros(len(vertices), np.bool_)
        crosses[self._faces[pairs]] = True
        buried &= ~self._rest_buried
        kept = np.flatnonzero(buried | crosses)
        _, patch = connected_components(self._around[kept][:, kept], directed=False)
        buried[kept] &= np.isin(patch, patch[crosses[kept]])
        faces = np.union1d(pairs, np.flatnonzero(buried[self._faces].any(axis=1))).astype(np.int32)
        return SelfContact(pairs, faces, vertices, self._faces)

    def _contacts(self, vertices: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """All intersecting pairs of faces, (K, 2), and the vertices inside another part of the body, (V,)."""
        self._sheet.update(vertices)
        above = vertices + _OFF_SURFACE * vertex_normals(vertices, self._faces)
        return self._sheet.with_itself(), _are_inside(self._winding, vertices, above)

    def _keys(self, pairs: NDArray[np.int32]) -> NDArray[np.int64]:
        return pairs[:, 0].astype(np.int64) * len(self._faces) + pairs[:, 1]


def _are_inside(winding: Winding, vertices: NDArray[np.float32], points: NDArray[np.float32]) -> NDArray[np.bool_]:
    winding.update(torch.from_numpy(vertices))
    return (winding(torch.from_numpy(points)) > 0).numpy()
