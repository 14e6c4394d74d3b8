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
from refu_core.errors import MeshError
from refu_core.repulsion import _layers_kernels as kernels
from refu_core.repulsion._blend import Blend
from refu_core.sdf import check_faces

LAYER_GAP = 0.003
"""How far apart two garments are kept [m]: their triangles cut the corners between vertices, as they do on the skin."""

LAYER_REACH = 0.03
"""How far a sheet is felt [m], in the last quarter less and less. Deeper is only what a fold of the sheet swallows,
as at the hip of a squatting person, and which of the fold's sides is closest to that changes from frame to frame."""

_MEETS = 0.1
"""What is farther from the other garment in the rest pose doesn't meet it in any [m]."""
_FADE = 0.02
"""How far beyond its open rims a sheet is still felt, less and less [m]; so cloth runs smoothly over a waistband."""
_AGREEMENT = 0.25
"""Cosine of the garments' normals from which on a push counts in full; at a right angle it doesn't count at all."""
_DOUBT = 0.012
"""Where a search ended this far below the sheet [m] the closest place is asked for in a tree: it may be of another
fold, and the push in another direction."""
_STRETCH = 1.5
"""How much longer than at rest an edge may be."""
_SPACING = 0.05
"""How far the places on a sheet are apart from which the closest one is looked for [m]."""
_SLIDES = 0.14
"""Places this far away at rest are among them [m]: so far one garment slides over the other, or folds come together."""
_ROUNDS = 6
"""How far the neighbourhood of a first push reaches [edges], and how often it is swept: even, so that the field ends
where it began."""
_LATER_REACH = 0.02
"""How far a second push, which is a correction, feels the sheet [m]: what is as deep after the first one is between
folds, and which of them is closest changes from frame to frame."""
_LATER_ROUNDS = 2
"""Those of a second push, which is a correction."""


