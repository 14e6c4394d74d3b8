"""`resolve` in real time: the same steps, each one launch over the vertices that it concerns."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.repulsion import _edge_kernels, _resolver_kernels, _round_kernels, _sheet, _spread_kernels
from refu_core.repulsion._blend import BLEND_REACH, BLEND_STEPS
from refu_core.repulsion._limbs import INWARD, SIDEWAYS, Limbs
from refu_core.repulsion._mend import DEEP, DETOUR, FARTHEST, LOOKS, ROUNDS, STEP_ON, STEPS, TOLERANCE, TURNING
from refu_core.repulsion._resolve import BULGE, RETREAT_STEPS, SURE, THROUGH, Resolution
from refu_core.repulsion._scale import VertexScale
from refu_core.repulsion._unit import DEFAULT_MARGIN, MAX_DISPLACEMENT
from refu_core.sdf import ApproxSdf, BandSdf, ExactSdf, SdfSample

_MAX_PUSHES = 4
_TOLERANCE = 2e-4


class Resolver:
    """Brings one garment off bodies: what `resolve` does with its neighbourhood, limbs and edges, several times faster.

    The memory that it takes and the launches that are made in every frame are prepared once. Vertices are listed by the
    step before, so that a step costs what the vertices at the skin do; a vertex's pushes, and the looks in between, are
    one loop in one kernel, since they don't depend on those of others. What does (limbs, neighbourhood, edges) is
    finished for all vertices by one launch before the next one begins; so the order of vertices plays no role, and the
    answers are those of `resolve` but for rounding.

    On a CPU steps that concern nobody are left out. A GPU isn't waited for to know: it gets the same launches in every
    frame, as a CUDA graph wants them. Rounds that would have been left out change nothing.
    """

    def __init__(self, limbs: Limbs) -> None:
        """For the garment that `limbs` is of, on its device."""
        self._limbs = limbs
        self.device = limbs.faces.device
        n, e = len(limbs.own), len(limbs.edges)
        self._n_vertices = n
        self._cloth = _cloth(limbs)
        self._vectors = {name: torch.zeros(n, 3, device=self.device) for name in _VECTORS}
        self._floats = {name: torch.zeros(n, device=self.device) for name in _FLOATS}
        self._ints = {name: torch.zeros(n, dtype=torch.int32, device=self.device) for name in _INTS}
        self._by_edge = torch.zeros(3, e, dtype=torch.int32, device=self.device)
        self._deficit = torch.zeros(e, device=self.device)
        self._rise = torch.zeros(e, 3, device=self.device)
        self._counts = torch.zeros(_sheet.N_COUNTS + 2 * _N_LIMBS, dtype=torch.int32, device=self.device)
        self._bounds = torch.full((2, _sheet.N_COUNTS), 2**31 - 1, dtype=torch.int32, device=self.device)
        # On a CPU a kernel is one thread, and may as well do several short steps; and reading a number costs nothing.
        self._is_serial = self.device.type == "cpu"
        self._read_counts = self._counts.numpy() if self._is_serial else None
        self._sheet = self._bind_sheet()
        self._commands: dict[str, Any] = {}
        self._dims: dict[str, int] = {}
        self._recorded_for: tuple[Any, ...] = ()

    @torch.no_grad()
    def __call__(
        self,
        points: Tensor,
        sdf: ExactSdf | BandSdf | ApproxSdf,
        start: SdfSample,
        *,
        margin: float = DEFAULT_MARGIN,
        scale: float | VertexScale = 1.0,
    ) -> Resolution:
        """The garment with vertices [m], shape (N, 3), off the body last given to `sdf`; not differentiable.

        Args:
            points: Garment vertices [m], shape (N, 3).
            sdf: The body's signed distance.
            start: What it says of the points; what is beyond `margin` + 2 mm may be clipped from above.
            margin: ε ≥ 0 [m].
            scale: α of the first push, as `resolve` takes it.
        """
        self._bring(points, sdf, start, margin, scale)
        counts = self._counts.cpu().numpy()
        low = counts[_sheet.CUTTING + 1 : _sheet.CUTTING + 1 + _MAX_PUSHES]
        return Resolution(
            self._vectors["place"].clone(),
            self._floats["distance"].clone(),
            n_inside=int(counts[_sheet.INSIDE]),
            n_pushed=int(counts[_sheet.MOVED]),
            rounds=1 + int(np.count_nonzero(low)) if counts[_sheet.NEAR] else 0,
            max_depth=max(0.0, -float(self._floats["first"].min())) if len(points) else 0.0,
            n_unresolved=int(counts[_sheet.STUCK]),
        )

    @torch.no_grad()
    def queued(
        self,
        points: Tensor,
        sdf: ExactSdf | ApproxSdf,
        start: SdfSample,
        *,
        margin: float = DEFAULT_MARGIN,
        scale: float | VertexScale = 1.0,
    ) -> tuple[Tensor, Tensor]:
        """The same of a GPU that isn't waited for: vertices (N, 3), and a resolution's numbers, float32, shape (4,).

        These are `n_inside`, `n_pushed`, `n_unresolved` and `max_depth`.
        """
        self._bring(points, sdf, start, margin, scale)
        depth = -self._floats["first"].amin(0, keepdim=True)
        counts = self._counts[_sheet.INSIDE : _sheet.STUCK + 1].float()
        return self._vectors["place"].clone(), torch.cat((counts, depth.clamp_min(0)))

    def _bring(
        self,
        points: Tensor,
        sdf: ExactSdf | BandSdf | ApproxSdf,
        start: SdfSample,
        margin: float,
        scale: float | VertexScale,
    ) -> None:
        with torch_stream(self.device):
            self._take(points, start)
            self._record(sdf, margin)
            self._mend(can_miss=isinstance(sdf, ApproxSdf))
            self._run("list", self._n_vertices)
            n = self._length(_sheet.NEAR)
            if n:
                self._push(n, scale)
                self._raise_edges()
                self._run("tally", n)

    def _take(self, points: Tensor, start: SdfSample) -> None:
        """Takes over a frame."""
        assert start.face is not None  # these distances are to faces
        self._counts.zero_()
        if not self._is_serial:
            self._bounds.zero_()
        self._vectors["origin"].copy_(points)
        self._floats["first"].copy_(start.distance)
        self._vectors["first_gradient"].copy_(start.gradient)
        self._ints["first_face"].copy_(start.face)

    def _mend(self, *, can_miss: bool) -> None:
        """Makes the distances consistent along edges, as `mend` does; some closest faces may have been missed."""
        self._run("begin", self._n_vertices)
        self._run("compare", self._n_vertices)
        for remedy, rounds in (("look again", LOOKS if can_miss else 0), ("cut off", ROUNDS)):
            for _ in range(rounds):
                n = self._length(_sheet.SUSPECTS)
                self._counts[_sheet.CHANGED].zero_()
                self._run(remedy, n)
                self._run("adopt", n)
                if self._is_serial and not self._count(_sheet.CHANGED):
                    break

    def _push(self, n: int, scale: float | VertexScale) -> None:
        """The `n` near out of other limbs on the near side, and out of the body, with the neighbourhood."""
        self._run("look", n)
        if not self._is_serial or self._counts[_sheet.N_COUNTS : _sheet.N_COUNTS + _N_LIMBS].any():
            self._run("retreat", n)
            self._run("fill", n)
        self._run("aim", n)
        n_pushed = self._length(_sheet.PUSHED)
        if n_pushed:
            alpha = self._floats["alpha"][:n_pushed]
            if callable(scale):
                rows = self._ints["pushed"][:n_pushed].long()
                alpha.copy_(scale(rows, self._floats["depth"][rows]))
            else:
                alpha.fill_(scale)
            self._run("scale", n_pushed)
        self._blend()
        self._run("settle", self._length(_sheet.REACHED))

    def _blend(self) -> None:
        """The neighbourhood of those pushed gives way with them."""
        if self._is_serial:
            self._run("blend", 1)
            return
        for _ in range(BLEND_REACH):
            self._run("reach", self._length(_sheet.REACHED))
        n = self._length(_sheet.REACHED)
        for sweep in range(len(BLEND_STEPS)):
            self._run(f"spread{sweep % 2}", n)

    def _raise_edges(self) -> None:
        """Raises both ends of the edges that run too low."""
        n = len(self._limbs.edges)
        self._run("suspect", n)
        if self._is_serial:
            self._run("raise edges", int(self._count(_sheet.CUTTING) > 0))
            return
        self._close(_sheet.CUTTING)
        for round_ in range(_MAX_PUSHES):
            self._run("measure" if round_ == 0 else f"again{round_ % 2}", n, (4, round_))
            self._close(_sheet.CUTTING + 1 + round_)
            self._counts[_sheet.RAISED].zero_()
            self._run(f"choose{round_ % 2}", n, (2, round_))
            self._run("lift", self._length(_sheet.RAISED))

    def _length(self, which: int) -> int:
        """How long a launch through a list of vertices is: as long as the list, or as it may be."""
        if self._is_serial:
            return self._count(which)
        self._close(which)
        return self._n_vertices

    def _close(self, which: int) -> None:
        self._run("close", 1, (1, which))

    def _count(self, which: int) -> int:
        assert self._read_counts is not None  # of a CPU
        return int(self._read_counts[which])

    def _run(self, name: str, n: int, parameter: tuple[int, int] | None = None) -> None:
        """Launches a step for `n` of its list, with one of its parameters, by position, set anew."""
        if not n:
            return
        command = self._commands[name]
        if parameter is not None:
            command.set_param_at_index(*parameter)
        if self._dims.get(name) != n:
            command.set_dim(n)
            self._dims[name] = n
        command.launch()

    def _command(self, name: str, kernel: Any, inputs: list[Any]) -> None:
        self._dims[name] = 1
        self._commands[name] = wp.launch(kernel, dim=1, inputs=inputs, device=str(self.device), record_cmd=True)

    def _record(self, sdf: ExactSdf | BandSdf | ApproxSdf, margin: float) -> None:
        """Records the launches of a frame, unless they are the last frame's."""
        skin = sdf.skin()
        key = (skin, margin)
        if key == self._recorded_for:
            return
        self._recorded_for = key
        sheet, cloth, rules = self._sheet, self._cloth, _rules(margin)
        self._command("begin", _resolver_kernels.begin_kernel, [sheet])
        self._command("compare", _resolver_kernels.compare_kernel, [sheet, cloth, rules])
        self._command("look again", _resolver_kernels.look_again_kernel, [sheet, cloth, skin, rules])
        self._command("cut off", _resolver_kernels.cut_off_kernel, [sheet, cloth, rules])
        self._command("adopt", _resolver_kernels.adopt_kernel, [sheet, cloth])
        self._command("list", _resolver_kernels.list_kernel, [sheet, rules])
        self._command("look", _resolver_kernels.look_kernel, [sheet, cloth, rules])
        self._command("retreat", _resolver_kernels.retreat_kernel, [sheet, cloth, skin, rules])
        self._command("fill", _resolver_kernels.fill_kernel, [sheet, cloth, skin, rules])
        self._command("aim", _resolver_kernels.aim_kernel, [sheet, cloth, skin, rules])
        self._command("scale", _resolver_kernels.scale_kernel, [sheet, rules])
        self._command("settle", _resolver_kernels.settle_kernel, [sheet, skin, rules])
        self._command("suspect", _edge_kernels.suspect_kernel, [sheet, cloth, rules])
        self._command("tally", _resolver_kernels.tally_kernel, [sheet])
        long_step, short_step = BLEND_STEPS[:2]
        if self._is_serial:
            inputs = [sheet, cloth, BLEND_REACH, len(BLEND_STEPS) // 2, long_step, short_step]
            self._command("blend", _spread_kernels.blend_kernel, inputs)
            self._command("raise edges", _edge_kernels.raise_edges_kernel, [sheet, cloth, skin, rules])
            return
        suspects, low, lower = (as_warp(row, wp.int32) for row in self._by_edge)
        self._command("close", _round_kernels.close_kernel, [sheet, 0])
        self._command("reach", _round_kernels.reach_kernel, [sheet, cloth])
        for name, step, fields in (
            ("spread0", long_step, (sheet.field, sheet.smoother)),
            ("spread1", short_step, (sheet.smoother, sheet.field)),
        ):
            self._command(name, _round_kernels.spread_kernel, [sheet, cloth, step, *fields])
        for name, source, target in (("measure", suspects, low), ("again1", low, lower), ("again0", lower, low)):
            self._command(name, _round_kernels.measure_kernel, [sheet, cloth, skin, rules, 0, source, target])
        for name, source in (("choose0", low), ("choose1", lower)):
            self._command(name, _round_kernels.choose_kernel, [sheet, cloth, 0, source])
        self._command("lift", _round_kernels.lift_kernel, [sheet, skin, rules])

    def _bind_sheet(self) -> Any:
        sheet = _sheet.Sheet()
        for tensors, kind in ((self._vectors, wp.vec3), (self._floats, wp.float32), (self._ints, wp.int32)):
            for name, tensor in tensors.items():
                setattr(sheet, name, as_warp(tensor, kind))
        sheet.suspects = as_warp(self._by_edge[0], wp.int32)
        sheet.deficit, sheet.rise = as_warp(self._deficit, wp.float32), as_warp(self._rise, wp.vec3)
        sheet.counts = as_warp(self._counts, wp.int32)
        sheet.touched = as_warp(self._counts[_sheet.N_COUNTS :], wp.int32)
        sheet.inward = as_warp(self._counts[_sheet.N_COUNTS + _N_LIMBS :], wp.int32)
        sheet.begins, sheet.ends = (as_warp(bounds, wp.int32) for bounds in self._bounds)
        return sheet


_VECTORS = ("origin", "first_gradient", "place", "gradient", "outward", "heading", "field", "smoother")
_FLOATS = ("first", "distance", "along", "way", "depth", "goal", "alpha", "largest")
_INTS = ("first_face", "face", "guess", "role", "mark", "near", "pushed", "reached", "moved")
_N_LIMBS = 4


def _rules(margin: float) -> Any:
    rules = _sheet.Rules()
    rules.margin, rules.tolerance, rules.max_displacement, rules.max_pushes = (
        margin,
        _TOLERANCE,
        MAX_DISPLACEMENT,
        _MAX_PUSHES,
    )
    rules.contradiction, rules.step_on, rules.deep, rules.sure = TOLERANCE, STEP_ON, DEEP, SURE
    rules.sideways, rules.inward = SIDEWAYS, INWARD
    rules.bulge, rules.through = BULGE, THROUGH
    rules.farthest, rules.detour, rules.turning = FARTHEST, DETOUR, TURNING
    rules.retreats, rules.turns = RETREAT_STEPS, STEPS
    return rules


def _cloth(limbs: Limbs) -> Any:
    """The garment as the kernels read it."""
    n = len(limbs.own)
    edges, faces = limbs.edges.cpu().numpy(), limbs.faces.cpu().numpy()
    ring_start, ring = _grouped(np.concatenate((edges, edges[:, ::-1])), n)
    corner = np.stack((faces.ravel(), np.repeat(np.arange(len(faces)), 3)), axis=1)
    fan_start, fan = _grouped(corner, n)
    bits = (limbs.own.cpu().numpy() << np.arange(limbs.own.shape[1])).sum(axis=1)
    cloth = _sheet.Cloth()
    arrays = {"ring_start": ring_start, "ring": ring, "fan_start": fan_start, "fan": fan, "faces": faces}
    arrays |= {"edges": edges, "own": bits, "limb": limbs.of_face.cpu().numpy()}
    for name, array in arrays.items():
        setattr(cloth, name, wp.array(array.astype(np.int32), dtype=wp.int32, device=str(limbs.faces.device)))
    cloth.clearance = as_warp(limbs.clearance.float().contiguous(), wp.float32)
    return cloth


def _grouped(pairs: NDArray[np.int64], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The second numbers of pairs (K, 2) grouped by the first ones, which are below n: starts (n + 1,) and values."""
    order = np.argsort(pairs[:, 0], kind="stable")
    return np.searchsorted(pairs[order, 0], np.arange(n + 1)), pairs[order, 1]
