"""Brings one garment off the body, in real time: each step is one launch over the vertices that it concerns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import Recorded, Repeated, Unpicklable, as_warp, ints, memory, readable, torch_stream
from refu_core.contact import _edge_kernels, _parting_kernels, _resolver_kernels, _round_kernels, _state
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.errors import MeshError, require_type
from refu_core.mesh import Connectivity
from refu_core.modes import DEFAULT_MARGIN
from refu_core.refu import VertexScale, require_margin
from refu_core.sdf import MeshSdf, SdfSample, require_finite, require_tensor


class Resolution(NamedTuple):
    """A garment off the body, and what that took."""

    vertices: Tensor
    """Garment vertices [m], shape (N, 3)."""
    distance: Tensor
    """Their signed distance [m], shape (N,); beyond the margin it may be a lower bound."""
    gradient: Tensor
    """Its unit gradient there, shape (N, 3)."""
    face: Tensor
    """The body's closest face, int32, shape (N,); -1 where none is known."""
    numbers: Tensor
    """`n_inside`, `n_pushed`, `n_unresolved`, `max_depth` and `n_clipped`, shape (5,), on the garment's device."""

    @property
    def n_inside(self) -> int:
        """Vertices inside the body before."""
        return int(self.numbers[0])

    @property
    def n_pushed(self) -> int:
        """Vertices that were nearer than the margin before, and were moved."""
        return int(self.numbers[1])

    @property
    def n_unresolved(self) -> int:
        """Vertices still inside: deeper than they may move, or where the body runs through itself."""
        return int(self.numbers[2])

    @property
    def max_depth(self) -> float:
        """Depth of the deepest vertex before [m], 0 where none was inside."""
        return float(self.numbers[3])

    @property
    def n_clipped(self) -> int:
        """Vertices so far off that their distance wasn't known before."""
        return int(self.numbers[4])


