"""The exact distance of a garment to the body, computed only where it is less than a band."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components
from torch import Tensor

from refu_core._warp import as_warp
from refu_core.errors import MeshError
from refu_core.sdf._band_kernels import ROW, ROWS_X, ROWS_Y, bin_kernel, finish_kernel, scan_kernel, spread_kernel
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._mesh import Found, MeshSdf
from refu_core.sdf._protocol import SdfSample

BAND = 0.008
"""Width of the band on either side of the skin [m]. It must hold the margin that is kept; and a garment's edges must be
shorter than twice the band for most of them to say that both their ends are on one side."""
_FEW = 200
"""Fewer points than this are cheaper in a tree than in cells, which all faces of the body have to look through."""


@dataclass(frozen=True, eq=False)
class Links:
    """The edges of a garment, by vertex; and one tree of them, by which most vertices hear from most others."""

    start: Tensor
    """The neighbours of vertex v are `linked[start[v]:start[v + 1]]`; int32, shape (N + 1,)."""
    linked: Tensor
    """Int32, shape (2 E,)."""
    parents: Tensor
    """Each vertex and its parent, parents first, -1 for none; int32, shape (N, 2)."""

    @staticmethod
    def of(edges: Tensor, n_vertices: int) -> Links:
        """From the edges of a garment of `n_vertices`, each once, integers of shape (E, 2)."""
        both = torch.cat((edges, edges.flip(1))).cpu().numpy()
        order = np.argsort(both[:, 0], kind="stable")
        linked = both[order, 1].astype(np.int32)
        start = np.searchsorted(both[order, 0], np.arange(n_vertices + 1)).astype(np.int32)
        graph = csr_matrix((np.ones(len(linked)), linked, start), shape=(n_vertices, n_vertices))
        pieces, label = connected_components(graph, directed=False)
        trees = [breadth_first_order(graph, int(np.argmax(label == k)), directed=False) for k in range(pieces)]
        pairs = [np.stack((nodes, np.maximum(predecessor[nodes], -1)), 1) for nodes, predecessor in trees]
        parents = np.concatenate([np.zeros((0, 2)), *pairs]).astype(np.int32)
        return Links(*map(torch.from_numpy, (start, linked, parents)))


class BandSdf(MeshSdf):
    """The exact signed distance, for garments on one CPU core: what lies farther off the skin than a band isn't asked.

    Of a garment that is worn, one vertex in ten is near the skin, and a tree must be walked down for each one to know
    which. Here the vertices are put into the cells of a grid, and the faces of the body, whose boxes cover few of them,
    look for vertices to be closest to: that is exact for every vertex within the band of any face.

    The rest is farther away, on either side. Which one, the garment's edges say: where an edge is shorter than the sum
    of its ends' distances to the skin, no skin lies between them. So the side spreads from the vertices in the band,
    where it is known, to all that such edges reach. A vertex that may be inside, because one inside reaches it, or
    that is reached from nowhere, is asked in the tree like any other point. So no vertex inside is ever taken for one
    outside, in whatever pose and after whatever jump: nothing is carried over from the last frame.

    (Where the body runs into itself "inside" is the pseudo-normal's word, as for `ExactSdf`, and not continuous: a
    vertex deep in a flank may be next to an arm's skin, outside of that. What is reached from both sides is asked.)
    """

    def __init__(self, faces: Tensor | NDArray[Any], *, band: float = BAND) -> None:
        """For bodies of these `faces`, shape (F, 3), counter-clockwise seen from outside; `band` in metres.

        Raises `MeshError` when the faces aren't a closed, consistently oriented surface, or the band isn't positive.
        """
        if not 0 < band < math.inf:
            msg = f"the band must be positive, got {band}"
            raise MeshError(msg)
        super().__init__(faces)
        self.band = band
        self._per_metre = 0.5 / band  # a cell is twice as wide as the band
        # Few points are asked in the tree: one that fits its pose loosely costs less than another one does.
        self._tree = ExactSdf(faces, rebuild_distance=math.inf)
        self._tree_is_posed = False
        self._first_in_cell = wp.full(ROWS_X * ROWS_Y * ROW, -1, dtype=wp.int32, device="cpu")
        self._occupied = wp.zeros(ROWS_X * ROWS_Y, dtype=wp.uint64, device="cpu")
        self._extent = wp.zeros(2, dtype=wp.vec3, device="cpu")
        self._counts = torch.zeros(2, dtype=torch.int32)
        self._cells = torch.zeros(0, dtype=torch.int32)
        self._n_binned = 0
        self._room = 0
        self._make_room(1024)

    def clipped(self, points: Tensor, links: Links) -> SdfSample:
        """The signed distance and gradient of a garment's vertices [m], shape (N, 3), clipped from above.

        Distances are exact inside the body and up to `band` outside of it; farther out they are `band` (and the
        gradient and face, -1, mean nothing). Not differentiable.

        Raises `MeshError` as `query` does.
        """
        self._require_update()
        where = self._checked(points)
        if not len(where):
            return SdfSample(where[:, 0], where, torch.empty(0, dtype=torch.int32))
        found = self._scan(where, beyond=self.band)
        deep, patches = self._uncertain(where, found, links)
        if len(deep):
            self._ask(where, found, deep)
        if len(patches):
            # One of a patch that nothing reaches is asked; if it is inside, so may be all of them.
            self._ask(where, found, patches)
            inside = self._state[patches][found.distance[patches] < 0]
            rest = torch.isin(self._state[: len(where)], inside)
            rest[patches] = False
            self._ask(where, found, torch.nonzero(rest)[:, 0])
        if len(deep) or len(patches):
            # Farther out than the band a distance is clipped where it happens to be known, too.
            found.distance.clamp_(max=self.band)
        return SdfSample(found.distance, found.gradient, found.face)

    def _take_pose(self, *, is_new: bool) -> None:
        del is_new
        self._tree_is_posed = False

    def _find(self, points: Tensor, near: Tensor | None) -> Found:
        if len(points) < _FEW:
            return self._in_tree(points, near)
        found = self._scan(points, beyond=math.inf)
        self._ask(points, found, torch.nonzero(found.face < 0)[:, 0])
        return found

    def _in_tree(self, points: Tensor, near: Tensor | None = None) -> Found:
        if not self._tree_is_posed:
            assert self._vertices is not None  # callers have seen to it
            self._tree.update(self._vertices.detach())
            self._tree_is_posed = True
        return self._tree._find(points, near)

    def _ask(self, points: Tensor, found: Found, rows: Tensor) -> None:
        """Replaces `rows` of `found` by what the tree says of them."""
        if len(rows):
            found.replace(rows, self._in_tree(points[rows]))

    def _scan(self, points: Tensor, *, beyond: float) -> Found:
        """What is closest to each point within the band; the distance `beyond` where nothing is."""
        n = len(points)
        self._make_room(n)
        found = Found.empty(n, self.device)
        where = as_warp(points, wp.vec3)
        cells = [self._first_in_cell, self._next_in_cell, self._occupied]
        best = [self._squared, self._face]
        wp.launch(
            bin_kernel,
            1,
            [where, self.band, self._n_binned, n, self._per_metre, self._cell, *cells, *best, self._extent],
            device="cpu",
        )
        self._n_binned = n
        wp.launch(
            scan_kernel,
            len(self.faces),
            [self._points_wp, self._faces, self.band, self._per_metre, where, self._extent, *cells],
            best,
            device="cpu",
        )
        wp.launch(
            finish_kernel,
            n,
            [self._points_wp, self._faces, *self._topology, where, self._face, beyond],
            found.as_warp(),
            device="cpu",
        )
        return found

    def _uncertain(self, points: Tensor, found: Found, links: Links) -> tuple[Tensor, Tensor]:
        """The vertices that may be inside, and one of each patch that nothing reaches."""
        if len(links.start) != len(points) + 1:
            msg = f"the links are of {len(links.start) - 1} vertices, got {len(points)}"
            raise MeshError(msg)
        wp.launch(
            spread_kernel,
            1,
            [
                as_warp(points, wp.vec3),
                len(points),
                as_warp(links.start, wp.int32),
                as_warp(links.linked, wp.int32),
                as_warp(links.parents, wp.int32),
                as_warp(found.face, wp.int32),
                as_warp(found.distance, wp.float32),
                self.band,
            ],
            self._spread_outputs,
            device="cpu",
        )
        n_inside, n_patches = self._counts.tolist()
        asked = self._asked[: n_inside + n_patches].long()
        return asked[:n_inside], asked[n_inside:]

    def _make_room(self, n: int) -> None:
        if n <= self._room:
            return
        self._room = max(n, 2 * self._room)
        ints = torch.zeros(6, self._room, dtype=torch.int32)
        ints[0, : self._n_binned] = self._cells[: self._n_binned]  # those that are to be emptied
        self._cells, _, _, _, self._state, self._asked = ints
        self._cell, self._next_in_cell, self._face, queue, state, asked = (as_warp(row, wp.int32) for row in ints)
        self._squared = wp.zeros(self._room, dtype=wp.float32, device="cpu")
        self._spread_outputs = [state, queue, asked, as_warp(self._counts, wp.int32)]
