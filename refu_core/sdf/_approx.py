"""The approximate signed distance of the real-time modes: a walk over the posed body from a face near by."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.body import SEGMENTS, part_of_faces
from refu_core.errors import MeshError
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._mesh import Found, MeshSdf, Recorded
from refu_core.sdf._protocol import GarmentSdf, SdfSample
from refu_core.sdf._rest import RestFaces
from refu_core.sdf._walk_kernels import (
    COLUMNS,
    EMPTY,
    FACE_BITS,
    MAX_FACES,
    ROWS,
    Guides,
    enter_guides_kernel,
    requery_deep_kernel,
    walk_kernel,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from refu_core.body import SmplBody
    from refu_core.garments import GarmentTemplate

# Over one segment of the body the distance mostly falls all the way to the closest face. From one to another it may
# have to rise first.
_PARTS = tuple(SEGMENTS.values())
_SPACING = 0.05
"""Edge of the cubes of the rest pose that have one guide of each part in them [m]."""
_CELL = 0.045
"""Edge of the table's cells [m]. A guide is found from its own cell and most of the neighbours: 4 to 6 cm away."""
_DEPTH = 0.01
"""How far below its face a guide is entered [m]: points inside may be farther from the skin than those that matter
outside."""
EXACT_FROM = 0.03
"""Points deeper than this by their walk are asked exactly [m]. In most frames no cloth is as deep. Where some is, the
exact query's tree is refitted, for a tenth of what the walks take."""

_MANY = 1000
"""From so many points on, their order matters."""
_MAX_ORDERS = 16
"""Orders that are kept, one for each number of points."""


