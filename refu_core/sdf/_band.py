"""The exact distance of a garment to the body, computed only where it is less than a band."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import as_warp
from refu_core.errors import MeshError
from refu_core.mesh import Adjacency
from refu_core.sdf._box_tree import BoxTree
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._mesh import Found, MeshSdf, Recorded
from refu_core.sdf._protocol import GarmentSdf, SdfSample
from refu_core.sdf._query_kernels import query_skin_kernel
from refu_core.sdf._scan import Scan

if TYPE_CHECKING:
    from refu_core.body import SmplBody
    from refu_core.garments import GarmentTemplate

BAND = 0.008
"""Width of the band on either side of the skin [m]. It must hold the margin that is kept; and a garment's edges must be
shorter than twice the band for most of them to say that both their ends are on one side."""
_FEW = 200
"""Fewer points than this are cheaper in a tree than in cells, which all faces of the body have to look through."""


class Links:
    """The edges of a garment as the kernels of the band read them."""

    def __init__(self, ring: Adjacency) -> None:
        """From the neighbours of each vertex (`Connectivity.ring`)."""
        self.n_vertices = len(ring.start) - 1
        self.arrays = [as_warp(torch.from_numpy(array), wp.int32) for array in ring]


class BandSdf(MeshSdf):
    """The exact signed distance for garments on one CPU core; beyond a band around the skin only the side is computed.

    One vertex in ten of a worn garment is near the skin, but a tree has to be walked down for each vertex to know
    which. Here the vertices are put into the cells of a grid, and the faces of the body look for the vertices in the
    few cells that their boxes cover. That is exact for every vertex within the band of any face.

    The other vertices are farther away, on one side or the other. The garment's edges say which: where an edge is
    shorter than the sum of its ends' distances, no skin lies between them. So the side spreads from the band, where it
    is known, along such edges. A vertex that may be inside, or that no edge reaches, is asked in the tree. So no vertex
    inside is ever taken for one outside, whatever the pose: nothing is carried over from the last frame.

    Where the body runs into itself, "inside" is what the pseudo-normal says, as for `ExactSdf`, and not continuous. A
    vertex deep in one thigh may be outside of the other's skin, which is buried there, and be reached from it. So what
    is reached from both sides is asked in the tree, and so are pieces of fewer than some hundred vertices: what a limb
    encloses is small, and the outside of a worn garment hangs together.
    """

    def __init__(self, faces: Tensor | NDArray[Any], *, band: float = BAND, rest: Tensor | None = None) -> None:
        """For bodies of these `faces`, shape (F, 3), counter-clockwise seen from outside; `band` in metres.

        `rest` are vertices [m], shape (V, 3), of a pose with the limbs apart. It is a matter of speed: a tree built for
        such a pose groups no two limbs, and so fits all later poses better.

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
        if links.n_vertices != len(where):
            msg = f"the links are of {links.n_vertices} vertices, got {len(where)}"
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

    def of_garment(self, garment: GarmentTemplate) -> GarmentSdf:
        """As `BodySdf.of_garment`; distances beyond the band are computed only where `reach` asks for them."""
        links = Links(garment.mesh.ring)

        def ask(vertices: Tensor, *, on_mean: Tensor, reach: float = math.inf) -> SdfSample:  # noqa: ARG001
            return self.clipped(vertices, links) if reach <= self.band else self.query(vertices)

        return ask

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
                self._few = Recorded(query_skin_kernel, (skin,), (self._none,))
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
            self._tree.fit(self._posed.points)
            self._tree_is_posed = True
        return self._tree

    def _scan_of_pose(self) -> Scan:
        if self._scan is None:
            self._scan = Scan(self._posed, len(self.faces), self.band, partial(_record, self.skin()))
        return self._scan


def _record(skin: Any, points: Any, rows: Any, answers: Found) -> Any:
    """A recorded launch that asks for the points in `rows`; the faces that `answers` has already are hints."""
    outputs = answers.as_warp()
    inputs = [skin, points, outputs[0], rows]
    return wp.launch(query_skin_kernel, len(rows), inputs, outputs, device="cpu", record_cmd=True)


def exact_sdf(body: SmplBody, *, uses_band: bool = True) -> BandSdf | ExactSdf:
    """The exact signed distance to posed bodies of a model, the fastest for garments on its device.

    On a CPU that is `BandSdf`, unless `uses_band` is false. A GPU walks the tree faster than it sorts out what needn't
    be asked.
    """
    if body.device.type == "cpu" and uses_band:
        return BandSdf(body.faces, rest=body.v_template)
    return ExactSdf(body.faces, device=body.device)
