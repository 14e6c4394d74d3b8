"""The exact distance of a garment to the body, computed only where it is less than a band."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import Recorded, Repeated, as_warp, memory
from refu_core.body import SmplBody
from refu_core.errors import MeshError
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Adjacency, grouped_at_rest
from refu_core.sdf._band_kernels import (
    ASKED,
    ROW,
    ROWS_X,
    ROWS_Z,
    Cells,
    finish_kernel,
    scan_kernel,
    sort_kernel,
    spread_sides_kernel,
)
from refu_core.sdf._box_kernels import MAX_FACES, WIDTH, Boxes, Eight, fit_kernel
from refu_core.sdf._closest_kernels import PosedMesh
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._mesh import FOUND, Found, MeshSdf, ask
from refu_core.sdf._protocol import GarmentSdf, SdfSample
from refu_core.sdf._query_kernels import query_skin_kernel

BAND = 0.008
"""Width of the band on either side of the skin [m]. It must be at least the margin that is kept. And most of a
garment's edges must be shorter than twice the band, to show that both of their ends are on one side."""
_FEW = 200
"""Fewer points than this are cheaper in a tree than in cells, which all faces of the body have to look through."""
_N_ROWS = int(ROWS_X) * int(ROWS_Z)
_WIDTH = int(WIDTH)


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
    vertex deep in one thigh may be outside the other's skin, which is buried there, and be reached from that skin. So
    vertices that are reached from both sides are asked in the tree. So are pieces of fewer than a few hundred vertices:
    what a limb encloses is small, and the outside of a worn garment is connected.
    """

    def __init__(self, faces: Tensor | NDArray[Any], *, band: float = BAND, rest: Tensor | None = None) -> None:
        """For bodies of these `faces`, shape (F, 3), counter-clockwise seen from outside; `band` in metres.

        `rest` are vertices [m], shape (V, 3), of a pose with the limbs apart. It is a matter of speed: a tree built for
        such a pose groups no two limbs, and so fits all later poses better.

        Raises `MeshError` when the faces aren't a closed, consistently oriented surface, or the band isn't positive.
        """
        if not 0 < band < math.inf:
            raise MeshError(f"the band must be positive, got {band}")
        super().__init__(faces)
        self.band = band
        self._tree = None if rest is None else BoxTree(self.faces, rest)
        self._tree_is_posed = False
        self._all = memory(0, dtype=torch.bool)

    def clipped(self, points: Tensor, ring: Adjacency) -> SdfSample:
        """The signed distance and gradient of a garment's vertices [m], shape (N, 3), clipped from above.

        `ring` are the vertices next to each (`Connectivity.ring`). Distances are exact inside the body and up to `band`
        outside of it; farther out they are `band` (and gradient and face, -1, mean nothing). Not differentiable.

        Raises `MeshError` as `query` does.
        """
        self._require_update()
        where = self._checked(points)
        if len(ring.start) - 1 != len(where):
            raise MeshError(f"the ring is of {len(ring.start) - 1} vertices, got {len(where)}")
        if not len(where):
            return SdfSample(where[:, 0], where, where.new_empty(0, dtype=torch.int32))
        found = self._scan(where, beyond=self.band)
        state, patches = self._scan.spread(where, found, ring)
        is_asked = state == int(ASKED)
        is_asked[patches] = True
        if self._ask_tree(where, found, is_asked):
            # One vertex of each patch that nothing reaches was asked; if it is inside, all of the patch may be.
            is_patch = torch.isin(state, state[patches][found.distance[patches] < 0])
            self._ask_tree(where, found, is_patch & ~is_asked)
            # Beyond the band a distance is clipped even where it happens to be known.
            found.distance.clamp_(max=self.band)
        return found.sample()

    def of_garment(self, garment: GarmentTemplate) -> GarmentSdf:
        """As `BodySdf.of_garment`; distances beyond the band are computed only where `reach` asks for them."""
        ring = garment.mesh.ring

        def ask_garment(vertices: Tensor, *, on_mean: Tensor, reach: float = math.inf) -> SdfSample:  # noqa: ARG001
            return self.clipped(vertices, ring) if reach <= self.band else self.query(vertices)

        return ask_garment

    def skin(self) -> Any:
        """As `MeshSdf.skin`."""
        self._pose_tree()
        return super().skin()

    def _bind_skin(self) -> Any:
        skin = super()._bind_skin()
        skin.boxes = self._pose_tree().boxes
        self._tell = Repeated(query_skin_kernel, (wp.vec3, wp.int32, wp.bool, *FOUND), [skin])
        return skin

    def _take_pose(self, *, is_new: bool) -> None:
        if is_new:
            self._scan = Scan(self._posed, len(self.faces), self.band)
        self._tree_is_posed = False

    def _find(self, points: Tensor, near: Tensor | None) -> Found:
        if near is not None or len(points) < _FEW:
            near = points.new_full((len(points),), -1, dtype=torch.int32) if near is None else near
            self.skin()  # fits the tree to the pose
            return ask(self._tell, points, near, self._all)
        found = self._scan(points, beyond=math.inf)
        self._ask_tree(points, found, found.face < 0)
        return found

    def _ask_tree(self, points: Tensor, found: Found, is_asked: Tensor) -> bool:
        """Replaces the answers that `is_asked` marks by the tree's, and says whether there are any."""
        any_asked = bool(is_asked.any())
        if any_asked:
            self.skin()  # fits the tree to the pose
            self._tell((len(points),), points, found.face, is_asked, *found)
        return any_asked

    def _pose_tree(self) -> BoxTree:
        points = self._require_update()
        if self._tree is None:
            self._tree = BoxTree(self.faces, points)
        if not self._tree_is_posed:
            self._tree.fit(points)
            self._tree_is_posed = True
        return self._tree


