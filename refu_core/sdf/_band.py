"""The exact distance of a garment to the body, computed only where it is less than a band."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import as_warp
from refu_core.errors import MeshError
from refu_core.sdf._box_tree import BoxTree
from refu_core.sdf._mesh import Found, MeshSdf, Recorded
from refu_core.sdf._protocol import SdfSample
from refu_core.sdf._scan import Scan
from refu_core.sdf._skin import ask_kernel

BAND = 0.008
"""Width of the band on either side of the skin [m]. It must hold the margin that is kept; and a garment's edges must be
shorter than twice the band for most of them to say that both their ends are on one side."""
_FEW = 200
"""Fewer points than this are cheaper in a tree than in cells, which all faces of the body have to look through."""


@dataclass(frozen=True, eq=False)
class Links:
    """The edges of a garment, by vertex."""

    start: Tensor
    """The neighbours of vertex v are `linked[start[v]:start[v + 1]]`; int32, shape (N + 1,)."""
    linked: Tensor
    """Int32, shape (2 E,)."""

    @staticmethod
    def of(edges: Tensor, n_vertices: int) -> Links:
        """From the edges of a garment of `n_vertices`, each once, integers of shape (E, 2)."""
        both = torch.cat((edges, edges.flip(1))).cpu().numpy()
        order = np.argsort(both[:, 0], kind="stable")
        linked = both[order, 1].astype(np.int32)
        start = np.searchsorted(both[order, 0], np.arange(n_vertices + 1)).astype(np.int32)
        return Links(torch.from_numpy(start), torch.from_numpy(linked))

    @cached_property
    def arrays(self) -> list[Any]:
        """The same as kernels take them."""
        return [as_warp(tensor, wp.int32) for tensor in (self.start, self.linked)]


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

    Where the body runs into itself "inside" is the pseudo-normal's word, as for `ExactSdf`, and not continuous: a
    vertex deep in one thigh may be reached from the skin of the other, which is buried there, and outside of that. What
    is reached from both sides is asked; and so are pieces of fewer than some hundred vertices, since what the skin of a
    limb shuts in is one, while what a worn garment has outside hangs together.
    """

    def __init__(self, faces: Tensor | NDArray[Any], *, band: float = BAND, rest: Tensor | None = None) -> None:
        """For bodies of these `faces`, shape (F, 3), counter-clockwise seen from outside; `band` in metres.

        `rest` are vertices [m], shape (V, 3), of a pose with the limbs apart. It is a matter of speed: a tree built for
        it groups no two limbs, and fits whatever pose comes better than one that is built for the first that does.

        Raises `MeshError` when the faces aren't a closed, consistently oriented surface, or the band isn't positive.
        """
        if not 0 < band < math.inf:
            msg = f"the band must be positive, got {band}"
            raise MeshError(msg)
        super().__init__(faces)
        self.band = band
        self._tree = None if rest is None else BoxTree(self.faces, rest)
        self._tree_is_posed = False
        self._scan: Scan | None = None
        self._few: Recorded | None = None
        self._none = wp.empty(0, dtype=wp.int32, device="cpu")

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
        if len(links.start) != len(where) + 1:
            msg = f"the links are of {len(links.start) - 1} vertices, got {len(where)}"
            raise MeshError(msg)
        scan = self._scan_of_pose()
        found = scan.near(where, beyond=self.band)
        n_inside, n_patches = scan.spread(links.arrays)
        if n_inside or n_patches:
            self._pose_tree()
            scan.ask(n_inside + n_patches)
        if n_patches:
            # One of a patch that nothing reaches was asked; if it is inside, so may be all of them.
            patches, patch_of = scan.asked(n_inside + n_patches)[n_inside:], scan.patch_of(len(where))
            rest = torch.isin(patch_of, patch_of[patches][found.distance[patches] < 0])
            rest[patches] = False
            rows = torch.nonzero(rest)[:, 0]
            scan.ask(len(rows), rows)
        if n_inside or n_patches:
            # Farther out than the band a distance is clipped where it happens to be known, too.
            found.distance.clamp_(max=self.band)
        return found.sample()

    def skin(self) -> Any:
        """As `MeshSdf.skin`."""
        self._pose_tree()
        return super().skin()

    def _bind_skin(self) -> Any:
        skin = super()._bind_skin()
        skin.boxes = self._pose_tree().boxes
        return skin

    def _take_pose(self, *, is_new: bool) -> None:
        if is_new:
            self._scan = self._few = None
        self._tree_is_posed = False

    def _find(self, points: Tensor, near: Tensor | None) -> Found:
        if near is not None or len(points) < _FEW:
            skin = self.skin()
            if self._few is None:
                self._few = Recorded(ask_kernel, lambda points, near: [skin, points, near, self._none])
            return self._few.ask(points, near)
        scan = self._scan_of_pose()
        found = scan.near(points, beyond=math.inf)
        far = torch.nonzero(found.face < 0)[:, 0]
        if len(far):
            self._pose_tree()
            scan.ask(len(far), far)
        return found

    def _pose_tree(self) -> BoxTree:
        points = self._require_update()
        if self._tree is None:
            self._tree = BoxTree(self.faces, points)
        if not self._tree_is_posed:
            self._tree.fit(self._points_wp)
            self._tree_is_posed = True
        return self._tree

    def _scan_of_pose(self) -> Scan:
        if self._scan is None:
            body = [self._points_wp, self._faces, *self._topology]
            self._scan = Scan(body, len(self.faces), self.band, self._record)
        return self._scan

    def _record(self, points: Any, rows: Any, answers: Found) -> Any:
        """A launch to be repeated, of those of the points that are in rows; the answers' faces before count as near."""
        outputs = answers.as_warp()
        inputs = [self.skin(), points, outputs[0], rows]
        return wp.launch(ask_kernel, len(rows), inputs, outputs, device="cpu", record_cmd=True)
