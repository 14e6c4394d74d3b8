"""Garments whose triangles still cut each other: the outer one is parted from the inner one."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.contact import _parting_kernels as kernels
from refu_core.contact._level_kernels import level_kernel
from refu_core.contact._settings import ContactSettings
from refu_core.contact._sheet import Sheet, cut_of
from refu_core.mesh import Connectivity, grouped
from refu_core.sdf._crossing_kernels import BLOCK


class Parting:
    """Parts one garment from another one that is worn below it, where their triangles cut each other.

    Three steps, which the caller calls in this order, and the body has the last word after them. Faces that cut are
    found, exactly. Around them the outer garment is levelled: a fold that went through the sheet between its vertices,
    or deep into a crease where there is no room, is drawn back to the cloth around it. What still cuts is brought
    apart, each face by the shortest way along the normal of the sheet that clears what it cuts deepest. The sheet stays
    where it is.

    All is done by one thread a face or vertex, which gathers what others have found: the order plays no role, and a
    vertex that isn't near a cut is left as it is. A CPU is told when there is none; a GPU isn't waited for.
    """

    def __init__(self, mesh: Connectivity, rest: Tensor, sheet: Sheet, *, settings: ContactSettings) -> None:
        """For an outer garment with vertices in the rest pose (V, 3) [m], over a `sheet`."""
        self.cut = cut = cut_of(mesh, rest.device)
        self._settings, self._device, self._sheet = settings, rest.device, sheet
        self._is_serial = rest.device.type == "cpu"
        n, n_faces = len(rest), len(cut.faces)
        self._points = torch.zeros(n, 3, device=rest.device)
        self._other = torch.zeros_like(self._points)
        self._marked, self._wider, self._pulled = torch.zeros(3, n, dtype=torch.int32, device=rest.device)
        self._weight = torch.zeros(n, device=rest.device)
        self.n_cut = torch.zeros(1, dtype=torch.int32, device=rest.device)
        """How many pairs of its faces and the sheet's were found to cut each other, shape (1,)."""
        self._n_left = torch.zeros_like(self.n_cut)
        self._ways = torch.zeros(2, n_faces, 3, device=rest.device)
        order = grouped(rest.cpu().numpy()[cut.faces.numpy()].mean(axis=1))
        in_groups = wp.array(order, dtype=wp.int32, device=str(rest.device))
        points, other, way, place = (as_warp(rows, wp.vec3) for rows in (self._points, self._other, *self._ways))
        marked, wider, pulled, count, left = (
            as_warp(rows, wp.int32) for rows in (self._marked, self._wider, self._pulled, self.n_cut, self._n_left)
        )
        weight = as_warp(self._weight, wp.float32)
        own = [points, cut.faces]
        bounds = [settings.tolerance, settings.layer_gap]
        self._commands: dict[str, Any] = {}
        for name, kernel, size, arguments in (
            (
                "find",
                kernels.find_kernel,
                -(-n_faces // int(BLOCK)),
                [sheet.tree, sheet.extent, *own, in_groups, marked, count],
            ),
            ("widen0", kernels.widen_kernel, n, [marked, cut, wider]),
            ("widen1", kernels.widen_kernel, n, [wider, cut, marked]),
            ("level0", level_kernel, n, [points, weight, cut.ring_start, cut.ring, other]),
            ("level1", level_kernel, n, [other, weight, cut.ring_start, cut.ring, points]),
            (
                "measure",
                kernels.measure_kernel,
                n_faces,
                [sheet.tree, sheet.normals, sheet.cut.faces, *own, marked, *bounds, left, way, place, pulled],
            ),
            ("part", kernels.part_kernel, n, [way, place, cut, points, pulled, marked]),
        ):
            self._commands[name] = wp.launch(kernel, size, arguments, device=str(rest.device), record_cmd=True)

    def find(self, above: Tensor) -> None:
        """Finds the faces of the outer garment, vertices (V, 3) [m], that cut the sheet."""
        self._sheet.fit()
        with torch_stream(self._device):
            self._marked.zero_()
            self.n_cut.zero_()
            self._points.copy_(above)
            self._commands["find"].launch()

    def level(self, above: Tensor) -> Tensor:
        """The outer garment, (V, 3) [m], levelled around the faces that were found to cut."""
        with torch_stream(self._device):
            self._points.copy_(above)
            for k in range(self._settings.near):
                self._commands[f"widen{k % 2}"].launch()
            self._weight.copy_(self._marked)
            for k in range(self._settings.parting_rounds):
                self._commands[f"level{k % 2}"].launch()
        return self._points.clone()

    def part(self, above: Tensor) -> Tensor:
        """The outer garment, (V, 3) [m], with faces around there brought to the outer side of what they cut.

        What is marked is what was moved last, so a second call wants another `find`.
        """
        with torch_stream(self._device):
            self._points.copy_(above)
            self._ways[1].zero_()
            for _ in range(self._settings.parting_sweeps):
                self._n_left.zero_()
                self._commands["measure"].launch()
                if self._is_serial and not int(self._n_left):
                    break
                self._commands["part"].launch()
        return self._points.clone()

    def parted(self, above: Tensor) -> Tensor:
        """The outer garment, (V, 3) [m], off the sheet by what has few millimetres to go, where that leaves fewer cuts.

        Where a hand is deep in a hip, the way out of the one leads into the other, and nothing is done.
        """
        self.find(above)
        n_before = self.n_cut.clone()
        if self._is_serial and not int(n_before):
            return above
        parted = above + torch.renorm(self.part(above) - above, 2, 0, self._settings.parting_most)
        self.find(parted)
        return torch.where(self.n_cut < n_before, parted, above)
