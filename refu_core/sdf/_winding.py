"""How many points are inside a posed body, by the winding number: what collision handling is held against."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.mesh import Connectivity
from refu_core.sdf._winding_kernels import CELLS, bin_kernel, crossings_kernel

_N_CELLS = int(CELLS)


class Winding:
    """The winding numbers of a closed mesh at points, exact for float32 vertices.

    A point is inside where its winding number isn't 0. That is so wherever limbs run into each other, too, and has
    nothing in common with the signs by which garments are brought off the body, nor with the faces found for that.
    """

    def __init__(self, faces: Tensor) -> None:
        """For bodies of these `faces`, shape (F, 3), on their device.

        Raises `MeshError` when they aren't a closed, consistently oriented surface.
        """
        mesh = Connectivity.of(faces.cpu())
        mesh.require_closed()
        self._device = faces.device
        self._faces = wp.array(mesh.faces, dtype=wp.vec3i, device=str(self._device))
        self._n_faces = len(mesh.faces)
        self._body = torch.zeros(mesh.n_vertices, 3, device=self._device)
        self._grid = torch.zeros(4, 3, device=self._device)
        self._first = torch.zeros(2 * _N_CELLS**2, dtype=torch.int32, device=self._device)
        self._farthest_in = torch.zeros(2 * _N_CELLS**2, device=self._device)
        self._cells = [
            as_warp(tensor, kind)
            for tensor, kind in (
                (self._grid, wp.vec3),
                (self._first, wp.int32),
                (self._farthest_in, wp.float32),
            )
        ]
        self._body_wp = as_warp(self._body, wp.vec3)
        self._launches: dict[int, _Launches] = {}

    def update(self, vertices: Tensor) -> None:
        """Takes over a pose: the body's vertices [m], shape (V, 3)."""
        self._body.copy_(vertices.detach()[: len(self._body)])

    @torch.no_grad()
    def __call__(self, points: Tensor) -> Tensor:
        """The winding numbers of points [m], shape (N, 3): int32, (N,), in memory that the next call overwrites.

        A GPU isn't waited for.
        """
        n = len(points)
        if n not in self._launches:
            self._launches[n] = _Launches(self, n)
        known = self._launches[n]
        known.points.copy_(points)
        known.winding.zero_()
        if n:
            torch.aminmax(known.points, dim=0, out=(self._grid[0], self._grid[1]))
            extent = self._grid[1] - self._grid[0]
            # A hair less, so that the last point is in the last cell.
            torch.div(0.9999 * _N_CELLS, extent.clamp_min(1e-6), out=self._grid[2])
            torch.lerp(self._grid[0], self._grid[1], 0.5, out=self._grid[3])
            self._first.fill_(-1)
            self._farthest_in.fill_(torch.inf)
            with torch_stream(self._device):
                known.sort.launch()
                known.cross.launch()
        return known.winding


class _Launches:
    """Those for one number of points, recorded, and their memory."""

    def __init__(self, of: Winding, n: int) -> None:
        device = of._device
        self.points = torch.zeros(n, 3, device=device)
        self.winding = torch.zeros(n, dtype=torch.int32, device=device)
        following = wp.empty(n, dtype=wp.int32, device=str(device))
        points, winding = as_warp(self.points, wp.vec3), as_warp(self.winding, wp.int32)
        grid, first, farthest_in = of._cells

        def record(kernel: Any, dim: int, inputs: list[Any]) -> Any:
            return wp.launch(kernel, dim, inputs, device=str(device), record_cmd=True)

        self.sort = record(bin_kernel, n, [points, grid, first, following, farthest_in])
        # A CPU's compiler keeps more in registers within a loop than from call to call.
        each = of._n_faces if of._device.type == "cpu" else 1
        self.cross = record(
            crossings_kernel,
            of._n_faces // each,
            [each, of._body_wp, of._faces, points, grid, first, following, farthest_in, winding],
        )
