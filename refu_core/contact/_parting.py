"""Garments whose triangles still cut each other: the outer one is parted from the inner one."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Recorded, Unpicklable, as_warp, ints, memory, readable, torch_stream
from refu_core.contact import _parting_kernels as kernels
from refu_core.contact._settings import ContactSettings
from refu_core.contact._sheet import Sheet, cut_of
from refu_core.mesh import Connectivity, grouped_at_rest
from refu_core.sdf._crossing_kernels import BLOCK


class Parting(Unpicklable):
    """Parts one garment from another one that is worn below it, where their triangles cut each other.

    The caller takes two steps, in this order. Faces that cut are found, exactly. Then they are brought apart, each by
    the shortest way along the sheet's normal that clears what it cuts deepest. The sheet stays where it is, and the
    body has the last word after that.
    """

    def __init__(self, mesh: Connectivity, rest: Tensor, sheet: Sheet, *, settings: ContactSettings) -> None:
        """For an outer garment with vertices in the rest pose (V, 3) [m], over a `sheet`."""
        self.cut = cut = cut_of(mesh, rest.device)
        self._settings, self._device, self._sheet = settings, rest.device, sheet
        self._is_serial = rest.device.type == "cpu"
        n, n_faces = len(rest), len(cut.faces)
        self._points = memory(n, 3, device=rest.device)
        self._marked = memory(n, device=rest.device)
        self._count = memory(1, dtype=torch.int32, device=rest.device)
        self._read_count = readable(self._count)
        self._ways = memory(2, n_faces, 3, device=rest.device)
        data = kernels.Outer()
        data.points, data.way, data.place = (as_warp(rows, wp.vec3) for rows in (self._points, *self._ways))
        data.order = ints(grouped_at_rest(rest.cpu().numpy()[mesh.faces].mean(axis=1)), rest.device)
        data.cut, data.count = cut, as_warp(self._count, wp.int32)
        data.marked = as_warp(self._marked, wp.float32)
        data.pulled = wp.zeros(n, dtype=wp.int32, device=str(rest.device))
        bounds = [settings.tolerance, settings.gap]
        each = int(BLOCK) if self._is_serial else 1
        launches: dict[str, tuple[Any, int, list[Any]]] = {
            "find": (kernels.find_kernel, -(-n_faces // each), [each, sheet.data, data]),
            "measure": (kernels.measure_kernel, n_faces, [sheet.data, data, *bounds]),
            "part": (kernels.part_kernel, n, [data]),
        }
        self._commands = {name: Recorded(*launch, rest.device) for name, launch in launches.items()}

    def find(self, above: Tensor) -> Tensor:
        """How many pairs of faces of the outer garment, (V, 3) [m], and of the sheet cut each other, int32, (1,)."""
        self._sheet.fit()
        with torch_stream(self._device):
            self._marked.zero_()
            self._count.zero_()
            self._points.copy_(above)
            self._commands["find"].launch()
        return self._count.clone()

    def part(self, above: Tensor) -> Tensor:
        """The outer garment, (V, 3) [m], with faces at the marked vertices brought to the outer side of what they cut.

        This leaves only the vertices that it moved last marked, so a second call needs another `find`.
        """
        self._sheet.point_out()
        with torch_stream(self._device):
            self._points.copy_(above)
            self._ways[1].zero_()
            for _ in range(self._settings.sweeps):
                self._count.zero_()
                self._commands["measure"].launch()
                if self._is_serial and not self._read_count[0]:
                    break
                self._commands["part"].launch()
        return self._points.clone()

    def parted(self, above: Tensor) -> Tensor:
        """The outer garment, (V, 3) [m], moved off the sheet if at most half the cuts are left; else as it was.

        Where nothing cuts, a CPU returns the very same tensor. Where a hand is deep in a hip, the way out of one leads
        into the other, and nothing is done. On recorded motion no cut is left. With limbs through the trunk about as
        many are left, so rounding would decide if one cut fewer were enough.
        """
        n_before = self.find(above)
        if self._is_serial and not int(n_before):
            return above
        parted = self.part(above)
        return torch.where((n_before > 0) & (2 * self.find(parted) <= n_before), parted, above)