class Resolver(Unpicklable):
    """Brings one garment off posed bodies.

    The steps: where an approximate distance has missed the closest face, a neighbour's face leads to it; vertices
    nearer than the margin are pushed along the gradient (ReFU, paper, Eq. 2), to half the margin at least and in the
    order in which they lay; their neighbours give way; edges that still run too low are raised. A step that depends on
    other vertices is a step of its own, so the order of vertices plays no role.

    On a CPU, steps that concern no vertex are left out. To know that, a GPU would have to be waited for. So it gets the
    same launches in every frame, as a CUDA graph needs, and the numbers of a `Resolution` stay on it.
    """

    def __init__(
        self, faces: Tensor | NDArray[Any], n_vertices: int, *, settings: ContactSettings = DEFAULT_CONTACT
    ) -> None:
        """For garments of `faces` (G, 3) on their device. Raises `MeshError` for a face beyond `n_vertices` N."""
        self._settings = settings
        self.device = faces.device if isinstance(faces, Tensor) else torch.device("cpu")
        mesh = Connectivity.of(faces, n_vertices)
        self._n_vertices = n = mesh.n_vertices
        self._n_edges = e = len(mesh.edges)
        self._cloth = _cloth(mesh, self.device)
        self._faces, self._glimpsed = ints(mesh.faces, self.device), None
        self._state = state = _state.State()
        self._vectors = {name: memory(n, 3, device=self.device) for name in _VECTORS}
        self._floats = {name: memory(n, device=self.device) for name in _FLOATS}
        self._ints = {name: memory(n, device=self.device, dtype=torch.int32) for name in _INTS}
        for tensors, kind in ((self._vectors, wp.vec3), (self._floats, wp.float32), (self._ints, wp.int32)):
            for name, tensor in tensors.items():
                setattr(state, name, as_warp(tensor, kind))
        n_counts = _state.CUTTING + 1 + settings.max_pushes
        self._counts = memory(n_counts, dtype=torch.int32, device=self.device)
        self._bounds = memory(2, n_counts, dtype=torch.int32, device=self.device).fill_(2**31 - 1)
        state.counts, state.begins, state.ends = (as_warp(one, wp.int32) for one in (self._counts, *self._bounds))
        state.suspects, *self._low = (wp.zeros(e, dtype=wp.int32, device=str(self.device)) for _ in range(3))
        state.deficit = wp.zeros(e, dtype=wp.float32, device=str(self.device))
        state.rise = wp.zeros(e, dtype=wp.vec3, device=str(self.device))
        # On a CPU a kernel is one thread and can do several short steps, and reading a number costs nothing.
        self._is_serial = self.device.type == "cpu"
        self._n_threads, each = (1, n) if self._is_serial else (n, 1)
        self._result = self._vectors["place"], self._floats["distance"], self._vectors["gradient"], self._ints["face"]
        kinds = (wp.vec3, wp.float32, wp.vec3, wp.int32, wp.float32)
        self._conclude = Repeated(_resolver_kernels.conclude_kernel, kinds, [each, state])
        self._read_counts = readable(self._counts)
        self._known: dict[tuple[Any, float], dict[str, Any]] = {}
        self._last_sdf: MeshSdf | None = None
        """That of the last call; None if that was interrupted, and may have left what it worked with behind."""

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
            start: What `sdf` says of the points; distances beyond `margin` + `ASKED_FROM` may be clipped from above.
                Points of which it says NaN are queried.
                None goes on from where the last call ended, if that was for the same body: only points that were moved
                since, and may have come that near, are queried.
            margin: ε ≥ 0 [m].
            scale: α of the first push: one number, or a function of vertices and their distances.

        Raises:
            MeshError: points that are of the wrong number or type, or not finite; a negative margin; a distance that
                isn't to faces; or no start though the last call wasn't for this `sdf`, or was interrupted.
        """
        require_tensor("points", points)
        distances = self._floats["distance"] if start is None else start.distance
        if points.shape != (self._n_vertices, 3) or distances.shape != (self._n_vertices,):
            shapes = f"{tuple(points.shape)} and {tuple(distances.shape)}"
            raise MeshError(f"wanted {self._n_vertices} points and their distances, got the shapes {shapes}")
        require_margin(margin)
        require_type(sdf, MeshSdf, "a distance to faces, such as an ExactSdf", error=MeshError)
        if start is None and sdf is not self._last_sdf:
            why = "the last call wasn't for this sdf, or was interrupted"
            raise MeshError(f"nothing to go on from: {why}; give what it says of the points as start")
        is_torn, self._last_sdf = self._last_sdf is None, None
        with torch_stream(self.device):
            self._commands = self._launches(sdf.skin(), margin)
            self._counts.zero_()
            if is_torn:
                for left in (self._vectors["field"], self._vectors["smoother"], self._floats["largest"]):
                    left.zero_()
                self._ints["mark"].zero_()
            if not self._is_serial:
                self._bounds.zero_()
            self._vectors["origin"].copy_(points)
            if start is None:
                self._run("go on")
            elif start.face is None:
                raise MeshError("start must name the closest faces: ask an ExactSdf, BandSdf or ApproxSdf")
            else:
                self._floats["first"].copy_(start.distance)
                self._vectors["first_gradient"].copy_(start.gradient)
                torch.clamp(start.face, max=len(sdf.faces) - 1, out=self._ints["first_face"])  # maybe of another body
                self._run("begin")
            if self._is_serial and self._count(_state.ASTRAY):  # a GPU would have to be waited for
                require_finite("points", points)
            if not sdf.is_exact:
                self._reconcile()
            self._run("list")
            n = self._length(_state.NEAR)
            if n:
                self._push(n, scale)
            if n or self._length(_state.SHIFTED):
                self._raise_edges()
        vertices, distance, gradient, face = map(torch.empty_like, self._result)
        result = Resolution(vertices, distance, gradient, face, distance.new_zeros(5))
        self._conclude((self._n_threads,), *result)
        self._last_sdf = sdf
        return result

    def glimpse(self, result: Resolution, points: Tensor, sdf: MeshSdf) -> Tensor:
        """How many faces with vertices `points` (N, 3) [m] are seen to cut the body last given to `sdf`, int32, (1,).

        The body is asked only where it may bulge up to a face, by what is known of the face's corners: `result`, for
        vertices that are still there. Faces with a corner that has moved count as well. That takes a fifth of the time
        of `Parting.find`, and sees whether any face cuts smooth skin, however fine. The tip of a finger may be missed.
        """
        skin = sdf.skin()
        if self._glimpsed is not skin:
            self._glimpsed, kinds = skin, (wp.vec3, wp.float32, wp.vec3, wp.int32, wp.int32)
            self._n_pieces, each = (1, len(self._faces)) if self._is_serial else (len(self._faces), 1)
            self._glimpse = Repeated(_parting_kernels.glimpse_kernel, kinds, [each, self._faces, skin])
        count = torch.zeros(1, dtype=torch.int32, device=self.device)
        far = result.distance
        if points is not result.vertices:
            has_moved = (points - result.vertices).norm(dim=1) > self._settings.tolerance
            far = torch.where(has_moved, 0.0, far)
        self._glimpse((self._n_pieces,), points.contiguous(), far, result.gradient, result.face, count)
        return count

    def _reconcile(self) -> None:
        """Finds closest faces that were missed, where distances along an edge contradict each other."""
        self._run("compare")
        for _ in range(self._settings.max_pushes):
            if self._length(_state.SUSPECTS):
                self._run("retry")
                self._run("adopt")
            if self._is_serial and not self._count(_state.CHANGED):
                break

    def _push(self, n: int, scale: float | VertexScale) -> None:
        """The `n` near vertices leave the body, and their neighbours follow."""
        alpha = self._floats["alpha"][:n]  # so far the distances that α is predicted from
        if callable(scale):
            alpha.copy_(scale(self._ints["near"][:n].long(), alpha))
        else:
            alpha.fill_(scale)
        self._run("scale")
        if self._is_serial:
            self._run("blend")
        else:
            for _ in range(self._settings.near):
                self._close(_state.REACHED)
                self._run("reach")
            self._close(_state.REACHED)
            for sweep in range(self._settings.around):
                self._run(f"spread{sweep % 2}")
            self._close(_state.REACHED)
        self._run("settle")

    def _raise_edges(self) -> None:
        """Raises both ends of the edges that run too low."""
        self._run("suspect")
        if self._is_serial:
            if self._count(_state.CUTTING):
                self._run("raise edges")
            return
        self._close(_state.CUTTING)
        for round_ in range(self._settings.max_pushes):
            self._run(f"measure{round_}")
            self._close(_state.CUTTING + 1 + round_)
            self._counts[_state.RAISED].zero_()
            self._run(f"choose{round_}")
            self._length(_state.RAISED)
            self._run("lift")

    def _length(self, which: int) -> int:
        """The length of a list of vertices; on a GPU, where this closes it, the most that it can be."""
        if self._is_serial:
            return self._count(which)
        self._close(which)
        return self._n_vertices

    def _close(self, which: int) -> None:
        self._run(f"close{which}")

    def _count(self, which: int) -> int:
        return int(self._read_counts[which])

    def _run(self, name: str) -> None:
        self._commands[name].launch()

    def _launches(self, skin: Any, margin: float) -> dict[str, Any]:
        if (skin, margin) not in self._known:
            if len(self._known) >= _MOST_MARGINS:
                self._known.clear()
            self._known[skin, margin] = self._recorded(skin, margin)
        return self._known[skin, margin]

    def _recorded(self, skin: Any, margin: float) -> dict[str, Any]:
        """The launches of a frame, by name; on a CPU each is one thread, which goes through everything."""
        how, state, cloth, n = self._settings, self._state, self._cloth, self._n_vertices
        rules = _state.Rules()
        rules.margin, rules.tolerance, rules.max_displacement = margin, how.tolerance, how.max_displacement
        rules.max_pushes, rules.gap = how.max_pushes, how.gap
        each = n if self._is_serial else 1
        steps: dict[str, tuple[Any, list[Any]]] = {
            "begin": (_resolver_kernels.begin_kernel, [each, state, skin]),
            "go on": (_resolver_kernels.go_on_kernel, [each, margin + ASKED_FROM, state, skin]),
            "compare": (_resolver_kernels.compare_kernel, [each, state, cloth, rules]),
            "retry": (_resolver_kernels.retry_kernel, [each, state, cloth, skin, rules]),
            "adopt": (_resolver_kernels.adopt_kernel, [each, state, cloth]),
            "list": (_resolver_kernels.list_near_kernel, [each, state, rules]),
            "scale": (_resolver_kernels.scale_kernel, [each, state, rules]),
            "settle": (_resolver_kernels.settle_kernel, [each, state, skin, rules]),
            "suspect": (_edge_kernels.suspect_kernel, [each, state, cloth, rules]),
        }
        long_step, short_step = how.blend_steps
        if self._is_serial:
            numbers = [how.near, how.around, long_step, short_step]
            steps["blend"] = (_resolver_kernels.blend_kernel, [state, cloth, *numbers])
            steps["raise edges"] = (_edge_kernels.raise_edges_kernel, [state, cloth, skin, rules])
            return {name: Recorded(kernel, 1, inputs, self.device) for name, (kernel, inputs) in steps.items()}
        steps["reach"] = (_round_kernels.reach_kernel, [state, cloth])
        steps["spread0"] = (_round_kernels.spread_kernel, [state, cloth, long_step, state.field, state.smoother])
        steps["spread1"] = (_round_kernels.spread_kernel, [state, cloth, short_step, state.smoother, state.field])
        steps["lift"] = (_round_kernels.lift_kernel, [state, skin, rules])
        launches = {name: (kernel, n, inputs) for name, (kernel, inputs) in steps.items()}
        source = state.suspects
        for k in range(how.max_pushes):
            low = self._low[k % 2]
            inputs = [state, cloth, skin, rules, k, source, low]
            launches[f"measure{k}"] = _round_kernels.measure_kernel, self._n_edges, inputs
            launches[f"choose{k}"] = _round_kernels.choose_kernel, self._n_edges, [state, cloth, k, low]
            source = low
        for k in range(len(self._counts)):
            launches[f"close{k}"] = _round_kernels.close_kernel, 1, [state, k]
        return {name: Recorded(*launch, self.device) for name, launch in launches.items()}


ASKED_FROM = 2e-3
"""Vertices are asked for their exact distance up to this far beyond the margin [m]."""
_MOST_MARGINS = 8
"""How many margins' launches are kept; an outer garment has two margins a frame."""
_VECTORS = ("origin", "first_gradient", "place", "gradient", "field", "smoother")
_FLOATS = ("first", "distance", "way", "goal", "alpha", "largest")
_INTS = ("first_face", "face", "mark", "fresh", "near", "reached", "moved")


def _cloth(mesh: Connectivity, device: torch.device) -> Any:
    """The garment as the kernels read it."""
    owner, ring = mesh.ring.owner, mesh.ring.items
    # The order of neighbours decides how sums over them are rounded: those with a higher number than the vertex first.
    ring = ring[np.lexsort((ring < owner, owner))]
    cloth = _state.Cloth()
    cloth.ring_start, cloth.ring, cloth.edges = (ints(one, device) for one in (mesh.ring.start, ring, mesh.edges))
    cloth.edge_start = ints(np.searchsorted(mesh.edges[:, 0], np.arange(mesh.n_vertices + 1)), device)
    return cloth
