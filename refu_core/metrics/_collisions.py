"""Exact body-garment collisions: intersecting triangles, and what lies inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.mesh import Connectivity
from refu_core.metrics._intersect import Triangles, as_vertices, crossings
from refu_core.sdf import ExactSdf, Winding


@dataclass(frozen=True, eq=False)
class Collisions:
    """The exact collisions of one garment with the body."""

    pairs: NDArray[np.int32]
    """Intersecting (garment face, body face), shape (K, 2), in lexicographic order."""
    pair_is_vf: NDArray[np.bool_]
    """Whether a pair is vertex-face: two edges of one triangle pierce the other, so a vertex has gone through a face.
    Otherwise it is edge-edge: one edge of each pierces the other. Shape (K,)."""
    inside: NDArray[np.bool_]
    """Garment vertices inside the body, by winding number, shape (N,)."""
    depth: NDArray[np.float32]
    """Distance of these vertices to the body's surface [m], 0 for those outside, shape (N,)."""

    @property
    def n_pairs(self) -> int:
        """Number of intersecting pairs of triangles."""
        return len(self.pairs)

    @property
    def n_inside(self) -> int:
        """Number of garment vertices inside the body."""
        return int(self.inside.sum())

    @property
    def n_vf(self) -> int:
        """Garment triangles with a vertex-face contact (the paper's "colliding triangles on the garment", Avg. VF)."""
        return len(np.unique(self.pairs[self.pair_is_vf, 0]))

    @property
    def n_ee(self) -> int:
        """Garment triangles with an edge-edge contact (Avg. EE); one with both kinds counts in both."""
        return len(np.unique(self.pairs[~self.pair_is_vf, 0]))

    @property
    def max_depth(self) -> float:
        """Depth of the deepest vertex [m], 0 where none is inside."""
        return float(self.depth.max(initial=0.0))

    @property
    def is_free(self) -> bool:
        """Whether no pair intersects and no vertex is inside: a piece wholly inside crosses nothing, but isn't free."""
        return not self.n_pairs and not self.n_inside


class CollisionChecker:
    """Exact check of garments against one body: set the body once per frame, then check each garment.

    Intersections are those of all pairs of triangles, decided in double precision on float32 vertices. Touching counts
    as intersecting; lying in a face's plane doesn't, so a triangle flat on a body face is found only where it reaches
    the face's border, by the faces beyond.
    """

    def __init__(self, body_faces: Any) -> None:
        """Prepares for bodies of these faces, shape (F, 3).

        Raises `MeshError` when they aren't a closed, consistently oriented surface.
        """
        self._body = ExactSdf(body_faces)
        self._winding = Winding(self._body.faces)
        self._triangles: dict[tuple[int, int], Triangles] = {}

    def update(self, body_vertices: Any) -> None:
        """Takes over a new pose: the body's vertices [m], shape (V, 3). Raises `MeshError` as `ExactSdf.update`."""
        vertices = torch.from_numpy(as_vertices("the body's vertices", body_vertices))
        self._body.update(vertices)
        self._winding.update(vertices)

    def check(self, garment_vertices: Any, garment_faces: Any) -> Collisions:
        """The collisions of a garment, vertices [m], shape (N, 3), and faces (G, 3), with the body last set.

        Raises `MeshError` for wrong shapes, values that aren't finite, or where no body was set.
        """
        vertices = as_vertices("the garment's vertices", garment_vertices)
        found = crossings(self._body.mesh_id, vertices, self._triangles_of(garment_faces, vertices))
        points = torch.from_numpy(vertices)
        # It is 2 where limbs overlap, and -1 where skin is turned inside out, which counts as outside.
        inside = (self._winding(points) > 0).numpy()
        depth = np.zeros(len(vertices), np.float32)
        depth[inside] = self._body.query(points[inside]).distance.abs().numpy()
        is_vf = (found.edge_of_face.sum(axis=1) >= 2) | (found.edge_of_body.sum(axis=1) >= 2)
        return Collisions(found.pairs, is_vf, inside, depth)

    def _triangles_of(self, faces: Any, vertices: NDArray[np.float32]) -> Triangles:
        # The same few garments come frame after frame: comparing faces is a tenth of the work of preparing them.
        size = (len(vertices), len(faces))
        known = self._triangles.get(size)
        if known is None or not np.array_equal(known.faces, faces):
            checked = Connectivity.of(faces, len(vertices)).faces
            known = self._triangles[size] = Triangles(checked, vertices)
        return known
