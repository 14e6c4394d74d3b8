"""The approximate signed distance of the real-time modes: a walk over the posed body from a face near by."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.errors import MeshError
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._mesh import Found, MeshSdf, Recorded
from refu_core.sdf._walk import COLUMNS, EMPTY, FACE_BITS, MAX_FACES, ROWS, deep_kernel, enter_kernel, walk_kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from refu_core.body import SmplBody

_PARTS: tuple[tuple[int, ...], ...] = (
    (0, 3, 6, 9, 13, 14),  # trunk
    (12, 15),  # neck and head
    (16,),  # upper arms
    (17,),
    (18, 20, 22),  # forearms and hands
    (19, 21, 23),
    (1,),  # thighs
    (2,),
    (4, 7, 10),  # shins and feet
    (5, 8, 11),
)
"""SMPL joints of the parts that a body is cut into where it folds: over one part the distance mostly falls all the way
to the closest face, from one to another it may first have to rise."""
_SPACING = 0.05
"""Edge of the cubes of the rest pose that have one guide of each part in them [m]."""
_CELL = 0.045
"""Edge of the table's cells [m]. A guide is found from its own cell and most of the neighbours: 4 to 6 cm away."""
_DEPTH = 0.01
"""How far below its face a guide is entered [m]: what is inside may be deeper than what matters outside is far."""
EXACT_FROM = 0.03
"""How deep a point is, by its walk, that is asked exactly [m]: deeper than cloth is in most frames, and these cost what
they did. In a frame that has such points the exact query's tree is refitted, for a tenth of what walks take."""

_MANY = 1000
"""From this number of points on their order matters."""
_MAX_ORDERS = 16
"""Orders that are kept, one a number of points."""


