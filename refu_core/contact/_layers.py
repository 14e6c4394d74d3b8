"""Garments worn together: the outer one leaves the inner one as it leaves the body, along the normal of its sheet."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.contact import _layers_kernels as kernels
from refu_core.contact import _layers_move_kernels as moving
from refu_core.contact._parting import Parting
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.contact._sheet import Sheet, ints
from refu_core.errors import MeshError
from refu_core.mesh import Adjacency, Connectivity


class Layer:
    """Brings one garment to the outer side of another one that is worn below it.

    The repulsion is ReFU's (paper, Eq. 2) with a sheet in the place of the body, which the paper doesn't treat. Where
    the height f of a vertex over the sheet is less than the gap ε, x' = x - (f - ε) n. The sheet's normal n is
    interpolated at the closest point. Neighbours give way as they do on the skin (`Blend.spread`). Unlike a body, a
    sheet has no inside: only cloth that faces the way the sheet does belongs above it. Beyond an open rim the sheet is
    felt less and less.

    The closest point is searched downhill, from the nearest of a few places around what was closest at rest. Cloth
    slides by a few edges only, so that takes half the time of a tree. On a folded sheet the search may end in the wrong
    fold, and in another one in the next frame. So a vertex also looks at what its neighbours found; and one that ends
    more than a centimetre below the sheet asks a tree.

    What isn't near the sheet at rest (a sleeve beside shorts) is a stranger to it: a tree is asked where one comes to
    it, and its outside may face the sheet's.
    """

    def __init__(
        self,
        above_faces: Tensor,
        above: Tensor,
        below_faces: Tensor,
        below: Tensor,
        *,
        settings: ContactSettings = DEFAULT_CONTACT,
    ) -> None:
        """For two garments, by faces (F, 3) and vertices in the rest pose (V, 3) [m], counter-clockwise from outside.

        Raises:
            MeshError: faces that aren't triangles of these vertices, or a gap that is negative or beyond the reach.
        """
        gap, farthest = settings.layer_gap, settings.layer_reach
        if not 0 <= gap < farthest:
            msg = f"the gap between garments must be at least 0 and less than {farthest} m, got {gap}"
            raise MeshError(msg)
        self._settings = settings
        self.device = above.device
        self._is_serial = self.device.type == "cpu"
        self._above = above.detach().to(torch.float32, copy=True).contiguous()
        above_mesh = Connectivity.of(above_faces.cpu(), len(above))
        self._below = Sheet(Connectivity.of(below_faces.cpu(), len(below)), below)
        rest, rest_below = self._above.cpu().numpy(), self._below.vertices.cpu().numpy()
        is_near = cKDTree(rest_below).query(rest)[0] < settings.layer_meets
        meets, candidates = np.flatnonzero(is_near), np.argsort(~is_near, kind="stable")  # those that meet first
        rows, ring_start, ring = _region(above_mesh.ring, candidates, settings.layer_rounds)
        self._n_candidates, self._n_region = len(candidates), len(rows)
        self._push = torch.zeros(len(candidates), 3, device=self.device)
        self._fields = torch.zeros(2, len(rows) + 1, 3, device=self.device)
        self._rows = torch.from_numpy(rows).to(self.device)
        self._looks, self._moved = torch.zeros(2, len(rows), dtype=torch.int32, device=self.device)
        self._count = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._n_doubtful = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._commands: dict[str, Any] = {}
        if len(candidates):
            start, places = _starts(rest[meets], rest_below, settings)
            start = np.append(start, np.full(len(rest) - len(meets), start[-1]))  # strangers know of no place
            lists = [ints(values, self.device) for values in (start, places, rows, ring_start, ring)]
            edges = rest_below[self._below.mesh.edges]
            longest = settings.layer_stretch * float(np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1).max())
            rules = _rules(settings, longest)
            self.parting = Parting(above_mesh, self._above, self._below, settings=settings)
            """What is done where triangles cut each other after all."""
            self._record(rules, *lists)

    @torch.no_grad()
    def __call__(self, above: Tensor, below: Tensor, *, goes_on: bool = False) -> tuple[Tensor, Tensor]:
        """The outer garment, (V, 3) [m], off the inner one, (U, 3), and how many of its vertices were below the gap.

        The number is an int32 of shape (1,), on the garments' device: a GPU isn't waited for, and makes the launches
        for those below the gap where there are none, too. Not differentiable.

        A call that `goes_on` is for the same inner garment as the last one: whoever is where it was left, and needn't
        be moved from there, isn't looked at.

        Raises `MeshError` for garments of other sizes than these were made for.
        """
        self._check(above, below)
        if not self._n_candidates:
            return above, torch.zeros_like(self._count)
        with torch_stream(self.device):
            self._take(above, below, goes_on=goes_on)
            self._look()
            n_low = self._count.clone()
            if self._is_serial and not int(n_low):
                return above, n_low
            self._move()
        return self._above.clone(), n_low

    def find_cuts(self, above: Tensor) -> Tensor:
        """How many pairs of faces of the outer garment, (V, 3) [m], and the inner one of the last call cut each other.

        An int32 of shape (1,). `parting` goes on from what was found.
        """
        if self._n_candidates:
            self.parting.find(above)
            return self.parting.n_cut.clone()
        return torch.zeros_like(self._count)

    def _check(self, above: Tensor, below: Tensor) -> None:
        if above.shape != self._above.shape or below.shape != self._below.vertices.shape:
            msg = (
                f"wanted garments of {len(self._above)} and {len(self._below.vertices)} vertices, "
                f"got the shapes {tuple(above.shape)} and {tuple(below.shape)}"
            )
            raise MeshError(msg)

    def _take(self, above: Tensor, below: Tensor, *, goes_on: bool) -> None:
        """Takes over a frame."""
        if goes_on:
            self._looks.copy_((above != self._above).any(1)[self._rows] | (self._moved > 0))
        else:
            self._looks.fill_(1)
            self._below.take(below)
        self._moved.zero_()
        self._above.copy_(above)

    def _look(self) -> None:
        """What has to be pushed, and how many vertices that are; a device that isn't waited for asks about everyone."""
        self._count.zero_()
        self._n_doubtful.zero_()
        self._commands["search"].launch()
        self._commands["lift"].launch()
        n = int(self._n_doubtful) if self._is_serial else self._n_candidates
        if n:
            self._below.fit()
            self._commands["ask"].set_dim(n)
            self._commands["ask"].launch()

    def _move(self) -> None:
        """Pushes those with their neighbourhood."""
        if self._is_serial:
            self._commands["move all"].launch()
            return
        self._fields[0].zero_()
        self._fields[0, : self._n_candidates] = self._push
        for round_ in range(self._settings.layer_rounds):
            self._commands[f"spread{round_ % 2}"].launch()
        self._commands["move"].launch()

    def _record(
        self,
        rules: Any,
        near_start: Any,
        near: Any,
        rows: Any,
        start: Any,
        ring: Any,
    ) -> None:
        """Records the launches of a frame: each of them is shorter than what Python makes of its arguments."""
        above, push = (as_warp(tensor, wp.vec3) for tensor in (self._above, self._push))
        sheet = self._below
        fields = [as_warp(field, wp.vec3) for field in self._fields]
        found, doubtful = (wp.zeros(self._n_candidates, dtype=wp.int32, device=str(self.device)) for _ in range(2))
        looks, moved = as_warp(self._looks, wp.int32), as_warp(self._moved, wp.int32)
        garments = [sheet.places, sheet.normals, sheet.cut, above, self.parting.cut, rows]
        pushed = [push, as_warp(self._count, wp.int32)]
        doubts = [doubtful, as_warp(self._n_doubtful, wp.int32)]
        blend = [push, start, ring]
        reached = [wp.zeros(self._n_region, dtype=wp.int32, device=str(self.device)) for _ in range(2)]
        rounds = self._settings.layer_rounds
        for name, kernel, size, arguments in (
            (
                "search",
                kernels.search_kernel,
                self._n_candidates,
                [sheet.places, sheet.cut, above, rows, near_start, near, looks, found],
            ),
            (
                "lift",
                kernels.lift_kernel,
                self._n_candidates,
                [*garments, start, ring, looks, found, sheet.extent, rules, *pushed, *doubts],
            ),
            (
                "ask",
                kernels.tree_kernel,
                self._n_candidates,
                [sheet.tree, *garments, found, rules, *doubts, *pushed],
            ),
            ("spread0", moving.spread_kernel, self._n_region, [*blend, fields[0], fields[1]]),
            ("spread1", moving.spread_kernel, self._n_region, [*blend, fields[1], fields[0]]),
            ("move", moving.move_kernel, self._n_region, [rows, fields[0], above, moved]),
            ("move all", moving.move_all_kernel, 1, [*blend, rows, rounds, *reached, *fields, above, moved]),
        ):
            self._commands[name] = wp.launch(kernel, size, arguments, device=str(self.device), record_cmd=True)


