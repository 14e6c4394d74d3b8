"""The exact signed distance to a posed body: a BVH built once, refitted every frame."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.errors import MeshError
from refu_core.sdf._analytic import Feature, signed_distance
from refu_core.sdf._kernels import closest_kernel
from refu_core.sdf._protocol import SdfSample
from refu_core.sdf._topology import Topology

REBUILD_DISTANCE = 0.4
"""How far a vertex may move, on a CPU, before the BVH is built anew [m]. A refit costs 0.2 ms and leaves the tree as it
was; once the limbs it grouped have parted its boxes overlap, and queries take 1.5 to 2.5 times as long. Building takes
about as long as asking for one garment does, and at this distance is called for every 10 to 30 frames of a motion."""

_UNLIMITED = 1e18  # [m]; its square is still a float32
Sign = Literal["normal", "winding"]


class ClosestPoints(NamedTuple):
    """Where on the body some points are closest to it."""

    face: Tensor
    """Body face, int32, shape (N,); -1 where none lies within the distance asked for."""
    barycentrics: Tensor
    """Weights of that face's vertices, shape (N, 3)."""
    distance: Tensor
    """Distance without sign [m], shape (N,); infinite where `face` is -1."""
    sign: Tensor
    """+1 outside, -1 inside, shape (N,); +1 where `face` is -1, which says nothing."""


