"""How many points are inside a posed body, by the winding number: what collision handling is held against."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.mesh import Connectivity
from refu_core.sdf._winding_kernels import CELLS, bin_kernel, crossings_kernel, extent_kernel

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
        # The first point of each cell, its least distance, and the box of all: as they are before any point is known.
        n = 2 * _N_CELLS**2
        box = torch.tensor([torch.inf] * 3 + [-torch.inf] * 3)
        blank = (torch.full((n,), -1, dtype=torch.int32), torch.full((n,), torch.inf).view(torch.int32))
        self._blank = torch.cat((*blank, box.view(torch.int32))).to(self._device)
        self._memory = self._blank.clone()
        first, rest = self._memory[:n], self._memory[n:].view(torch.float32)
        self._cells = [
            as_warp(rest[n:].view(2, 3), wp.vec3),
            as_warp(first, wp.int32),
            as_warp(rest[:n], wp.float32),
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
            self._memory.copy_(self._blank)
            with torch_stream(self._device):
                known.bound.launch()
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

        strips = 1 if of._device.type == "cpu" else n
        self.bound = record(extent_kernel, strips, [n // max(strips, 1), points, grid])
        self.sort = record(bin_kernel, n, [points, grid, first, following, farthest_in])
        # A CPU's compiler keeps more in registers within a loop than from call to call.
        each = of._n_faces if of._device.type == "cpu" else 1
        self.cross = record(
            crossings_kernel,
            of._n_faces // each,
            [each, of._body_wp, of._faces, points, grid, first, following, farthest_in, winding],
        )