def _rules(settings: ContactSettings, longest: float) -> Any:
    rules = kernels.LayerRules()
    rules.gap, rules.reach, rules.fade = settings.layer_gap, settings.layer_reach, settings.layer_fade
    rules.agreement, rules.doubt, rules.longest = settings.layer_agreement, settings.layer_doubt, longest
    return rules


def _starts(
    above: NDArray[np.float32], below: NDArray[np.float32], settings: ContactSettings
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Vertices of the sheet below, (U, 3) [m], that each vertex above, (K, 3), looks from: starts (K + 1,) and them."""
    tree, is_free, places = cKDTree(below), np.ones(len(below), np.bool_), []
    for vertex in range(len(below)):
        if is_free[vertex]:
            places.append(vertex)
            is_free[tree.query_ball_point(below[vertex], settings.layer_spacing)] = False
    closest = np.asarray(tree.query(above)[1])
    around = cKDTree(below[places]).query_ball_point(above, settings.layer_slides)
    each = [np.append(first, np.array(places)[others]) for first, others in zip(closest, around, strict=True)]
    found = np.concatenate((*each, np.zeros(0, np.int64))).astype(np.int64)
    return np.append(0, np.cumsum([len(one) for one in each])).astype(np.int64), found


def _region(
    ring: Adjacency, candidates: NDArray[np.int64], reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The vertices that pushes of the candidates reach, those first, (R,), and the ring of each by place in that list.

    Starts (R + 1,) and places; a neighbour outside of the region, which no push reaches, is at place R.
    """
    vertex, neighbour = ring.owner, ring.items
    reached = np.zeros(len(ring.start) - 1, np.bool_)
    reached[candidates] = True
    is_beside = ~reached
    for _ in range(reach):
        reached[neighbour[reached[vertex]]] = True
    rows = np.concatenate((candidates, np.flatnonzero(reached & is_beside)))
    place = np.full(len(reached), len(rows))
    place[rows] = np.arange(len(rows))
    n_neighbours = np.bincount(vertex, minlength=len(reached))[rows]
    of_region = np.argsort(place[vertex], kind="stable")[: n_neighbours.sum()]
    return rows, np.append(0, np.cumsum(n_neighbours)), place[neighbour[of_region]]
