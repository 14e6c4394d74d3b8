"""The approximate signed distance of the real-time modes: a walk over the posed body from a face near by."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Recorded, Repeated, as_torch, as_warp, memory, torch_stream
from refu_core.body import SEGMENTS, SmplBody, part_of_faces
from refu_core.errors import MeshError, require_type
from refu_core.garments import GarmentTemplate
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._mesh import FOUND, Found, MeshSdf, ask
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

_SPACING = 0.05
"""Edge of the cubes in the rest pose that each hold one guide of each part [m]."""
_CELL = 0.045
"""Edge of the table's cells [m]. A guide is found from its own cell and most of the neighbours: 4 to 6 cm away."""
_DEPTH = 0.01
"""How far below its face a guide is entered [m]: points inside may be farther from the skin than those that matter
outside."""
EXACT_FROM = 0.03
"""Points that their walk finds deeper than this are queried exactly [m]. In most frames no cloth is as deep. Where some
is, the exact query's tree is refitted, for a tenth of what the walks take."""


class ApproxSdf(MeshSdf):
    """Signed distance to the closest face that is found by walking downhill (takes the place of the paper's network).

    A walk begins at a face near the point: the one that the garment's vertex was near before posing (`RestFaces`), or
    the last query's. It goes from face to face while the distance falls. Another part of the body (arm, thigh, trunk)
    within a few centimetres is walked over, too, from a *guide*: one of its faces, which a table over space names. The
    table is filled anew for each pose. A look at the guide's plane rules out most walks that would end no closer. The
    closest end counts.

    A point deep in a limb has several ways out of nearly the same length. Walks would end at one of them in one frame
    and at another in the next, and throw cloth from side to side. The few points of this kind are queried exactly.

    So the distance is always that to a face of the posed body: exact, or too large where no walk ended at the closest
    face. Sign, gradient and derivatives are those of `ExactSdf`. Within 2 cm of the skin the mean error is some
    hundredths of a millimetre, at less than a fifth of the exact query's cost (`refu_lab/benchmark/_sdfs.py`).
    """

    is_exact = False

    def __init__(
        self, body: SmplBody, *, device: str | torch.device | None = None, exact_from: float = EXACT_FROM
    ) -> None:
        """Prepares for poses of `body`, on `device` (by default the body's).

        Points that a walk finds deeper inside than `exact_from` [m] are queried exactly; with infinity none are.

        Raises `MeshError` for anything but a body, and when its faces aren't a closed, consistently oriented surface,
        or are more than a million.
        """
        require_type(body, SmplBody, "a body (load_body)", error=MeshError)
        super().__init__(body.faces, device=body.device if device is None else device)
        if len(self.faces) > MAX_FACES:
            msg = f"the approximate distance is for bodies of up to {MAX_FACES} faces, got {len(self.faces)}: use exact"
            raise MeshError(msg)
        self._body = body
        self._exact_from = exact_from
        # A GPU isn't waited for to know whether anything is that deep.
        self._is_serial = self.device.type == "cpu"
        faces, rest = body.faces.cpu().numpy(), body.v_template.double().cpu().numpy()
        # Within a segment the distance mostly falls all the way to the closest face; towards another it may rise first.
        part = part_of_faces(body.weights.cpu(), body.faces.cpu(), SEGMENTS.values()).int().numpy()
        self._cube = np.floor(rest[faces].mean(1) / _SPACING).astype(np.int64)
        """Which cube of the rest pose each face is in, shape (F, 3)."""
        self._links = torch.zeros(len(part), 2, 4, dtype=torch.int32, device=self.device)
        self._links[:, 0, :3] = self.faces
        self._links[:, 0, 3] = torch.from_numpy(part)
        self._links[:, 1, :3] = as_torch(self._posed.across)
        # Guides are spread over the body: one of each part in each cube.
        places = np.column_stack([self._cube, part])
        order = np.lexsort(places.T)  # stable; six times as fast as `np.unique` of rows
        chosen = np.sort(order[np.append(True, (np.diff(places[order], axis=0) != 0).any(1))])
        rows = np.column_stack([faces[chosen], (part[chosen] << FACE_BITS) | chosen]).astype(np.int32)
        self._guide_rows = torch.from_numpy(rows).to(self.device)
        self._table = memory(ROWS, COLUMNS, dtype=torch.int32, device=self.device)
        self._guides = Guides()
        self._guides.links = as_warp(self._links.view(-1, 4), wp.vec4i)
        self._guides.table, self._guides.cell = as_warp(self._table, wp.int32), _CELL
        # Few points are asked in it: a tree of the rest pose, whose limbs are apart, fits any pose well enough.
        self._exact = ExactSdf(body.faces, device=self.device, rebuild_distance=math.inf)
        self._exact.update(body.v_template.float())
        self._exact_is_late = True

    @cached_property
    def _rest_faces(self) -> RestFaces:
        return RestFaces(self._body)

    def of_garment(self, garment: GarmentTemplate) -> GarmentSdf:
        """As `BodySdf.of_garment`: walks begin where the vertices were near before posing."""
        rest_faces, order = self._rest_faces, self._none
        if self._is_serial:
            # Points over one cube of the rest pose follow each other: each finds in the cache what the last one read.
            order = torch.from_numpy(np.lexsort(self._cube[rest_faces(garment.v_template).numpy()].T)).int()

        def ask_garment(vertices: Tensor, *, on_mean: Tensor, reach: float = math.inf) -> SdfSample:  # noqa: ARG001
            self._require_update()
            where = self._checked(vertices)
            near = self._checked_faces(rest_faces(on_mean), len(where))
            return self._walk_from(where, near, order if len(order) == len(where) else self._none).sample()

        return ask_garment

    def _bind_skin(self) -> Any:
        skin = super()._bind_skin()
        skin.guides = self._guides
        return skin

    def _take_pose(self, *, is_new: bool) -> None:
        self._exact_is_late = True
        self._table.fill_(EMPTY)
        if is_new:
            guides = as_warp(self._guide_rows, wp.vec4i)
            inputs = [self._posed.points, _CELL, _DEPTH, guides, self._guides.table]
            self._enter = Recorded(enter_guides_kernel, len(guides), inputs, self.device)
            self._walk = Repeated(walk_kernel, (wp.vec3, wp.int32, wp.int32, *FOUND), [self._posed, self._guides])
            fixed = [self._exact_of_pose().mesh_id, self._posed, self._exact_from]
            self._ask_deep = Repeated(requery_deep_kernel, (wp.vec3, *FOUND), fixed)
        with torch_stream(self.device):
            self._enter.launch()

    def _find(self, points: Tensor, near: Tensor | None) -> Found:
        if near is None:  # no near face is known: the exact query is right, if slow
            near = self._exact_of_pose().closest(points).face
        return self._walk_from(points, near, self._none)

    def _walk_from(self, points: Tensor, near: Tensor, order: Tensor) -> Found:
        found = ask(self._walk, points, near, order)
        if len(points) and (not self._is_serial or float(found.distance.min()) < -self._exact_from):
            self._exact_of_pose()
            self._ask_deep((len(points),), points, *found)
        return found

    def _exact_of_pose(self) -> ExactSdf:
        if self._exact_is_late:
            self._exact.update(self._require_update())
            self._exact_is_late = False
        return self._exact
