"""All pairs of intersecting triangles: of a garment and the body, of garments, of one with itself; what lies inside."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import Unpicklable, as_warp, memory
from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, as_points, check_faces, grouped
from refu_core.metrics._intersect_kernels import intersect_kernel
from refu_core.sdf import ExactSdf, Winding
from refu_core.sdf._crossing_kernels import BLOCK


class Crossings(NamedTuple):
    """Every intersecting pair of a mesh's faces and the body's."""

    pairs: NDArray[np.int32]
    """(face, body face), shape (K, 2), in lexicographic order."""
    edge_of_face: NDArray[np.bool_]
    """Which edges (0, 1), (1, 2), (2, 0) of the face pierce the body face, shape (K, 3)."""
    edge_of_body: NDArray[np.bool_]
    """Which edges of the body face pierce the face, shape (K, 3)."""


as_vertices = partial(as_points, dtype=np.float32)


class Triangles:
    """A mesh's faces, (G, 3), prepared to be looked at in blocks of neighbours."""

    def __init__(self, faces: NDArray[np.int32], vertices: NDArray[np.float32]) -> None:
        """`vertices` [m], shape (N, 3), decide which faces are neighbours, in this pose and mostly in others.

        That affects only the speed.
        """
        self.faces = faces
        order = grouped(vertices[faces].mean(axis=1)) if len(faces) else np.empty(0, np.int64)
        blocks, numbers = torch.from_numpy(faces[order]), torch.from_numpy(order.astype(np.int32))
        self.arrays = as_warp(blocks, wp.vec3i), as_warp(numbers, wp.int32)
        """The faces in blocks, and their numbers."""


def crossings(mesh_id: int, vertices: NDArray[np.float32], triangles: Triangles, *, is_body: bool = False) -> Crossings:
    """The crossings of a mesh, with vertices (N, 3) [m], and the body, Warp's mesh number `mesh_id`.

    With `is_body` the mesh is that body: each pair is given once, faces that share an edge are left out, and
    faces that share a vertex are given only if they meet elsewhere, too.
    """
    points = torch.from_numpy(vertices)
    n_faces = len(triangles.faces)
    count = memory(1, dtype=torch.int32)
    room = max(1024, n_faces)
    while True:
        found = memory(room, 3, dtype=torch.int32)
        count.zero_()
        wp.launch(
            intersect_kernel,
            dim=-(-n_faces // int(BLOCK)),
            inputs=[mesh_id, as_warp(points, wp.vec3), *triangles.arrays, is_body],
            outputs=[as_warp(count, wp.int32), as_warp(found, wp.vec3i)],
            device="cpu",
        )
        if (n := int(count)) <= room:
            break
        room = n  # too little room: once more, with room for all
    rows = found[:n].numpy()
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    bits = (rows[:, 2:] >> np.arange(6)) & 1 == 1
    return Crossings(np.ascontiguousarray(rows[:, :2]), bits[:, :3], bits[:, 3:])


class SheetChecker(Unpicklable):
    """A garment as an open sheet: where it cuts through itself or another one."""

    def __init__(self, faces: Any) -> None:
        """For a garment of these faces, shape (G, 3). Raises `MeshError` as `check_faces`."""
        self.faces = check_faces(faces)
        self._flat = torch.from_numpy(self.faces.reshape(-1).copy())
        self._points = memory(0, 3)
        self._mesh: Any = None
        self._triangles: Triangles | None = None

    def update(self, vertices: Any) -> None:
        """Takes over a garment's vertices [m], shape (N, 3). Raises `MeshError` for others, or faces beyond them."""
        points = as_vertices("the garment's vertices", vertices).copy()
        check_faces(self.faces, n_vertices=len(points))
        self._points = torch.from_numpy(points)
        self._mesh = wp.Mesh(as_warp(self._points, wp.vec3), as_warp(self._flat, wp.int32))

    def with_itself(self) -> NDArray[np.int32]:
        """The pairs of its faces that intersect, shape (K, 2); meeting at a shared edge or vertex doesn't count."""
        tree, points = self._tree(), self._points.numpy()
        self._triangles = self._triangles or Triangles(self.faces, points)
        return crossings(tree, points, self._triangles, is_body=True).pairs

    def with_other(self, vertices: Any, faces: Any) -> NDArray[np.int32]:
        """Intersecting pairs (other's face, own face), shape (K, 2), with a garment of `vertices` and `faces`.

        The garment is (M, 3) [m] and (F, 3). Raises `MeshError` for other arrays.
        """
        other = as_vertices("the other garment's vertices", vertices)
        triangles = Triangles(check_faces(faces, n_vertices=len(other)), other)
        return crossings(self._tree(), other, triangles).pairs

    def _tree(self) -> int:
        """Warp's number of the garment's mesh. Raises `MeshError` before `update`."""
        if self._mesh is None:
            raise MeshError("no garment yet: call update(vertices) before asking what it cuts")
        return int(self._mesh.id)


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


class CollisionChecker(Unpicklable):
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
        self._triangles: dict[tuple[int, tuple[int, ...]], Triangles] = {}

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
        size = (len(vertices), np.shape(faces))
        known = self._triangles.get(size)
        if known is None or not np.array_equal(known.faces, faces):
            checked = Connectivity.of(faces, len(vertices)).faces
            known = self._triangles[size] = Triangles(checked, vertices)
        return known
