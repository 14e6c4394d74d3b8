"""Whether points are inside a posed body, by the winding number: the measure that collision handling is held to."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import IN_ROW, Repeated, Unpicklable, as_warp, memory
from refu_core.mesh import Connectivity
from refu_core.sdf._winding_kernels import CELLS, STEPS, Bins, winding_kernel


class Winding(Unpicklable):
    """The winding numbers of a closed mesh at points, exact for float32 vertices.

    A point is inside where its winding number isn't 0, also where limbs run into each other. The number has nothing in
    common with the signs by which garments are brought off the body, nor with the faces found for that.
    """

    def __init__(self, faces: Tensor, vertices: Tensor | None = None) -> None:
        """For bodies of these `faces`, shape (F, 3), on their device.

        `vertices`, float32 (V, 3), is memory that poses [m] are in; by default it is this one's own, for `update`.

        Raises `MeshError` when they aren't a closed, consistently oriented surface.
        """
        mesh = Connectivity.of(faces.cpu())
        mesh.require_closed()
        device = faces.device
        self._body = memory(mesh.n_vertices, 3, device=device) if vertices is None else vertices
        where, n_cells, n = str(device), 2 * int(CELLS) ** 2, len(mesh.faces)
        bins = Bins()
        bins.first = wp.empty(n_cells, dtype=wp.int32, device=where)
        bins.nearest = wp.empty(n_cells, dtype=wp.float32, device=where)
        bins.box = wp.empty(2, dtype=wp.vec3, device=where)
        self._known = as_warp(self._body, wp.vec3), wp.array(mesh.faces, dtype=wp.vec3i, device=where), bins
        # On a GPU a thread takes one face, but many points while it looks for their box.
        strides = [-(-n // IN_ROW) if step == 1 else n for step in range(STEPS)]
        self._steps = self._launches([(-1, 1)] if device.type == "cpu" else [*enumerate(strides)])
        self._always = memory(1, dtype=torch.int32, device=device).fill_(1)

    def _launches(self, steps: Sequence[tuple[int, int]]) -> list[tuple[int, Repeated]]:
        """The number of threads, and the launch, of steps and strides as `winding_kernel` takes them."""
        kinds = (wp.int32, wp.vec3, wp.int32, wp.int32)
        return [(n, Repeated(winding_kernel, kinds, [step, n, *self._known])) for step, n in steps]

    def update(self, vertices: Tensor) -> None:
        """Takes over a pose: the body's vertices [m], shape (V, 3)."""
        self._body.copy_(vertices.detach()[: len(self._body)])

    def __call__(self, points: Tensor, wanted: Tensor | None = None) -> Tensor:
        """The winding numbers of points [m], shape (N, 3): int32, (N,). A GPU isn't waited for.

        `wanted`, if given, is int32 of shape (1,) on the device: where it is 0, zeros are returned instead.
        """
        device = self._body.device
        points = points.to(device=device, dtype=torch.float32).contiguous()
        winding = torch.zeros(len(points), dtype=torch.int32, device=device)
        if len(points):
            following, wanted = torch.empty_like(winding), self._always if wanted is None else wanted
            for n_threads, step in self._steps:
                step((n_threads,), wanted, points, following, winding)
        return winding
