"""Brings one garment off the body, in real time: each step is one launch over the vertices that it concerns."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.contact import _edge_kernels, _resolver_kernels, _round_kernels, _spread_kernels, _state
from refu_core.contact._resolution import Resolution
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.errors import MeshError
from refu_core.mesh import Connectivity
from refu_core.modes import DEFAULT_MARGIN
from refu_core.refu import VertexScale
from refu_core.sdf import MeshSdf, SdfSample, require_tensor


class Resolver:
    """Brings one garment off posed bodies.

    The steps: where an approximate distance has missed the closest face, a neighbour names it; vertices nearer than the
    margin are pushed along the gradient (ReFU, paper, Eq. 2); their neighbours give way; edges that still run too low
    are raised. Nothing in it knows of limbs: a body that doesn't run through itself (`Collider`) has room around each.

    Memory and launches are prepared once. Each step lists the vertices for the next one, so a step costs what the
    vertices at the skin do. What depends on other vertices is finished for all of them by one launch before the next
    begins, so their order plays no role.

    On a CPU, steps that concern no vertex are left out. A GPU would have to be waited for to know, so it gets the same
    launches in every frame, as a CUDA graph needs them. For the same reason the numbers of a `Resolution` stay on the
    device until they are read.
    """

    def __init__(self, faces: Tensor, n_vertices: int, *, settings: ContactSettings = DEFAULT_CONTACT) -> None:
        """For garments of these `faces`, shape (G, 3), and `n_vertices` N, on the device of the faces.

        Raises:
            MeshError: a face that names a vertex there isn't.
        """
        self._settings, self.device = settings, faces.device
        mesh = Connectivity.of(faces.cpu(), n_vertices)
        n, e = n_vertices, len(mesh.edges)
        self._n_vertices, self._n_edges = n, e
        self._cloth = _cloth(mesh, str(self.device))
        self._vectors = {name: torch.zeros(n, 3, device=self.device) for name in _VECTORS}
        self._floats = {name: torch.zeros(n, device=self.device) for name in _FLOATS}
        self._ints = {name: torch.zeros(n, dtype=torch.int32, device=self.device) for name in _INTS}
        self._by_edge = torch.zeros(3, e, dtype=torch.int32, device=self.device)
        self._deficit = torch.zeros(e, device=self.device)
        self._rise = torch.zeros(e, 3, device=self.device)
        self._counts = torch.zeros(_state.N_COUNTS, dtype=torch.int32, device=self.device)
        self._bounds = torch.full((2, _state.N_COUNTS), 2**31 - 1, dtype=torch.int32, device=self.device)
        # On a CPU a kernel is one thread and can do several short steps, and reading a number costs nothing.
        self._is_serial = self.device.type == "cpu"
        self._read_counts = self._counts.numpy() if self._is_serial else None
        self._state = self._bind_state()
        self._commands: dict[str, Any] = {}
        self._recorded: dict[float, tuple[Any, dict[str, Any]]] = {}

    @torch.no_grad()
    def __call__(
        self,
        points: Tensor,
        sdf: MeshSdf,
        start: SdfSample | None,
        *,
        margin: float = DEFAULT_MARGIN,
        scale: float | VertexScale = 1.0,
    ) -> Resolution:
        """The garment with vertices [m], shape (N, 3), off the body last given to `sdf`; not differentiable.

        Args:
            points: Garment vertices [m], shape (N, 3).
            sdf: The body's signed distance.
            start: What it says of the points; what is beyond `margin` + `ASKED_FROM` may be clipped from above. None
                goes on from what the last call ended with, if that was for the same body: only points that were moved
                since, and may have come that near, are asked.
            margin: ε ≥ 0 [m].
            scale: α of the first push: one number, or a function of vertices and their distances.

        Raises:
            MeshError: points of another number or type, a negative margin, or a distance that isn't one to faces.
        """
        require_tensor("points", points)
        distances = self._floats["distance"] if start is None else start.distance
        if points.shape != (self._n_vertices, 3) or distances.shape != (self._n_vertices,):
            shapes = f"{tuple(points.shape)} and {tuple(distances.shape)}"
            msg = f"wanted {self._n_vertices} points and their distances, got the shapes {shapes}"
            raise MeshError(msg)
        if not 0 <= margin < math.inf:
            msg = f"wanted a margin of 0 m or more, got {margin}"
            raise MeshError(msg)
        if start is not None and start.face is None:
            msg = "start must name the closest faces: ask an ExactSdf, BandSdf or ApproxSdf"
            raise MeshError(msg)
        with torch_stream(self.device):
            self._take(points, start)
            self._record(sdf, margin)
            self._run("go on" if start is None else "begin")
            if not sdf.is_exact:
                self._reconcile()
            self._run("list")
            n = self._length(_state.NEAR)
            if n:
                self._push(n, scale)
            if n or self._length(_state.SHIFTED):
                self._raise_edges()
            if n:
                self._run("tally")
        depth = -self._floats["first"].amin(0, keepdim=True)
        counts = self._counts[_state.INSIDE : _state.STUCK + 1].float()
        return Resolution(
            self._vectors["place"].clone(),
            self._floats["distance"].clone(),
            torch.cat((counts, depth.clamp_min(0))),
        )

    def _take(self, points: Tensor, start: SdfSample | None) -> None:
        """Takes over a frame."""
        self._counts.zero_()
        if not self._is_serial:
            self._bounds.zero_()
        self._vectors["origin"].copy_(points)
        if start is not None:
            assert start.face is not None  # these distances are to faces
            self._floats["first"].copy_(start.distance)
            self._vectors["first_gradient"].copy_(start.gradient)
            self._ints["first_face"].copy_(start.face)

    def _reconcile(self) -> None:
        """Where distances contradict each other along an edge, a closest face was missed."""
        self._run("compare")
        for _ in range(self._settings.max_pushes):
            n = self._length(_state.SUSPECTS)
            self._counts[_state.CHANGED].zero_()
            if n:
                self._run("retry")
                self._run("adopt")
            if self._is_serial and not self._count(_state.CHANGED):
                break

    def _push(self, n: int, scale: float | VertexScale) -> None:
        """The `n` near vertices leave the body, and their neighbours follow."""
        alpha = self._floats["alpha"][:n]
        if callable(scale):
            rows = self._ints["near"][:n].long()
            alpha.copy_(scale(rows, self._floats["distance"].index_select(0, rows)))
        else:
            alpha.fill_(scale)
        self._run("scale")
        self._blend()
        self._length(_state.REACHED)
        self._run("settle")

    def _blend(self) -> None:
        """Neighbours of pushed vertices give way with them."""
        if self._is_serial:
            self._run("blend")
            return
        for _ in range(self._settings.near):
            self._length(_state.REACHED)
            self._run("reach")
        self._length(_state.REACHED)
        for sweep in range(2 * self._settings.blend_pairs):
            self._run(f"spread{sweep % 2}")

    def _raise_edges(self) -> None:
        """Raises both ends of the edges that run too low."""
        self._run("suspect")
        if self._is_serial:
            if self._count(_state.CUTTING):
                self._run("raise edges")
            return
        self._close(_state.CUTTING)
        for round_ in range(self._settings.max_pushes):
            self._run("measure" if round_ == 0 else f"again{round_ % 2}", (4, round_))
            self._close(_state.CUTTING + 1 + round_)
            self._counts[_state.RAISED].zero_()
            self._run(f"choose{round_ % 2}", (2, round_))
            self._length(_state.RAISED)
            self._run("lift")

    def _length(self, which: int) -> int:
        """How long a list of vertices is; on a GPU, which closes it, how long it may become."""
        if self._is_serial:
            return self._count(which)
        self._close(which)
        return self._n_vertices

    def _close(self, which: int) -> None:
        self._run("close", (1, which))

    def _count(self, which: int) -> int:
        assert self._read_counts is not None  # of a CPU
        return int(self._read_counts[which])

    def _run(self, name: str, parameter: tuple[int, int] | None = None) -> None:
        """Launches a step, with one of its parameters, by position, set anew."""
        if parameter is not None:
            self._commands[name].set_param_at_index(*parameter)
        self._commands[name].launch()

    def _command(self, name: str, kernel: Any, inputs: list[Any], n: int | None = None) -> None:
        """Records a launch for `n` items, by default the vertices; on a CPU for one thread, which goes through all."""
        dim = 1 if self._is_serial else self._n_vertices if n is None else n
        self._commands[name] = wp.launch(kernel, dim, inputs, device=str(self.device), record_cmd=True)

    def _record(self, sdf: MeshSdf, margin: float) -> None:
        """Records the launches of a frame, or takes those that were recorded for the same body and margin."""
        skin = sdf.skin()
        if margin in self._recorded and self._recorded[margin][0] is skin:
            self._commands = self._recorded[margin][1]
            return
        if len(self._recorded) >= _MOST_MARGINS:
            self._recorded.clear()
        self._commands = {}
        self._recorded[margin] = skin, self._commands
        state, cloth, rules = self._state, self._cloth, self._rules(margin)
        each = self._n_vertices if self._is_serial else 1
        self._command("begin", _resolver_kernels.begin_kernel, [each, state])
        self._command("go on", _resolver_kernels.go_on_kernel, [each, margin + ASKED_FROM, state, skin])
        self._command("compare", _resolver_kernels.compare_kernel, [each, state, cloth, rules])
        self._command("retry", _resolver_kernels.retry_kernel, [each, state, cloth, skin, rules])
        self._command("adopt", _resolver_kernels.adopt_kernel, [each, state, cloth])
        self._command("list", _resolver_kernels.list_near_kernel, [each, state, rules])
        self._command("scale", _resolver_kernels.scale_kernel, [each, state, rules])
        self._command("settle", _resolver_kernels.settle_kernel, [each, state, skin, rules])
        self._command("suspect", _edge_kernels.suspect_kernel, [each, state, cloth, rules])
        self._command("tally", _resolver_kernels.tally_kernel, [each, state])
        long_step, short_step = self._settings.blend_steps
        if self._is_serial:
            inputs = [state, cloth, self._settings.near, self._settings.blend_pairs, long_step, short_step]
            self._command("blend", _spread_kernels.blend_kernel, inputs)
            self._command("raise edges", _edge_kernels.raise_edges_kernel, [state, cloth, skin, rules])
            return
        suspects, low, lower = (as_warp(row, wp.int32) for row in self._by_edge)
        self._command("close", _round_kernels.close_kernel, [state, 0], 1)
        self._command("reach", _round_kernels.reach_kernel, [state, cloth])
        for name, step, fields in (
            ("spread0", long_step, (state.field, state.smoother)),
            ("spread1", short_step, (state.smoother, state.field)),
        ):
            self._command(name, _round_kernels.spread_kernel, [state, cloth, step, *fields])
        for name, source, target in (("measure", suspects, low), ("again1", low, lower), ("again0", lower, low)):
            inputs = [state, cloth, skin, rules, 0, source, target]
            self._command(name, _round_kernels.measure_kernel, inputs, self._n_edges)
        for name, source in (("choose0", low), ("choose1", lower)):
            self._command(name, _round_kernels.choose_kernel, [state, cloth, 0, source], self._n_edges)
        self._command("lift", _round_kernels.lift_kernel, [state, skin, rules])

    def _rules(self, margin: float) -> Any:
        rules, given = _state.Rules(), self._settings
        rules.margin = margin
        for name in _state.RULES:
            setattr(rules, name, getattr(given, name))
        return rules

    def _bind_state(self) -> Any:
        state = _state.State()
        for tensors, kind in ((self._vectors, wp.vec3), (self._floats, wp.float32), (self._ints, wp.int32)):
            for name, tensor in tensors.items():
                setattr(state, name, as_warp(tensor, kind))
        state.suspects = as_warp(self._by_edge[0], wp.int32)
        state.deficit, state.rise = as_warp(self._deficit, wp.float32), as_warp(self._rise, wp.vec3)
        state.counts = as_warp(self._counts, wp.int32)
        state.begins, state.ends = (as_warp(bounds, wp.int32) for bounds in self._bounds)
        return state


ASKED_FROM = 2e-3
"""Vertices are asked for their exact distance up to this far beyond the margin [m]."""
_MOST_MARGINS = 8
"""Margins whose launches are kept: of an outer garment there are two a frame."""
_VECTORS = ("origin", "first_gradient", "place", "gradient", "field", "smoother")
_FLOATS = ("first", "distance", "way", "goal", "alpha", "largest")
_INTS = ("first_face", "face", "mark", "fresh", "near", "reached", "moved")


def _cloth(mesh: Connectivity, device: str) -> Any:
    """The garment as the kernels read it."""
    ring_start, ring = mesh.ring
    # The sums over neighbours are rounded in this order: those of a higher number first.
    ring = ring[np.lexsort((ring < mesh.ring.owner, mesh.ring.owner))]
    cloth = _state.Cloth()
    edge_start = np.searchsorted(mesh.edges[:, 0], np.arange(mesh.n_vertices + 1))
    for name, array in (("ring_start", ring_start), ("ring", ring), ("edges", mesh.edges), ("edge_start", edge_start)):
        setattr(cloth, name, wp.array(array.astype(np.int32), dtype=wp.int32, device=device))
    return cloth
