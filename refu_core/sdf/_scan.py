"""The scan for what is near the skin: its launches, recorded once, and the memory that they work in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp
from refu_core.sdf._band_kernels import (
    ROW,
    ROWS_X,
    ROWS_Z,
    Cells,
    finish_kernel,
    scan_kernel,
    sort_kernel,
    spread_sides_kernel,
)
from refu_core.sdf._closest_kernels import PosedMesh
from refu_core.sdf._mesh import Found

_N_ROWS = int(ROWS_X) * int(ROWS_Z)


class Scan:
    """Which of a garment's vertices are near the skin of a posed body, and on which side the others are.

    Answers lie in memory that the next call overwrites.
    """

    def __init__(self, body: PosedMesh, n_faces: int, band: float, ask: Callable[[Any, Any, Found], Any]) -> None:
        """For a `body` of `n_faces`; `band` in metres.

        `ask` records the launch that asks the tree for some of the points: of points, rows, and where answers belong.
        """
        self._body, self._n_faces, self._record_ask = body, n_faces, ask
        self._room = 0
        self._cells = Cells()
        self._cells.limit, self._cells.per_metre = band, 0.5 / band  # a cell is twice as wide as the band
        self._cells.number_of_row = wp.full(_N_ROWS, -1, dtype=wp.int32, device="cpu")
        self._cells.rows = wp.empty(_N_ROWS, dtype=wp.int32, device="cpu")
        self._cells.occupied = wp.empty(_N_ROWS, dtype=wp.uint64, device="cpu")
        self._cells.extent = wp.zeros(2, dtype=wp.vec3, device="cpu")
        self._sizes = torch.zeros(4, dtype=torch.int32)
        self._beyond = torch.zeros(1)
        self._state: Tensor
        self._asked: Tensor
        self._make_room(1024)

    def near(self, points: Tensor, *, beyond: float) -> Found:
        """What is closest to each point (N, 3) within the band; face -1 and the distance `beyond` where nothing is."""
        n = len(points)
        if n > self._room:
            self._make_room(max(n, 2 * self._room))
        self._points[:n] = points
        self._sizes[0] = n
        self._beyond[0] = beyond
        self._sort.launch()
        self._scan.launch()
        self._finish.set_dim(n)
        self._finish.launch()
        return Found(*(field[:n] for field in self._found))

    def spread(self, links: list[Any]) -> tuple[int, int]:
        """Finds the side of the points of the last scan, by the arrays of their `links`.

        Returns how many points may be inside, and how many patches nothing reaches, of which one point each must be
        asked; `asked` has these points, in this order.
        """
        for k, array in enumerate(links):
            self._spread.set_param_at_index(2 + k, array)
        self._spread.launch()
        n_inside, n_patches = self._sizes[2:].tolist()
        return n_inside, n_patches

    def patch_of(self, n: int) -> Tensor:
        """Which patch each of the n points belongs to, by a number of its own, shape (n,); a copy."""
        return self._state[:n].clone()

    def asked(self, n: int) -> Tensor:
        """The first n rows to be asked, shape (n,); a copy."""
        return self._asked[:n].long()

    def ask(self, n: int, rows: Tensor | None = None) -> None:
        """Replaces the scan's answers by the tree's, for the first n rows to be asked or for `rows`, shape (n,)."""
        if rows is not None:
            self._asked[:n] = rows
        if n:
            self._ask.set_dim(n)
            self._ask.launch()

    def _make_room(self, n: int) -> None:
        self._room = n
        self._points = torch.zeros(n, 3)
        ints = torch.zeros(5, n, dtype=torch.int32)
        self._state, self._asked = ints[:2]
        cells = self._cells
        state, asked, queue, cells.slot, cells.face = (as_warp(row, wp.int32) for row in ints)
        self._found = Found.empty(n, self._points.device)
        sizes, beyond = as_warp(self._sizes, wp.int32), as_warp(self._beyond, wp.float32)
        points = as_warp(self._points, wp.vec3)
        cells.start = wp.empty((min(n, _N_ROWS), ROW + 2), dtype=wp.int32, device="cpu")
        cells.points = wp.empty(n, dtype=wp.vec3, device="cpu")
        cells.squared = wp.empty(n, dtype=wp.float32, device="cpu")
        answers = self._found.as_warp()
        self._sort = _record(sort_kernel, 1, [points, sizes, cells], [])
        self._scan = _record(scan_kernel, self._n_faces, [self._body, cells], [])
        self._finish = _record(finish_kernel, n, [self._body, points, cells, beyond], answers)
        none = [wp.empty(0, dtype=wp.int32, device="cpu")] * 2
        sides = [answers[0], state, queue, asked]
        self._spread = _record(spread_sides_kernel, 1, [points, sizes, *none, answers[1]], sides)
        self._ask = self._record_ask(points, asked, self._found)


def _record(kernel: Any, dim: int, inputs: list[Any], outputs: list[Any]) -> Any:
    return wp.launch(kernel, dim, inputs, outputs, device="cpu", record_cmd=True)
