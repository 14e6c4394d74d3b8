"""Garments worn together: the outer one is pushed off the inner one as off the body, along the inner sheet's normal."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core._cache import remembered
from refu_core._warp import Recorded, Unpicklable, as_warp, ints, memory, readable, torch_stream
from refu_core.contact import _layers_kernels as kernels
from refu_core.contact._parting import Parting
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.contact._sheet import Sheet
from refu_core.mesh import Connectivity


class Layer(Unpicklable):
    """Brings one garment to the outer side of another one that is worn below it (docs/architecture.md).

    The repulsion is ReFU's (paper, Eq. 2) with a sheet in the place of the body, which the paper doesn't treat: where
    the height f of a vertex over the sheet is less than the gap ε, x' = x - (f - ε) n, and neighbours give way. Unlike
    a body, a sheet has no inside: cloth that stands on it at a right angle may belong on either side, and stays.

    The search for the closest point goes downhill from the nearest of a few vertices around the one closest at rest, in
    half the time of a tree. A vertex that isn't near the sheet at rest (of a sleeve beside shorts) is a stranger, and
    asks the tree.
    """

    def __init__(
        self,
        above_faces: Tensor,
        above: Tensor,
        below_faces: Tensor,
        below: Tensor,
        *,
        settings: ContactSettings = DEFAULT_CONTACT,
        asks_tree: bool = True,
    ) -> None:
        """For two garments, by faces (F, 3) and vertices in the rest pose (V, 3) [m], counter-clockwise from outside.

        Unless it `asks_tree`, strangers are left alone, and a vertex far below the sheet comes off the fold that its
        search ended in.

        Raises `MeshError` for faces that aren't triangles of these vertices.
        """
        self._settings, self._asks_tree = settings, asks_tree
        self.device = above.device
        self._is_serial = self.device.type == "cpu"
        self._below = Sheet(Connectivity.of(below_faces.cpu(), len(below)), below)
        mesh = Connectivity.of(above_faces.cpu(), len(above))
        self.parting = Parting(mesh, above, self._below, settings=settings)
        """Parts this garment from the inner one of the last call where their triangles still cut each other."""
        n = len(above)
        self._given, self._points, self._push, *self._fields = memory(5, n, 3, device=self.device)
        self._count = memory(1, dtype=torch.int32, device=self.device)
        self._read_count = readable(self._count)
        data = kernels.Above()
        data.given, data.points, data.push, data.field, data.smoother = (
            as_warp(rows, wp.vec3) for rows in (self._given, self._points, self._push, *self._fields)
        )
        data.cut, data.count = self.parting.cut, as_warp(self._count, wp.int32)
        rest, rest_below = (one.detach().cpu().numpy() for one in (above, below))
        starts = _starts(rest, rest_below, self._below.mesh, settings)
        data.start, data.near = (ints(one, self.device) for one in starts)
        for name in ("looks", "found", "moved", "reached", "is_reached"):
            setattr(data, name, wp.zeros(n, dtype=wp.int32, device=str(self.device)))
        rules = kernels.LayerRules()
        rules.gap, rules.reach, rules.alike = settings.gap, settings.layer_reach, settings.alike
        first, second = rest_below[self._below.mesh.edges.T]
        rules.longest = float(np.linalg.norm(first - second, axis=1).max(initial=0.0))
        rules.asks_tree = asks_tree
        self._commands = self._recorded(data, rules)

    @torch.no_grad()
    def __call__(self, above: Tensor, below: Tensor, *, goes_on: bool = False) -> tuple[Tensor, Tensor]:
        """The outer garment, (V, 3) [m], off the inner one, (U, 3), and how many of its vertices were below the gap.

        The number is an int32 of shape (1,), on the garments' device: a GPU isn't waited for. A call that `goes_on` is
        for the same inner garment as the last one, and skips vertices that are where it left them. Not differentiable.
        """
        with torch_stream(self.device):
            if not goes_on:
                self._below.take(below)
            self._given.copy_(above)
            if self._asks_tree:
                self._below.fit()
            self._below.point_out()
            self._count.zero_()
            self._commands["look again" if goes_on else "look"].launch()
            self._commands["lift"].launch()
            n_low = self._count.clone()
            if self._is_serial:
                if not self._read_count[0]:
                    return above, n_low
                self._commands["move all"].launch()
            else:
                self._fields[0].copy_(self._push)
                for round_ in range(self._settings.around):
                    self._commands[f"spread{round_ % 2}"].launch()
                self._commands["move"].launch()
        return self._points.clone(), n_low

    def _recorded(self, data: Any, rules: Any) -> dict[str, Any]:
        """The launches of a frame, recorded: each takes less time than preparing its arguments in Python."""
        n, sheet = len(self._points), self._below.data
        n_strips, each = (1, n) if self._is_serial else (n, 1)
        launches: dict[str, tuple[Any, int, list[Any]]] = {
            "look": (kernels.search_kernel, n_strips, [each, False, sheet, data]),
            "look again": (kernels.search_kernel, n_strips, [each, True, sheet, data]),
            "lift": (kernels.lift_kernel, n_strips, [each, sheet, data, rules]),
            "spread0": (kernels.spread_kernel, n, [data, data.field, data.smoother]),
            "spread1": (kernels.spread_kernel, n, [data, data.smoother, data.field]),
            "move": (kernels.move_kernel, n, [data]),
            "move all": (kernels.move_all_kernel, 1, [data, self._settings.around]),
        }
        return {name: Recorded(*launch, self.device) for name, launch in launches.items()}


@remembered(4)
def _starts(
    above: NDArray[np.float32], below: NDArray[np.float32], mesh: Connectivity, settings: ContactSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where each vertex above, (V, 3) [m], may start to search the sheet below, (U, 3): offsets (V + 1,), and vertices.

    A vertex that isn't near the sheet at rest has none. Vertices of the sheet without a face lead nowhere.
    """
    has_face = np.unique(mesh.faces)
    tree, is_free, chosen = cKDTree(below[has_face]), np.ones(len(has_face), np.bool_), []
    for i, vertex in enumerate(has_face):
        if is_free[i]:
            chosen.append(vertex)
            is_free[tree.query_ball_point(below[vertex], settings.layer_reach)] = False
    places = np.array(chosen)
    distance, closest = (np.asarray(found) for found in tree.query(above))
    around = cKDTree(below[places]).query_ball_point(above, settings.max_displacement)
    each = [
        np.append(first, places[others]) if near else np.zeros(0, np.int64)
        for first, others, near in zip(has_face[closest], around, distance < settings.max_displacement, strict=True)
    ]
    found = np.concatenate((*each, np.zeros(0, np.int64))).astype(np.int64)
    return np.append(0, np.cumsum([len(one) for one in each])).astype(np.int64), found