class ApproxSdf(MeshSdf):
    """Signed distance to the closest face that is found by walking downhill (takes the place of the paper's network).

    A garment's vertex is near some face of the body already: the one that it was near before posing (`RestFaces`), or
    in the last query. From there the walk goes from face to face while the distance falls. Where another part of the
    body (arm, thigh, trunk, …) is within a few centimetres, too, it is walked over from one of its faces, a *guide*,
    that a table of space names; the table is filled anew for each pose. A look at the guide's plane tells most of the
    walks that would end no closer. The closest end of these walks counts.

    What is as deep as the middle of a limb has several ways out of nearly one length, and cloth is thrown from side to
    side by a walk that ends at another one than the last frame's. The few points of this kind are asked exactly.

    So the distance is always that to a face of the posed body: exact, or too large where none of the walks ended at the
    closest face. Sign, gradient and derivatives are those of `ExactSdf`. Within 2 cm of the skin the mean error is some
    hundredths of a millimetre; benchmarks/sdf.py measures it, and the cost: less than a fifth of the exact query's.

    Needs nothing but the posed vertices, so it works for every β, γ and pose, and builds nothing for them.
    """

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
        self._exact_from = exact_from
        # A GPU isn't waited for to know whether anything is that deep.
        self._is_serial = self.device.type == "cpu"
        part = _part_of_faces(body)
        self._links = torch.zeros(len(part), 2, 4, dtype=torch.int32, device=self.device)
        self._links[:, 0, :3] = self.faces
        self._links[:, 0, 3] = torch.from_numpy(part)
        self._links[:, 1, :3] = wp.to_torch(self._topology[0])
        self._links_wp = as_warp(self._links.view(-1, 4), wp.vec4i)
        cube = _cube_of_faces(body)
        rank = np.empty(len(part), np.int64)
        rank[np.lexsort(cube.T)] = np.arange(len(part))
        self._rank = torch.from_numpy(rank)
        self._guides = wp.array(_guides(body, part, cube), dtype=wp.vec4i, device=str(self.device))
        self._table = torch.empty(ROWS, COLUMNS, dtype=torch.int32, device=self.device)
        self._table_wp = as_warp(self._table, wp.int32)
        # Few points are asked in it: a tree of the rest pose, whose limbs are apart, fits any pose well enough.
        self._exact = ExactSdf(body.faces, device=self.device, rebuild_distance=math.inf)
        self._exact.update(body.v_template.float())
        self._exact_is_late = True
        self._enter: Any = None  # both recorded for the tensors that hold the pose
        self._walk: Recorded | None = None
        self._none = wp.empty(0, dtype=wp.int32, device=str(self.device))
        self._orders: dict[int, Any] = {}

    def _bind_skin(self) -> Any:
        skin = super()._bind_skin()
        skin.links, skin.table, skin.cell = self._links_wp, self._table_wp, _CELL
        return skin

    def _take_pose(self, *, is_new: bool) -> None:
        self._exact_is_late = True
        self._table.fill_(EMPTY)
        if is_new:
            self._enter = wp.launch(
                enter_kernel,
                dim=len(self._guides),
                inputs=[self._points_wp, self._guides, _CELL, _DEPTH],
                outputs=[self._table_wp],
                device=str(self.device),
                record_cmd=True,
            )
            self._walk = Recorded(walk_kernel, self._inputs) if self.device.type == "cpu" else None
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
                    inputs=self._inputs(as_warp(points, wp.vec3), as_warp(near, wp.int32)),
                    outputs=found.as_warp(),
                    device=str(self.device),
                )
            self._ask_deep(points, found)
        return found

    def _ask_deep(self, points: Tensor, found: Found) -> None:
        """Has the exact query's answers take the place of those of walks that ended far above a point."""
        exact = self._exact_of_pose()
        with torch_stream(self.device):
            wp.launch(
                deep_kernel,
                dim=len(points),
                inputs=[
                    exact.mesh_id,
                    self._points_wp,
                    self._faces,
                    *self._topology,
                    self._exact_from,
                    as_warp(points, wp.vec3),
                ],
                outputs=found.as_warp(),
                device=str(self.device),
            )

    def _inputs(self, points: Any, near: Any) -> list[Any]:
        """What `walk_kernel` reads."""
        return [
            self._points_wp,
            self._faces,
            *self._topology,
            self._links_wp,
            self._table_wp,
            _CELL,
            points,
            near,
            self._none,
        ]

    def _order(self, near: Tensor) -> Any:
        """Points over the same cube of the rest pose one after another: one finds in the cache what the last has read.

        Any order gives the same answers, so that of the first points of their number, a garment's vertices, will do.
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
        """Where nothing is known to be near a point the exact query finds it: right, and as slow."""
        return self._exact_of_pose().closest(points).face

    def _exact_of_pose(self) -> ExactSdf:
        if self._exact_is_late:
            self._exact.update(self._require_update())
            self._exact_is_late = False
        return self._exact


def _part_of_faces(body: SmplBody) -> NDArray[np.int32]:
    groups = np.zeros((body.weights.shape[1], len(_PARTS)))
    for part, joints in enumerate(_PARTS):
        groups[list(joints), part] = 1
    weights = body.weights.double().cpu().numpy() @ groups
    largest: NDArray[np.int32] = weights[body.faces.cpu().numpy()].sum(1).argmax(1).astype(np.int32)
    return largest


def _cube_of_faces(body: SmplBody) -> NDArray[np.int64]:
    """Which cube of the rest pose each face is in, shape (F, 3)."""
    middles = body.v_template.double().cpu().numpy()[body.faces.cpu().numpy()].mean(1)
    cube: NDArray[np.int64] = np.floor(middles / _SPACING).astype(np.int64)
    return cube


def _guides(body: SmplBody, part: NDArray[np.int32], cube: NDArray[np.int64]) -> NDArray[np.int32]:
    """Faces spread over the body, one of each part in each cube of the rest pose, as `enter_kernel` reads them."""
    faces = body.faces.cpu().numpy()
    _, first = np.unique(np.column_stack([cube, part]), axis=0, return_index=True)
    chosen = np.sort(first)
    rows: NDArray[np.int32] = np.column_stack([faces[chosen], (part[chosen] << FACE_BITS) | chosen]).astype(np.int32)
    return rows