class Layer:
    """Brings one garment to the outer side of another one that is worn below it.

    The repulsion is ReFU's (paper, Eq. refu) with a sheet in the place of the body, which the paper doesn't treat:
    where the height f of a vertex over the sheet below is less than the gap ε, x' = x - (f - ε) n, with the sheet's
    normal n interpolated at the closest point. The neighbourhood gives way as it does on the skin (`Blend.spread`).
    Unlike a body a sheet has no inside. So only cloth that faces the way the sheet does belongs above it; and beyond
    an open rim, where there are no two sides either, the sheet is felt less and less.

    The closest point is looked for downhill from the nearest of a few places around what was closest at rest. As cloth
    slides by a few edges only, that takes half the time that a tree does. Where the sheet is folded such a search may
    end in the wrong fold, and in the next frame in another one: so a vertex looks at what its neighbours found, too;
    and the closest place to one that ends more than a centimetre below the sheet is asked for in a tree.
    """

    def __init__(
        self, above_faces: Tensor, above: Tensor, below_faces: Tensor, below: Tensor, *, gap: float = LAYER_GAP
    ) -> None:
        """For two garments, by faces (F, 3) and vertices in the rest pose (V, 3) [m], counter-clockwise from outside.

        Raises:
            MeshError: faces that aren't triangles of these vertices, or a gap that is negative or beyond the reach.
        """
        if not 0 <= gap < LAYER_REACH:
            msg = f"the gap between garments must be at least 0 and less than {LAYER_REACH} m, got {gap}"
            raise MeshError(msg)
        self.device = above.device
        self._above, self._below = _own(above), _own(below)
        above_blend, below_blend = (
            Blend.of_faces(faces, len(rest)) for faces, rest in ((above_faces, above), (below_faces, below))
        )
        rest, rest_below = self._above.cpu().numpy(), self._below.cpu().numpy()
        meets = np.flatnonzero(cKDTree(rest_below).query(rest)[0] < _MEETS)
        rows, ring_start, ring = _region(above_blend, meets)
        self._n_candidates, self._n_region = len(meets), len(rows)
        self._normals = torch.empty_like(self._below)
        self._push = torch.zeros(len(meets), 3, device=self.device)
        self._fields = torch.zeros(2, len(rows) + 1, 3, device=self.device)
        self._count = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._n_doubtful = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._tree: Any = None
        self._tree_is_late = True
        self._commands: dict[str, Any] = {}
        if len(meets):
            cuts = [_cut(above_faces, above_blend), _cut(below_faces, below_blend)]
            lists = [
                _ints(values, self.device) for values in (*_starts(rest[meets], rest_below), rows, ring_start, ring)
            ]
            rules, later = (_rules(gap, reach, self._below, below_blend) for reach in (LAYER_REACH, _LATER_REACH))
            self._record(rules, later, *cuts, *lists)

    @torch.no_grad()
    def __call__(self, above: Tensor, below: Tensor) -> tuple[Tensor, int]:
        """The outer garment, (V, 3) [m], off the inner one, (U, 3), and how many of its vertices were below the gap.

        Not differentiable. Raises `MeshError` for garments of other sizes than these were made for.
        """
        self._check(above, below)
        if not self._n_candidates:
            return above, 0
        with torch_stream(self.device):
            self._take(above, below)
            self._look("search", waits=True)
            n_low = int(self._count)
            if n_low:
                self._move(_ROUNDS)
                # What has left the sheet at one place may have come to another, and be too low there.
                self._look("search again", waits=True)
                if int(self._count):
                    self._move(_LATER_ROUNDS)
        return (self._above.clone(), n_low) if n_low else (above, 0)

    @torch.no_grad()
    def queued(self, above: Tensor, below: Tensor) -> tuple[Tensor, Tensor]:
        """The same of a GPU that isn't waited for, the number of shape (1,): where none is low, none moves."""
        self._check(above, below)
        if not self._n_candidates:
            return above, torch.zeros_like(self._count)
        with torch_stream(self.device):
            self._take(above, below)
            self._look("search", waits=False)
            n_low = self._count.clone()
            self._move(_ROUNDS)
            self._look("search again", waits=False)
            self._move(_LATER_ROUNDS)
        return self._above.clone(), n_low

    def _check(self, above: Tensor, below: Tensor) -> None:
        if above.shape != self._above.shape or below.shape != self._below.shape:
            msg = (
                f"wanted garments of {len(self._above)} and {len(self._below)} vertices, "
                f"got the shapes {tuple(above.shape)} and {tuple(below.shape)}"
            )
            raise MeshError(msg)

    def _take(self, above: Tensor, below: Tensor) -> None:
        """Takes over a frame."""
        self._above.copy_(above)
        self._below.copy_(below)
        self._commands["normals"].launch()
        self._tree_is_late = True

    def _look(self, search: str, *, waits: bool) -> None:
        """What has to be pushed, and how many vertices that are; a device that isn't waited for asks about everyone."""
        lift, ask = (search.replace("search", step) for step in ("lift", "ask"))
        self._count.zero_()
        self._n_doubtful.zero_()
        self._commands[search].launch()
        self._commands[lift].launch()
        n = int(self._n_doubtful) if waits else self._n_candidates
        if n:
            if self._tree_is_late:
                self._tree.refit()
                self._tree_is_late = False
            self._commands[ask].set_dim(n)
            self._commands[ask].launch()

    def _move(self, blend_rounds: int) -> None:
        """Pushes those with their neighbourhood."""
        self._fields[0].zero_()
        self._fields[0, : self._n_candidates] = self._push
        for round_ in range(blend_rounds):
            self._commands[f"spread{round_ % 2}"].launch()
        self._commands["move"].launch()

    def _record(
        self,
        rules: Any,
        later: Any,
        above_cut: Any,
        below_cut: Any,
        near_start: Any,
        near: Any,
        rows: Any,
        start: Any,
        ring: Any,
    ) -> None:
        """Records the launches of a frame: each of them is shorter than what Python makes of its arguments."""
        above, below, normals, push = (
            as_warp(tensor, wp.vec3) for tensor in (self._above, self._below, self._normals, self._push)
        )
        fields = [as_warp(field, wp.vec3) for field in self._fields]
        self._tree = wp.Mesh(below, below_cut.faces.flatten())
        found, closest, doubtful = (
            wp.zeros(self._n_candidates, dtype=wp.int32, device=str(self.device)) for _ in range(3)
        )
        itself = _ints(np.arange(self._n_candidates + 1), self.device)
        search = [below, below_cut, above, rows]
        garments = [below, normals, below_cut, above, above_cut, rows]
        pushed = [closest, push, as_warp(self._count, wp.int32)]
        doubts = [doubtful, as_warp(self._n_doubtful, wp.int32)]
        blend = [push, self._n_candidates, start, ring]
        again = [start, ring, found, later, *pushed, *doubts]
        for name, kernel, size, arguments in (
            ("normals", kernels.normals_kernel, len(self._below), [below, below_cut, normals]),
            ("search", kernels.search_kernel, self._n_candidates, [*search, near_start, near, found]),
            ("search again", kernels.search_kernel, self._n_candidates, [*search, itself, closest, found]),
            ("lift", kernels.lift_kernel, self._n_candidates, [*garments, start, ring, found, rules, *pushed, *doubts]),
            ("lift again", kernels.lift_kernel, self._n_candidates, [*garments, *again]),
            ("ask again", kernels.ask_kernel, self._n_candidates, [self._tree.id, *garments, later, *doubts, *pushed]),
            ("ask", kernels.ask_kernel, self._n_candidates, [self._tree.id, *garments, rules, *doubts, *pushed]),
            ("spread0", kernels.spread_kernel, self._n_region, [*blend, fields[0], fields[1]]),
            ("spread1", kernels.spread_kernel, self._n_region, [*blend, fields[1], fields[0]]),
            ("move", kernels.move_kernel, self._n_region, [rows, fields[0], above]),
        ):
            self._commands[name] = wp.launch(kernel, size, arguments, device=str(self.device), record_cmd=True)


