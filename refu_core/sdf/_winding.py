"""Whether points are inside a posed body, by the winding number: the measure that collision handling is held to."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import IN_ROW, Repeated, Unpicklable, as_warp, memory, strips
from refu_core.mesh import Connectivity
from refu_core.sdf._winding_kernels import CELLS, bin_kernel, crossings_kernel, extent_kernel

_N_CELLS = int(CELLS)


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
        # The first point of each cell, the least distance in it, and the box around all points; of no points at first.
        n = 2 * _N_CELLS**2
        self._empty, self._cells = memory(2, 2 * n + 6, dtype=torch.int32, device=device)
        self._first, self._farthest_in, self._box = _parts(self._cells, n)
        first, farthest_in, box = _parts(self._empty, n)
        first.fill_(-1)
        farthest_in.fill_(torch.inf)
        box[0].fill_(torch.inf)
        box[1].fill_(-torch.inf)
        # A CPU's compiler keeps more in registers within a loop than from call to call.
        n_faces = len(mesh.faces)
        each = n_faces if device.type == "cpu" else 1
        self._n_threads = n_faces // each
        body = as_warp(self._body, wp.vec3), wp.array(mesh.faces, dtype=wp.vec3i, device=str(device))
        listed = (wp.int32, wp.vec3, wp.vec3, wp.int32, wp.int32, wp.float32)
        self._bound = Repeated(extent_kernel, (wp.int32, wp.int32, wp.vec3, wp.vec3))
        self._sort = Repeated(bin_kernel, listed)
        self._cross = Repeated(crossings_kernel, (*listed, wp.int32), [each, *body])
        self._always = memory(1, dtype=torch.int32, device=device).fill_(1)

    def update(self, vertices: Tensor) -> None:
        """Takes over a pose: the body's vertices [m], shape (V, 3)."""
        self._body.copy_(vertices.detach()[: len(self._body)])

    def __call__(self, points: Tensor, wanted: Tensor | None = None) -> Tensor:
        """The winding numbers of points [m], shape (N, 3): int32, (N,). A GPU isn't waited for.

        `wanted`, if given, is int32 of shape (1,) on the device: where it is 0, zeros are returned instead.
        """
        n, device = len(points), self._body.device
        points = points.to(device=device, dtype=torch.float32).contiguous()
        winding, following = (torch.zeros(n, dtype=torch.int32, device=device) for _ in range(2))
        if n:
            self._cells.copy_(self._empty)
            wanted = self._always if wanted is None else wanted
            listed = wanted, points, self._box, self._first, following, self._farthest_in
            n_strips, each = strips(n, device, at_least=IN_ROW)
            self._bound((n_strips,), wanted, each, points, self._box)
            self._sort((n,), *listed)
            self._cross((self._n_threads,), *listed, winding)
        return winding


def _parts(cells: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """The first point of each of `n` cells, int32 (n,), the least distances there, (n,), and a box, (2, 3)."""
    numbers = cells[n:].view(torch.float32)
    return cells[:n], numbers[:n], numbers[n:].view(2, 3)
