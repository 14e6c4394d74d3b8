"""All pairs of intersecting triangles of two meshes, and what the crossings say about inside and outside."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from refu_core._warp import as_warp, torch_stream
from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, grouped
from refu_core.metrics._intersect_kernels import intersect_kernel
from refu_core.sdf._crossing_kernels import BLOCK

_CORNERS = np.array([[0, 1], [1, 2], [2, 0]])  # the two ends of edge k of a face


class MeshOnDevice(Protocol):
    """What triangles are looked up in."""

    @property
    def device(self) -> torch.device:
        """Where it is."""

    @property
    def mesh_id(self) -> int:
        """Warp's handle."""


class Crossings(NamedTuple):
    """Every intersecting pair of a mesh's faces and the body's."""

    pairs: NDArray[np.int32]
    """(face, body face), shape (K, 2), in lexicographic order."""
    edge_of_face: NDArray[np.bool_]
    """Which edges (0, 1), (1, 2), (2, 0) of the face pierce the body face, shape (K, 3)."""
    edge_of_body: NDArray[np.bool_]
    """Which edges of the body face pierce the face, shape (K, 3)."""


def as_vertices(name: str, values: Any) -> NDArray[np.float32]:
    """`values` (numpy or torch) as a contiguous, finite float32 array, shape (N, 3)."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    array = np.ascontiguousarray(values, dtype=np.float32)
    if array.ndim != 2 or array.shape[1] != 3:
        msg = f"{name} must have the shape (N, 3), got {array.shape}"
        raise MeshError(msg)
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        msg = f"{name} must be finite, got {bad} of {len(array)} with NaN or infinite coordinates"
        raise MeshError(msg)
    return array


class Triangles:
    """A mesh's faces, (G, 3), prepared to be looked at in blocks of neighbours."""

    def __init__(self, faces: NDArray[np.int32], vertices: NDArray[np.float32], device: torch.device) -> None:
        """`vertices` [m], shape (N, 3), say who is near whom, in this pose and so mostly in others: a matter of speed
        alone."""
        self.faces = faces
        order = grouped(vertices[faces].mean(axis=1)) if len(faces) else np.empty(0, np.int64)
        self.blocks = torch.as_tensor(faces[order], device=device)
        self.numbers = torch.as_tensor(order.astype(np.int32), device=device)


def crossings(
    body: MeshOnDevice, vertices: NDArray[np.float32], triangles: Triangles, *, is_body: bool = False
) -> Crossings:
    """The crossings of a mesh, its vertices (N, 3) [m], with the body last given to `body`.

    With `is_body` the mesh is that body: pairs are given once, those that share an edge not at all,
    those that share a vertex where they meet elsewhere, too.
    """
    device = body.device
    points = torch.as_tensor(vertices, device=device)
    n_faces = len(triangles.faces)
    count = torch.zeros(1, dtype=torch.int32, device=device)
    room = max(1024, n_faces)
    while True:
        found = torch.empty(room, 3, dtype=torch.int32, device=device)
        count.zero_()
        with torch_stream(device):
            wp.launch(
                intersect_kernel,
                dim=-(-n_faces // int(BLOCK)),
                inputs=[
                    body.mesh_id,
                    as_warp(points, wp.vec3),
                    as_warp(triangles.blocks, wp.vec3i),
                    as_warp(triangles.numbers, wp.int32),
                    is_body,
                ],
                outputs=[as_warp(count, wp.int32), as_warp(found, wp.vec3i)],
                device=str(device),
            )
        n = int(count)
        if n <= room:
            break
        room = n  # nothing is cut off: once more, with room for all
    rows = found[:n].cpu().numpy()
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    bits = (rows[:, 2:] >> np.arange(6)) & 1 == 1
    return Crossings(np.ascontiguousarray(rows[:, :2]), bits[:, :3], bits[:, 3:])


class EdgeGraph:
    """A mesh as a graph of its edges, prepared once for many frames.

    The winding number of a closed surface is constant wherever that surface isn't crossed: along every edge that
    pierces no body face, and so on each component of the mesh without the pierced edges.
    """

    def __init__(self, mesh: Connectivity) -> None:
        self.n_vertices = mesh.n_vertices
        self.faces = mesh.faces
        self._keys = _keys(mesh.edges.astype(np.int64), mesh.n_vertices)
        self._whole = self._parts(np.ones(len(self._keys), np.bool_))

    def inside(
        self, pierced: NDArray[np.int64], ask: Callable[[NDArray[np.int64]], NDArray[np.bool_]]
    ) -> NDArray[np.bool_]:
        """Which vertices are inside the body, asked for a few only; bool, shape (n_vertices,).

        `pierced` are the edges that pierce a body face, as vertex pairs (E, 2). `ask` answers for given vertices; up to
        three of each component are asked. Should they disagree, a crossing was lost to rounding, and all of that
        component's are.
        """
        component, asked = self._whole
        if len(pierced):
            kept = np.ones(len(self._keys), np.bool_)
            kept[np.searchsorted(self._keys, _keys(pierced, self.n_vertices))] = False
            component, asked = self._parts(kept)
        answers = ask(asked.reshape(-1)).reshape(-1, 3)
        inside: NDArray[np.bool_] = answers[component, 0]
        doubtful = np.flatnonzero((answers != answers[:, :1]).any(axis=1)[component])
        if len(doubtful):
            inside[doubtful] = ask(doubtful)
        return inside

    def _parts(self, kept: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """Each vertex's component along the kept edges, (n_vertices,), and three vertices of each component, (C, 3)."""
        start, end = np.divmod(self._keys[kept], self.n_vertices)
        size = (self.n_vertices, self.n_vertices)
        n, component = connected_components(coo_array((np.ones(len(start), np.int8), (start, end)), size), False)
        order = np.argsort(component, kind="stable")
        first = np.searchsorted(component[order], np.arange(n))
        last = np.append(first[1:], self.n_vertices) - 1
        return component, order[np.stack([first, (first + last) // 2, last], axis=1)]


def pierced_edges(
    faces: NDArray[np.int32], face: NDArray[np.int32], edge_pierces: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """The edges of faces number `face`, shape (K,), marked in `edge_pierces`, shape (K, 3), as vertex pairs (E, 2)."""
    row, k = np.nonzero(edge_pierces)
    ends: NDArray[np.int64] = faces[face[row][:, None], _CORNERS[k]].astype(np.int64)
    return ends


def _keys(edges: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    keys: NDArray[np.int64] = edges.min(axis=1) * n + edges.max(axis=1)
    return keys