def _own(vertices: Tensor) -> Tensor:
    return vertices.detach().to(torch.float32, copy=True).contiguous()


def _ints(values: NDArray[Any], device: torch.device) -> Any:
    return wp.array(values.astype(np.int32), dtype=wp.int32, device=str(device))


def _rules(gap: float, reach: float, below: Tensor, blend: Blend) -> Any:
    start, end = _half_edges(blend)
    rest = below.cpu().numpy()
    rules = kernels.LayerRules()
    rules.gap, rules.reach, rules.fade, rules.agreement = gap, reach, _FADE, _AGREEMENT
    rules.doubt = _DOUBT
    rules.longest = _STRETCH * float(np.linalg.norm(rest[start] - rest[end], axis=1).max())
    return rules


def _cut(faces: Tensor, blend: Blend) -> Any:
    """A garment's mesh as the kernels read it."""
    device, n_vertices = faces.device, len(blend.start)
    corners = check_faces(faces.cpu().numpy(), n_vertices=n_vertices)
    cut = kernels.Cut()
    cut.faces = wp.array(corners, dtype=wp.int32, device=str(device))
    cut.fan_start = _ints(np.append(0, np.cumsum(np.bincount(corners.ravel(), minlength=n_vertices))), device)
    cut.fan_face = _ints(np.argsort(corners.ravel(), kind="stable") // 3, device)
    cut.ring_start = _ints(np.append(blend.start.cpu().numpy(), len(blend.neighbours)), device)
    cut.ring = _ints(blend.neighbours.cpu().numpy(), device)
    cut.rim = _ints(_rim(corners), device)
    return cut


def _starts(above: NDArray[np.float32], below: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Vertices of the sheet below, (U, 3) [m], that each vertex above, (K, 3), looks from: starts (K + 1,) and them."""
    tree, is_free, places = cKDTree(below), np.ones(len(below), np.bool_), []
    for vertex in range(len(below)):
        if is_free[vertex]:
            places.append(vertex)
            is_free[tree.query_ball_point(below[vertex], _SPACING)] = False
    closest = np.asarray(tree.query(above)[1])
    around = cKDTree(below[places]).query_ball_point(above, _SLIDES)
    each = [np.append(first, np.array(places)[others]) for first, others in zip(closest, around, strict=True)]
    return np.append(0, np.cumsum([len(one) for one in each])), np.concatenate(each).astype(np.int64)


def _rim(corners: NDArray[np.int32]) -> NDArray[np.int64]:
    """A bit for each feature (as `closest_on_triangle` numbers them) of each face, (F, 3), that is on an open rim."""
    ends = np.stack((corners, np.roll(corners, -1, axis=1)), axis=-1).astype(np.int64)
    number = ends.min(axis=-1) * (corners.max() + 1) + ends.max(axis=-1)
    each, n_faces = np.unique(number, return_counts=True)
    open_edge = np.isin(number, each[n_faces == 1])
    open_vertex = np.isin(corners, ends[open_edge])
    rim: NDArray[np.int64] = np.concatenate((open_vertex, open_edge), axis=1) @ (1 << np.arange(1, 7))
    return rim


def _half_edges(blend: Blend) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Both ends of each edge both ways, grouped by the first."""
    neighbours, start = blend.neighbours.cpu().numpy(), blend.start.cpu().numpy()
    return np.repeat(np.arange(len(start)), np.diff(start, append=len(neighbours))), neighbours


def _region(
    blend: Blend, candidates: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The vertices that pushes of the candidates reach, those first, (R,), and the ring of each by place in that list.

    Starts (R + 1,) and places; a neighbour outside of the region, which no push reaches, is at place R.
    """
    vertex, neighbour = _half_edges(blend)
    reached = np.zeros(len(blend.start), np.bool_)
    reached[candidates] = True
    is_beside = ~reached
    for _ in range(_ROUNDS):
        reached[neighbour[reached[vertex]]] = True
    rows = np.concatenate((candidates, np.flatnonzero(reached & is_beside)))
    place = np.full(len(reached), len(rows))
    place[rows] = np.arange(len(rows))
    n_neighbours = np.bincount(vertex, minlength=len(reached))[rows]
    of_region = np.argsort(place[vertex], kind="stable")[: n_neighbours.sum()]
    return rows, np.append(0, np.cumsum(n_neighbours)), place[neighbour[of_region]]