class ApproxSdf(MeshSdf):
    """Signed distance to the closest face that is found by walking downhill (takes the place of the paper's network).

    A walk begins at a face near the point: the one that the garment's vertex was near before posing (`RestFaces`), or
    the last query's. It goes from face to face while the distance falls. Another part of the body (arm, thigh, trunk)
    within a few centimetres is walked over, too, from a *guide*: one of its faces, which a table of space names. The
    table is filled anew for each pose. A look at the guide's plane rules out most walks that would end no closer. The
    closest end counts.

    A point deep in a limb has several ways out of nearly one length. Walks would end at one of them in a frame and at
    another in the next, and throw cloth from side to side. The few points of this kind are asked exactly.

    So the distance is always that to a face of the posed body: exact, or too large where no walk ended at the closest
    face. Sign, gradient and derivatives are those of `ExactSdf`. Within 2 cm of the skin the mean error is some
    hundredths of a millimetre, at less than a fifth of the exact query's cost (benchmarks/sdf.py).

    It needs the posed vertices alone, so it works for every β, γ and pose.
    """

    is_exact = False

    def __init__(
        self, body: SmplBody, *, device: str | torch.device | None = None, exact_from: float = EXACT_FROM
    ) -> None:
        """Prepares for poses of `body`, on `device` (by default the body's).

        What a walk says is deeper inside than `exact_from` [m] is asked exactly; infinity leaves it at walks.

        Raises `MeshError` when its faces aren't a closed, consistently oriented surface, or are more than a million.
        """
        super().__init__(body.faces, device=body.device if device is None else device)
        if len(self.faces) > MAX_FACES:
            msg = f"the approximate distance is for bodies of up to {MAX_FACES} faces, got {len(self.faces)}: use exact"
            raise MeshError(msg)
        self._body = body
        self._exact_from = exact_from
        # A GPU isn't waited for to know whether anything is that deep.
        self._is_serial = self.device.type == "cpu"
        part = _part_of_faces(body)
        self._links = torch.zeros(len(part), 2, 4, dtype=torch.int32, device=self.device)
        self._links[:, 0, :3] = self.faces
        self._links[:, 0, 3] = torch.from_numpy(part)
        self._links[:, 1, :3] = wp.to_torch(self._posed.across)
        cube = _cube_of_faces(body)
        rank = np.empty(len(part), np.int64)
        rank[np.lexsort(cube.T)] = np.arange(len(part))
        self._rank = torch.from_numpy(rank)
        self._guide_rows: Any = wp.array(_guide_rows(body, part, cube), dtype=wp.vec4i, device=str(self.device))
        self._table = torch.empty(ROWS, COLUMNS, dtype=torch.int32, device=self.device)
        self._guides = Guides()
        self._guides.links = as_warp(self._links.view(-1, 4), wp.vec4i)
        self._guides.table, self._guides.cell = as_warp(self._table, wp.int32), _CELL
        # Few points are asked in it: a tree of the rest pose, whose limbs are apart, fits any pose well enough.
        self._exact = ExactSdf(body.faces, device=self.device, rebuild_distance=math.inf)
        self._exact.update(body.v_template.float())
        self._exact_is_late = True
        self._enter: Any = None  # both recorded for the tensors that hold the pose
        self._walk: Recorded | None = None
        self._none = wp.empty(0, dtype=wp.int32, device=str(self.device))
        self._orders: dict[int, Any] = {}

    @cached_property
    def _rest_faces(self) -> RestFaces:
        return RestFaces(self._body)

    def of_garment(self, garment: GarmentTemplate) -> GarmentSdf:  # noqa: ARG002
        """As `BodySdf.of_garment`: walks begin where the vertices were near before posing."""
        rest_faces = self._rest_faces

        def ask(vertices: Tensor, *, on_mean: Tensor, reach: float = math.inf) -> SdfSample:  # noqa: ARG001
            return self.query(vertices, near=rest_faces(on_mean))

        return ask

    def _bind_skin(self) -> Any:
        skin = super()._bind_skin()
        skin.guides = self._guides
        return skin

    def _take_pose(self, *, is_new: bool) -> None:
        self._exact_is_late = True
        self._table.fill_(EMPTY)
        if is_new:
            self._enter = wp.launch(
                enter_guides_kernel,
                dim=len(self._guide_rows),
                inputs=[self._posed.points, self._guide_rows, _CELL, _DEPTH],
                outputs=[self._guides.table],
                device=str(self.device),
                record_cmd=True,
            )
            if self.device.type == "cpu":
                self._walk = Recorded(walk_kernel, (self._posed, self._guides), (self._none,))
        with torch_stream(self.device):
            self._enter.launch()

    def _find(self, points: Tensor, near: Tensor | None) -> Found:
        near = self._seek(points) if near is None else near
        if self._walk is not None:
            found = self._walk.ask(points, near, last=self._order(near))
            if len(points) and (not self._is_serial or float(found.distance.min()) < -self._exact_from):
                self._ask_deep(points, found)
            return found
        found = Found.empty(len(points), self.device)
        if len(points):
            with torch_stream(self.device):
                wp.launch(
                    walk_kernel,
                    dim=len(points),
                    inputs=[self._posed, self._guides, as_warp(points, wp.vec3), as_warp(near, wp.int32), self._none],
                    outputs=found.as_warp(),
                    device=str(self.device),
                )
            self._ask_deep(points, found)
        return found

    def _ask_deep(self, points: Tensor, found: Found) -> None:
        """Replaces the answers of walks that ended far above a point by those of the exact query."""
        exact = self._exact_of_pose()
        with torch_stream(self.device):
            wp.launch(
                requery_deep_kernel,
                dim=len(points),
                inputs=[exact.mesh_id, self._posed, self._exact_from, as_warp(points, wp.vec3)],
                outputs=found.as_warp(),
                device=str(self.device),
            )

    def _order(self, near: Tensor) -> Any:
        """Points over the same cube of the rest pose in a row, so that each finds in the cache what the last one read.

        Any order gives the same answers, so the order is that of the first points of their number.
        """
        n = len(near)
        if n < _MANY:
            return self._none
        if n not in self._orders:
            if len(self._orders) >= _MAX_ORDERS:
                self._orders.clear()
            self._orders[n] = wp.array(self._rank[near.long()].argsort().int().numpy(), dtype=wp.int32, device="cpu")
        return self._orders[n]

    def _seek(self, points: Tensor) -> Tensor:
        """The closest faces, by the exact query, where nothing is known to be near: right, and as slow."""
        return self._exact_of_pose().closest(points).face

    def _exact_of_pose(self) -> ExactSdf:
        if self._exact_is_late:
            self._exact.update(self._require_update())
            self._exact_is_late = False
        return self._exact


def _part_of_faces(body: SmplBody) -> NDArray[np.int32]:
    part: NDArray[np.int32] = part_of_faces(body.weights.cpu(), body.faces.cpu(), _PARTS).int().numpy()
    return part


def _cube_of_faces(body: SmplBody) -> NDArray[np.int64]:
    """Which cube of the rest pose each face is in, shape (F, 3)."""
    middles = body.v_template.double().cpu().numpy()[body.faces.cpu().numpy()].mean(1)
    cube: NDArray[np.int64] = np.floor(middles / _SPACING).astype(np.int64)
    return cube


def _guide_rows(body: SmplBody, part: NDArray[np.int32], cube: NDArray[np.int64]) -> NDArray[np.int32]:
    """Faces spread over the body, one of each part in each cube of the rest pose, for `enter_guides_kernel`."""
    faces = body.faces.cpu().numpy()
    _, first = np.unique(np.column_stack([cube, part]), axis=0, return_index=True)
    chosen = np.sort(first)
    rows: NDArray[np.int32] = np.column_stack([faces[chosen], (part[chosen] << FACE_BITS) | chosen]).astype(np.int32)
    return rows
