"""What the simulator reads off a garment's mesh: constraints in their order, boundary loops, the waist."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, linked


@dataclass(frozen=True, eq=False)
class ClothTopology:
    """The pairs of vertices that the constraints on a garment of N vertices connect."""

    mesh: Connectivity
    edges: NDArray[np.int32]
    """Edges of the mesh sorted by colour, shape (E, 2): edges of one colour share no vertex, which keeps a processor's
    pipeline full."""
    bends: NDArray[np.int32]
    """The two vertices opposite each inner edge, also sorted by colour, shape (B, 2)."""

    @staticmethod
    def of(mesh: Connectivity) -> ClothTopology:
        """The topology of a garment. Raises `MeshError` when an edge has more than two faces."""
        opposite = mesh.faces[:, [2, 0, 1]].reshape(-1)
        count = mesh.n_faces_of_edge
        if count.max(initial=0) > 2:
            msg = f"a garment's edges need one or two faces, got {count.max()} on one edge: clean the mesh"
            raise MeshError(msg)
        by_edge = opposite[np.argsort(mesh.edge_of_corner.ravel(), kind="stable")]
        first = np.concatenate(([0], np.cumsum(count)))[:-1]
        inner = count == 2
        bends = np.stack((by_edge[first[inner]], by_edge[first[inner] + 1]), 1)
        return ClothTopology(mesh, _by_colour(mesh.edges), _by_colour(bends))

    @property
    def n_vertices(self) -> int:
        """Number of vertices N."""
        return self.mesh.n_vertices

    def boundary_loops(self) -> list[NDArray[np.intp]]:
        """Vertices of each hem (waist, cuff, neckline), each sorted by index, in the order of their lowest index."""
        rim = self.mesh.boundary
        n = self.n_vertices
        _, label = linked(rim, n)
        on_rim = np.zeros(n, bool)
        on_rim[rim] = True
        return [np.flatnonzero((label == k) & on_rim) for k in dict.fromkeys(label[on_rim])]

    def distance_from(self, vertices: NDArray[Any], sources: NDArray[np.intp]) -> NDArray[np.float64]:
        """Shortest path along the edges from any of `sources` to each of `vertices` (N, 3) [m], shape (N,)."""
        i, j = self.mesh.edges.T
        length = np.linalg.norm(vertices[i] - vertices[j], axis=1) + 1e-9
        graph = coo_array((length, (i, j)), shape=(self.n_vertices,) * 2).tocsr()
        return np.asarray(dijkstra(graph, directed=False, indices=sources, min_only=True))


def _by_colour(pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """The pairs sorted by a greedy colouring: pairs of one colour share no vertex."""
    taken: dict[int, int] = {}  # bit mask of the colours around a vertex
    colour = np.empty(len(pairs), np.int64)
    for k, (i, j) in enumerate(pairs.tolist()):
        free = ~(taken.get(i, 0) | taken.get(j, 0))
        bit = free & -free
        taken[i] = taken.get(i, 0) | bit
        taken[j] = taken.get(j, 0) | bit
        colour[k] = bit.bit_length()
    found: NDArray[np.int32] = pairs[np.argsort(colour, kind="stable")]
    return found
