"""The distance of a garment of which some vertices were moved."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.contact._moved_kernels import ask_moved_kernel
from refu_core.sdf import MeshSdf, SdfSample


class Moved:
    """Asks for the distance of what was moved alone, beginning at the face that was closest before."""

    def __init__(self, n_vertices: int, device: torch.device) -> None:
        """For garments of so many vertices N."""
        self._before, self._points, self._gradient = torch.zeros(3, n_vertices, 3, device=device)
        self._distance = torch.zeros(n_vertices, device=device)
        self._face = torch.zeros(n_vertices, dtype=torch.int32, device=device)
        self._skin: Any = None
        self._ask: Any = None

    @torch.no_grad()
    def __call__(self, before: Tensor, sample: SdfSample, points: Tensor, sdf: MeshSdf, *, reach: float) -> SdfSample:
        """What `sdf` says of vertices (N, 3) [m], given what it says of where they were `before`; not differentiable.

        Beyond `reach` [m] a distance may be a lower bound.
        """
        with torch_stream(self._points.device):
            for own, given in (
                (self._before, before),
                (self._points, points),
                (self._distance, sample.distance),
                (self._gradient, sample.gradient),
                (self._face, sample.face),
            ):
                assert given is not None  # these distances are to faces
                own.copy_(given)
            self._record(sdf.skin())
            self._ask.set_param_at_index(1, reach)
            self._ask.launch()
        return SdfSample(self._distance.clone(), self._gradient.clone(), self._face.clone())

    def _record(self, skin: Any) -> None:
        """Records the question, unless it is of the same body."""
        if skin is self._skin:
            return
        vectors = [as_warp(own, wp.vec3) for own in (self._before, self._points, self._gradient)]
        distance, face = as_warp(self._distance, wp.float32), as_warp(self._face, wp.int32)
        arguments = [skin, 0.0, *vectors[:2], distance, vectors[2], face]
        device = str(self._points.device)
        self._skin = skin
        self._ask = wp.launch(ask_moved_kernel, len(self._points), arguments, device=device, record_cmd=True)
