"""The exact signed distance to a posed body: a BVH built once, refitted every frame."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import Repeated, as_warp, memory, torch_stream
from refu_core.errors import MeshError
from refu_core.sdf._closest_kernels import closest_kernel
from refu_core.sdf._mesh import FOUND, Found, MeshSdf, ask

REBUILD_DISTANCE = 0.4
"""How far a vertex may move, on a CPU, before the BVH is built anew [m]. A refit costs 0.2 ms and keeps the tree. Once
limbs that it grouped have parted, its boxes overlap, and queries take 1.5 to 2.5 times as long. Building takes about as
long as the query of one garment; with this distance it happens every 10 to 30 frames of a motion."""

_UNLIMITED = 1e18  # [m]; its square is still a float32
Sign = Literal["normal", "winding"]


class ClosestPoints(NamedTuple):
    """Where the body is closest to each of some points."""

    face: Tensor
    """Body face, int32, shape (N,); -1 where none lies within the distance asked for."""
    barycentrics: Tensor
    """Weights of that face's vertices, shape (N, 3)."""
    distance: Tensor
    """Distance without sign [m], shape (N,); infinite where `face` is -1."""
    sign: Tensor
    """+1 outside, -1 inside, shape (N,); +1 where `face` is -1, which says nothing."""


class ExactSdf(MeshSdf):
    """Exact signed distance to a watertight body, on CPU and CUDA with the same kernels (the paper's "Acc. SDF").

    The distance is that to the closest triangle. Its sign is that of the angle-weighted pseudo-normal at the closest
    point, which is right wherever the body doesn't intersect itself and no two of its vertices are at one place, or
    (`sign="winding"`) of the winding number, six times slower and right there, too. The gradient is the unit direction
    to or from the closest point; on the surface, the pseudo-normal; it is finite everywhere, the medial axis included.

    Both are differentiable with respect to the points and the body's vertices: where either requires a gradient (and
    for float64), they are computed again in torch from the closest face, edge or vertex found.
    """

    def __init__(
        self,
        faces: Tensor | NDArray[Any],
        *,
        device: str | torch.device = "cpu",
        sign: Sign = "normal",
        rebuild_distance: float = REBUILD_DISTANCE,
    ) -> None:
        """Prepares for bodies of these `faces`, shape (F, 3), counter-clockwise seen from outside.

        `rebuild_distance` [m] is a matter of speed alone; infinity builds the BVH once and for all.

        Raises `MeshError` when the faces aren't a closed, consistently oriented surface.
        """
        if sign not in ("normal", "winding"):
            raise MeshError(f'sign must be "normal" or "winding", got {sign!r}')
        super().__init__(faces, device=device)
        self._by_winding = sign == "winding"
        self._rebuild_distance = rebuild_distance
        self._built_at = memory(0, 3)  # the pose the BVH was built for
        self._mesh: Any = None

    def _take_pose(self, *, is_new: bool) -> None:
        if is_new or self._has_drifted():
            self.rebuild()
        else:
            with torch_stream(self.device):
                self._mesh.refit()

    def rebuild(self) -> None:
        """Builds the BVH anew for the present pose; answers don't depend on it. Raises `MeshError` before `update`."""
        self._built_at = self._require_update().clone()
        self._skin = None
        with torch_stream(self.device):
            self._mesh = wp.Mesh(
                self._posed.points, as_warp(self.faces.view(-1), wp.int32), support_winding_number=self._by_winding
            )
        kinds = (wp.vec3, wp.int32, wp.float32, *FOUND)
        self._ask = Repeated(closest_kernel, kinds, [self._mesh.id, self._posed, self._by_winding])

    def _has_drifted(self) -> bool:
        # A GPU would have to be waited for to know this, and it hides the cost of a loose tree better.
        if self.device.type != "cpu" or self._points is None or self._rebuild_distance == math.inf:
            return False
        return float((self._points - self._built_at).abs().max()) > self._rebuild_distance

    @property
    def mesh_id(self) -> int:
        """The body as custom kernels take it (`wp.uint64`). Raises `MeshError` before the first `update`."""
        self._require_update()
        return int(self._mesh.id)

    def _bind_skin(self) -> Any:
        skin = super()._bind_skin()
        skin.tree = self._mesh.id
        return skin

    def closest(self, points: Tensor, *, max_distance: float = math.inf, near: Tensor | None = None) -> ClosestPoints:
        """The closest point of the body to each of `points` [m], shape (N, 3), where one is within `max_distance` [m].

        `near`, integers of shape (N,), may name a body face near each point, which makes the search shorter, or be -1.

        Not differentiable; raises as `query`.
        """
        if not max_distance > 0:
            raise MeshError(f"max_distance must be positive, got {max_distance}")
        self._require_update()
        where = self._checked(points)
        near = None if near is None else self._checked_faces(near, len(where), least=-1)
        found = self._find(where, near, min(max_distance, _UNLIMITED))
        _, barycentrics, _ = self._features(where, found.face)
        return ClosestPoints(found.face, barycentrics, found.distance.abs(), torch.where(found.distance < 0, -1.0, 1.0))

    def _find(self, points: Tensor, near: Tensor | None, max_distance: float = _UNLIMITED) -> Found:
        farthest = points.new_full((1,), max_distance)
        return ask(self._ask, points, self._none if near is None else near, farthest)