class ExactSdf:
    """Exact signed distance to a watertight body, on CPU and CUDA with the same kernels (the paper's "Acc. SDF").

    The distance is that to the closest triangle. Its sign is that of the angle-weighted pseudo-normal at the closest
    point, which is right wherever the body doesn't intersect itself, or (`sign="winding"`) of the winding number,
    six times slower and right within intersecting limbs too. The gradient is the unit direction to or from the closest
    point; on the surface, the pseudo-normal; it is finite everywhere, the medial axis included.

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
            msg = f'sign must be "normal" or "winding", got {sign!r}'
            raise MeshError(msg)
        topology = Topology.of_closed_mesh(faces.cpu() if isinstance(faces, Tensor) else faces)
        self.device = torch.device(device)
        self.sign: Sign = sign
        self.n_vertices = topology.n_vertices
        self.faces = torch.as_tensor(topology.faces, device=self.device)
        self._by_winding = sign == "winding"
        self._topology = [
            wp.array(array, dtype=wp.int32, device=str(self.device))
            for array in (topology.across, topology.fan_start, topology.fan_face)
        ]
        self._rebuild_distance = rebuild_distance
        self._vertices: Tensor | None = None  # as given, with its graph
        self._points: Tensor | None = None  # float32 copy that the BVH reads
        self._built_at = torch.empty(0, 3)  # the pose the BVH was built for
        self._mesh: Any = None

    def update(self, vertices: Tensor) -> None:
        """Takes over a new pose: `vertices` [m], shape (V, 3). The first call builds the BVH, most others refit it.

        Raises `MeshError` for a wrong shape, values that aren't finite, or a body turned inside out.
        """
        if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < self.n_vertices:
            msg = f"the body's vertices must have the shape ({self.n_vertices}, 3), got {tuple(vertices.shape)}"
            raise MeshError(msg)
        _require_finite("the body's vertices", vertices)
        if self._points is None or len(vertices) != len(self._points):
            self._points = torch.empty(len(vertices), 3, device=self.device)
            self._mesh = None
        self._vertices = vertices
        self._points.copy_(vertices.detach())
        if self._mesh is None:
            self._require_outward()
            self.rebuild()
        elif self._has_drifted():
            self.rebuild()
        else:
            with torch_stream(self.device):
                self._mesh.refit()

    def rebuild(self) -> None:
        """Builds the BVH anew for the present pose; answers don't depend on it. Raises `MeshError` before `update`."""
        points = self._require_update()
        self._built_at = points.clone()
        with torch_stream(self.device):
            self._mesh = wp.Mesh(
                as_warp(points, wp.vec3),
                as_warp(self.faces.view(-1), wp.int32),
                support_winding_number=self._by_winding,
            )

    def _has_drifted(self) -> bool:
        # A GPU would have to be waited for to know, and hides a loose tree better.
        if self.device.type != "cpu" or self._points is None:
            return False
        return float((self._points - self._built_at).abs().max()) > self._rebuild_distance

    def _require_outward(self) -> None:
        a, b, c = self._require_update().double()[self.faces.long()].unbind(1)
        if (a * torch.linalg.cross(b, c)).sum() <= 0:
            msg = "the body's faces must be counter-clockwise seen from outside: this body has a negative volume"
            raise MeshError(msg)

    @property
    def mesh_id(self) -> int:
        """The body as kernels of one's own take it (`wp.uint64`). Raises `MeshError` before the first `update`."""
        self._require_update()
        return int(self._mesh.id)

    def query(self, points: Tensor) -> SdfSample:
        """Signed distance and gradient at `points` [m], shape (N, 3), differentiable as the class says.

        Raises `MeshError` for a wrong shape, values that aren't finite, or when no body was set with `update`.
        """
        face, feature, barycentrics, normal, distance, gradient = self._search(points, math.inf)
        assert self._vertices is not None  # _search has seen to it
        tracked = torch.is_grad_enabled() and (points.requires_grad or self._vertices.requires_grad)
        if not tracked and points.dtype == torch.float32:
            return SdfSample(distance, gradient, face)
        corners = self._vertices.to(points)[self.faces.long()[face.long()]]
        found = Feature(feature, normal.to(points), distance.sign().to(points), barycentrics.to(points))
        return signed_distance(points, corners, found)._replace(face=face)

    def closest(self, points: Tensor, *, max_distance: float = math.inf) -> ClosestPoints:
        """The closest point of the body to each of `points` [m], shape (N, 3), where one is within `max_distance` [m].

        Not differentiable; raises as `query`.
        """
        face, _, barycentrics, _, distance, _ = self._search(points, max_distance)
        sign = torch.where(distance < 0, -1.0, 1.0)
        return ClosestPoints(face, barycentrics, distance.abs(), sign)

    def _search(self, points: Tensor, max_distance: float) -> tuple[Tensor, ...]:
        self._require_update()
        if points.ndim != 2 or points.shape[1] != 3:
            msg = f"points must have the shape (N, 3), got {tuple(points.shape)}"
            raise MeshError(msg)
        if not max_distance > 0:
            msg = f"max_distance must be positive, got {max_distance}"
            raise MeshError(msg)
        _require_finite("points", points)
        n = len(points)
        where = points.detach().to(device=self.device, dtype=torch.float32).contiguous()
        ints = torch.empty(2, n, dtype=torch.int32, device=self.device)
        vectors = torch.empty(3, n, 3, device=self.device)
        distance = torch.empty(n, device=self.device)
        if n:
            outputs = [ints[0], ints[1], vectors[0], vectors[1], distance, vectors[2]]
            kinds = [wp.int32, wp.int32, wp.vec3, wp.vec3, wp.float32, wp.vec3]
            with torch_stream(self.device):
                wp.launch(
                    closest_kernel,
                    dim=n,
                    inputs=[
                        self._mesh.id,
                        *self._topology,
                        as_warp(where, wp.vec3),
                        min(max_distance, _UNLIMITED),
                        self._by_winding,
                    ],
                    outputs=[as_warp(tensor, kind) for tensor, kind in zip(outputs, kinds, strict=True)],
                    device=str(self.device),
                )
        return ints[0], ints[1], vectors[0], vectors[1], distance, vectors[2]

    def _require_update(self) -> Tensor:
        if self._points is None:
            msg = "no body yet: call update(vertices) before asking for distances"
            raise MeshError(msg)
        return self._points


def _require_finite(name: str, values: Tensor) -> None:
    if values.is_cuda and torch.cuda.is_current_stream_capturing():
        return  # a CUDA graph can't wait for the answer; what it replays was checked where it came in
    if not bool(torch.isfinite(values).all()):
        bad = int((~torch.isfinite(values)).any(dim=-1).sum())
        msg = f"{name} must be finite, got {bad} of {len(values)} with NaN or infinite coordinates"
        raise MeshError(msg)