class BoxTree:
    """The boxes that `closest_in_boxes` reads, eight to a node: built for one pose, fitted to all others, on a CPU."""

    def __init__(self, faces: Tensor, rest: Tensor) -> None:
        """For `faces`, int32, shape (F, 3), grouped by where they are in a pose with the vertices `rest` (V, 3) [m].

        Faces that are close together there should be so in all poses; this affects speed alone.

        Raises `MeshError` for more faces than it has room for.
        """
        n = len(faces)
        if n > MAX_FACES:
            raise MeshError(f"a tree of boxes holds {MAX_FACES} faces, got {n}: simplify the body")
        depth = 0
        while _WIDTH ** (depth + 1) < n:
            depth += 1
        n_above = sum(_WIDTH**level for level in range(depth))  # nodes whose children are nodes
        corners = rest.detach().cpu().numpy()[faces.numpy()]
        order = grouped_at_rest(0.5 * (corners.min(1) + corners.max(1)), _WIDTH)
        self._order = torch.from_numpy(order.astype(np.int32))
        self._bounds = memory(n_above + -(-n // _WIDTH), 6, _WIDTH)
        self._bounds[:, :3], self._bounds[:, 3:] = torch.inf, -torch.inf
        self.boxes: Any = Boxes()
        """The boxes as kernels take them."""
        self.boxes.bounds = wp.from_torch(self._bounds, dtype=Eight)
        self.boxes.order = as_warp(self._order, wp.int32)
        self.boxes.first = _WIDTH * n_above + 1
        self._fit = Repeated(fit_kernel, (wp.vec3, wp.float32), [as_warp(faces, wp.int32), self.boxes])

    def fit(self, points: Tensor) -> None:
        """Fits the boxes to a pose with the vertices `points` (V, 3) [m]."""
        self._fit((1,), points, self._bounds)


class Scan:
    """Which of a garment's vertices are near the skin of a posed body, and on which side the others are."""

    def __init__(self, body: PosedMesh, n_faces: int, band: float) -> None:
        """For a `body` of `n_faces`; `band` in metres."""
        self._body, self._n_faces = body, n_faces
        self._cells = cells = Cells()
        cells.limit, cells.per_metre = band, 0.5 / band  # a cell is twice as wide as the band
        cells.number_of_row = wp.full(_N_ROWS, -1, dtype=wp.int32, device="cpu")
        cells.rows = wp.empty(_N_ROWS, dtype=wp.int32, device="cpu")
        cells.occupied = wp.empty(_N_ROWS, dtype=wp.uint64, device="cpu")
        cells.extent = wp.zeros(2, dtype=wp.vec3, device="cpu")
        self._sizes = memory(3, dtype=torch.int32)
        self._spread = Repeated(spread_sides_kernel, (wp.vec3, *[wp.int32] * 3, wp.float32, *[wp.int32] * 4))
        self._room = 0

    def __call__(self, points: Tensor, *, beyond: float) -> Found:
        """The closest face to each point (N, 3) within the band; where none is, face -1 and the distance `beyond`."""
        n = len(points)
        if n > self._room:
            self._make_room(max(n, 2 * self._room))
        self._sizes[0] = n
        self._sort((1,), points, self._sizes)
        self._scan.launch()
        return ask(self._finish, points, points.new_full((1,), beyond))

    def spread(self, points: Tensor, found: Found, ring: Adjacency) -> tuple[Tensor, Tensor]:
        """The state of each point, shape (N,), by its edges, and one point of each patch that nothing reaches."""
        state, queue, patches = points.new_empty(3, len(points), dtype=torch.int32)
        edges = map(torch.from_numpy, ring)
        self._spread((1,), points, self._sizes, *edges, found.distance, found.face, state, queue, patches)
        return state, patches[: int(self._sizes[2])].long()

    def _make_room(self, n: int) -> None:
        """For n points."""
        self._room, cells = n, self._cells
        cells.slot, cells.face = (wp.empty(n, dtype=wp.int32, device="cpu") for _ in range(2))
        cells.start = wp.empty((min(n, _N_ROWS), ROW + 2), dtype=wp.int32, device="cpu")
        cells.points = wp.empty(n, dtype=wp.vec3, device="cpu")
        cells.squared = wp.empty(n, dtype=wp.float32, device="cpu")
        self._sort = Repeated(sort_kernel, (wp.vec3, wp.int32), [cells])
        self._scan = Recorded(scan_kernel, self._n_faces, [self._body, cells], "cpu")
        self._finish = Repeated(finish_kernel, (wp.vec3, wp.float32, *FOUND), [self._body, cells])


def exact_sdf(body: SmplBody) -> BandSdf | ExactSdf:
    """The exact signed distance to posed bodies of a model, the fastest for garments on its device.

    On a CPU that is `BandSdf`. A GPU walks the tree faster than it sorts out what needn't be asked.
    """
    if body.device.type == "cpu":
        return BandSdf(body.faces, rest=body.v_template)
    return ExactSdf(body.faces, device=body.device)
