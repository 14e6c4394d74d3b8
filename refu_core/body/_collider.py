"""A posed body that doesn't run through itself: the repulsive force unit, applied to the body."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from refu_core._warp import as_warp, is_plain, torch_stream
from refu_core.body import _collider_kernels as kernels
from refu_core.body._collider_gradient import Closest, part_with_gradient
from refu_core.body._creases import LEVELS, find_creases
from refu_core.body._kinematics import PARENTS, RigidTransforms
from refu_core.body._model import SmplBody
from refu_core.body._segments import SOFTNESS, cut
from refu_core.mesh import Connectivity

DEFAULT_GAP = 0.012
"""Room that is left between two parts of a body [m]: two layers of cloth, each 4 mm off the skin, and some to spare."""


FADE = 0.035
"""Beyond the reach of a crease its planes let skin go by a metre a metre; so far out nothing would be held [m]."""


@dataclass(frozen=True, kw_only=True)
class ColliderSettings:
    """How a body is pulled apart. `benchmarks/collider.py` measures what half and twice of each do on recorded motion."""

    gap: float = DEFAULT_GAP
    """Room that is left between two parts [m]."""
    crease_share: float = 0.25
    """Share of its height over a seam in the rest pose that skin keeps, at most half of the gap: at an elbow bent by
    less than it takes to halve that twice, nothing moves."""
    crease_reach: float = 0.045
    """Skin up to this far from a seam keeps to its side [m], and skin beyond it less and less. Farther out segments
    find each other by their distance, and share what is to be given way in halves, which a plane doesn't."""
    segment_share: float = 0.3
    """Share of its distance from another segment in the rest pose that skin keeps, at most the gap: at a joint
    segments begin where they are 0 apart."""
    crease_rounds: int = 2
    """How often skin is brought to its side: at the groin several seams meet."""
    part_rounds: int = 4
    """Newton's steps to the surface between two segments."""
    deepen_rounds: int = 4
    """How far inside another segment skin is looked for [edges], from where its surface is within the gap."""
    smooth_first: int = 3
    """Sweeps over creases before segments are parted."""
    smooth_last: int = 1
    """Sweeps over all that was moved after it."""
    smooth_full: float = 0.004
    """Skin that was moved this far is levelled in full [m], and the less the less it was moved."""
    smooth_step: float = 0.5
    """How far a sweep goes towards the mean of the neighbours."""
    edge_rounds: int = 2
    """How often the middles of edges are brought out: a triangle cuts the corner between its vertices."""
    steep: float = 0.004
    """Edges whose ends were moved by this much apart from each other are looked at [m]."""


class Collider:
    """Gives way where a posed body runs through itself, as flesh does; pose and joints stay.

    1. *Creases.* Where a joint bends, skinning folds skin over itself. Skin is brought back to its own side of the seams
       near by (`Creases`), along the normal of a plane that turns with the joint.
    2. *Segments.* Parts that are in each other, or nearer than the gap, each give way until they are on their own side
       of the surface half way between them, by the softness of each: ReFU with the distance of one part from the other.
       Of no pair of parts can both then be at the same place.
    3. Dents are levelled, and edges that cut their corners raised.

    The result depends on the pose alone, not on the frames before, and continuously. Nothing moves where nothing is
    near: skin keeps its distance only as far as it has one in the rest pose.

    One call at a time: memory is kept from call to call.
    """

    def __init__(self, body: SmplBody, *, gap: float = DEFAULT_GAP, settings: ColliderSettings | None = None) -> None:
        """Prepares for a body, on its device, in about a second.

        Raises `MeshError` for a body that isn't a closed, consistently oriented surface.
        """
        self.settings = ColliderSettings(gap=gap) if settings is None else settings
        self.device = body.device
        self._is_serial = body.device.type == "cpu"
        rest = body.v_template.double().cpu().numpy()
        weights = body.weights.double().cpu().numpy()
        mesh = Connectivity.of(body.faces.cpu(), len(rest))
        mesh.require_closed()
        self.mesh = mesh
        self._tensors = _Tensors(len(rest), len(mesh.edges), self.device)
        self._rings = self._bind_rings(mesh)
        self._bones = self._bind_bones(rest, mesh, weights)
        self._seams, self._held, self._stations = self._bind_seams(rest, mesh, weights)
        self._segments = self._bind_segments(rest, mesh, weights)
        self._commands = self._record()

    def __call__(self, skin: Tensor, transforms: RigidTransforms) -> Tensor:
        """The bodies `skin` [m], shape (B, V, 3), pulled apart, in the same axes.

        `transforms` are those that they were posed with, leading shape (B, 24).
        """
        rotation = transforms.rotation
        part = self._part if is_plain(skin, rotation) else partial(part_with_gradient, self)
        if not len(skin):
            return torch.zeros_like(skin)
        return torch.stack([part(one, turn) for one, turn in zip(skin, rotation, strict=True)])

    @torch.no_grad()
    def _part(self, skin: Tensor, rotation: Tensor) -> Tensor:
        how, work, run = self.settings, self._tensors, self._run
        n = len(skin)
        work.skin.copy_(skin)
        work.here.copy_(skin)
        work.there.copy_(skin)
        work.rotation.copy_(rotation)
        work.ints.zero_()
        with torch_stream(self.device):
            run("between")
            run("stations")
            run("crease")
            at = self._smooth(work.here, work.there, how.smooth_first)
            self._touch(at)
            work.here.copy_(at)
            work.there.copy_(at)
            run("part", kernels.NEAR)
            at = self._smooth(work.here, work.there, how.smooth_last)
            which = "here" if at is work.here else "there"
            for _ in range(how.edge_rounds):
                run(f"edge {which}", kernels.HOT)
                run(f"follow {which}", kernels.ENDS)
        return at.clone()

    def _touch(self, at: Tensor) -> None:
        """Which segments each vertex has to give way to, for the points (V, 3) [m]."""
        work, run = self._tensors, self._run
        work.points[: len(at)] = at
        run("caps")
        work.low.fill_(torch.inf)
        work.high.fill_(-torch.inf)
        run("box")
        run("meet")
        run("near")
        wanted = int(work.counts[kernels.WANTED]) if self._is_serial else -1
        for k, tree in enumerate(self._trees):
            if (wanted >> k) & 1:
                tree.refit()
        run("touch", kernels.NEAR)
        for _ in range(self.settings.deepen_rounds):
            work.counts[kernels.FOUND] = 0
            run("deepen", kernels.NEAR)
            if self._is_serial and not work.counts[kernels.FOUND]:
                break

    def _smooth(self, source: Tensor, target: Tensor, sweeps: int) -> Tensor:
        self._run("share", kernels.MOVED)
        for i in range(sweeps):
            self._run("smooth" if i % 2 == 0 else "smooth back", kernels.MOVED)
            source, target = target, source
        return source

    def _run(self, name: str, which: int | None = None) -> None:
        """Launches a step: on a CPU for as many as its list has, on a GPU for as many as it could have."""
        command, most = self._commands[name]
        if which is not None and self._is_serial:
            n = int(self._tensors.counts[which])
            if n == 0:
                return
            command.set_dim(n)
        command.launch()

    def _record(self) -> dict[str, Any]:
        how, work, bones, segments, rings = self.settings, self._work, self._bones, self._segments, self._rings
        n, n_edges = len(work.skin), len(work.steps)
        commands = {}

        def record(name: str, kernel: Any, most: int, inputs: list[Any]) -> None:
            commands[name] = wp.launch(kernel, most, inputs, device=str(self.device), record_cmd=True), most

        record("between", kernels.between_kernel, len(PARENTS), [bones.rotation, *self._chain, bones.between])
        record("stations", kernels.mean_kernel, len(self._stations[-1]), [work.skin, *self._stations])
        inputs = [work, self._held, self._stations[-1], bones, self._seams, how.crease_rounds]
        record("crease", kernels.crease_kernel, len(self._held), inputs)
        record("share", kernels.share_kernel, n, [work, how.smooth_full, how.smooth_step])
        record("smooth", kernels.smooth_kernel, n, [work, rings, work.here, work.there])
        record("smooth back", kernels.smooth_kernel, n, [work, rings, work.there, work.here])
        record("caps", kernels.mean_kernel, len(self._caps[-1]), [work.points, *self._caps])
        record("box", kernels.box_kernel, n, [work.points, segments.own, segments.low, segments.high])
        record("meet", kernels.meet_kernel, len(self._trees), [segments, how.gap, work.meets])
        record("near", kernels.near_kernel, n, [work, segments])
        record("touch", kernels.touch_kernel, n, [work, segments])
        record("deepen", kernels.deepen_kernel, n, [work, segments, rings])
        record("part", kernels.part_kernel, n, [work, segments, bones, rings, how.part_rounds])
        for which, moved in (("here", work.here), ("there", work.there)):
            record(f"edge {which}", kernels.edge_kernel, n_edges, [work, moved, rings, segments, bones, how.steep])
            record(f"follow {which}", kernels.follow_kernel, n, [work, moved, rings])
        return commands

    def _bind_rings(self, mesh: Connectivity) -> Any:
        ring = mesh.ring
        low, high = np.minimum(ring.owner, ring.items), np.maximum(ring.owner, ring.items)
        keys = mesh.edges[:, 0].astype(np.int64) * mesh.n_vertices + mesh.edges[:, 1]
        rings = kernels.Rings()
        rings.start, rings.vertex = self._ints(ring.start), self._ints(ring.items)
        rings.edge = self._ints(np.searchsorted(keys, low * mesh.n_vertices + high))
        rings.ends = wp.array(mesh.edges, dtype=wp.vec2i, device=str(self.device))
        return rings

    def _bind_bones(self, rest: NDArray[np.float64], mesh: Connectivity, weights: NDArray[np.float64]) -> Any:
        vertex, joint = np.nonzero(weights)
        bones = kernels.Bones()
        work = self._tensors
        bones.rotation, bones.between = as_warp(work.rotation, wp.mat33), as_warp(work.between, wp.mat33)
        bones.start = self._ints(np.searchsorted(vertex, np.arange(len(rest) + 1)))
        bones.joint, bones.weight = self._ints(joint), self._floats(weights[vertex, joint])
        normals = _smooth_normals(rest, mesh)
        bones.normal = self._vectors(normals)
        self.normals, self.weights = torch.as_tensor(normals, device=self.device), torch.as_tensor(weights, device=self.device)
        self._chain = [self._ints([max(parent, 0) for parent in PARENTS]), self._floats(LEVELS)]
        return bones

    def _bind_seams(self, rest: NDArray[np.float64], mesh: Connectivity, weights: NDArray[np.float64]) -> Any:
        how = self.settings
        found = find_creases(rest, mesh.edges, weights, reach=how.crease_reach + FADE)
        beyond = np.clip(found.along - how.crease_reach, 0.0, None)
        held, first = np.unique(found.vertex, return_index=True)
        seams = kernels.Seams()
        seams.start = self._ints([*first, len(found.vertex)])
        seams.rotation = self._ints(found.rotation)
        seams.normal = self._vectors(found.normal)
        least = np.minimum(how.gap / 2, how.crease_share * found.height) - beyond
        seams.least = self._floats(least)
        self.creases, self.least = found, torch.as_tensor(least, device=self.device)
        seams.stations = wp.array(found.stations, dtype=kernels.Stations, device=str(self.device))
        seams.weights = wp.array(found.weights.astype(np.float32), dtype=kernels.StationWeights, device=str(self.device))
        n_stations = len(found.station_start) - 1
        stations = [
            self._ints(found.station_start),
            self._ints(found.station_vertex),
            self._floats(found.station_weight),
            wp.zeros(n_stations, dtype=wp.vec3, device=str(self.device)),
        ]
        return seams, self._ints(held), stations

    def _bind_segments(self, rest: NDArray[np.float64], mesh: Connectivity, weights: NDArray[np.float64]) -> Any:
        how, n, device = self.settings, len(rest), str(self.device)
        share = np.stack([weights[:, list(joints)].sum(axis=1) for joints, _ in SOFTNESS], axis=1)
        solids = cut(mesh.faces, share)
        n_segments, sizes = len(solids.faces), np.diff(solids.middle_start)
        work = self._tensors
        work.add_points(len(sizes), n_segments)
        work.points[:n] = torch.as_tensor(rest)
        points = as_warp(work.points, wp.vec3)
        self._caps = [
            self._ints(solids.middle_start),
            self._ints(solids.middle_vertex),
            self._floats(np.repeat(1 / np.maximum(sizes, 1), sizes)),
            points[n:],
        ]
        if len(sizes):
            wp.launch(kernels.mean_kernel, len(sizes), [points, *self._caps], device=device)
        self._trees = [wp.Mesh(points, self._ints(faces.ravel())) for faces in solids.faces]
        segments = kernels.Segments()
        segments.trees = wp.array([tree.id for tree in self._trees], dtype=wp.uint64, device=device)
        segments.own = self._ints(solids.of_vertex)
        segments.low, segments.high = as_warp(work.low, wp.vec3), as_warp(work.high, wp.vec3)
        segments.faces = wp.array(np.concatenate(solids.faces), dtype=wp.vec3i, device=device)
        segments.first_face = self._ints(np.cumsum([0, *map(len, solids.faces)]))
        softness = np.array([one for _, one in SOFTNESS])
        segments.ratio = self._floats(softness[None] / softness[:, None])
        clearance = wp.zeros((n, n_segments), dtype=wp.float32, device=device)
        segments.gap = clearance
        wp.launch(kernels.clearance_kernel, (n, n_segments), [points, segments, clearance], device=device)
        segments.gap = self._floats(np.minimum(how.gap, how.segment_share * clearance.numpy()))
        self.own, self.faces = torch.as_tensor(solids.of_vertex).long().to(self.device), torch.as_tensor(np.concatenate(solids.faces)).long().to(self.device)
        self.kept, self.ratio = wp.to_torch(segments.gap), wp.to_torch(segments.ratio)
        self.edges = torch.as_tensor(mesh.edges).long().to(self.device)
        self._work = work.bound()
        return segments

    @torch.no_grad()
    def touched(self, skin: Tensor) -> Tensor:
        """Which segments each vertex of `skin` (V, 3) [m] has to give way to, bool, shape (V, K)."""
        self._tensors.ints.zero_()
        with torch_stream(self.device):
            self._touch(skin.float())
        bits = wp.to_torch(self._work.touched)
        return ((bits[:, None] >> torch.arange(len(self._trees), device=bits.device)) & 1).bool()

    @torch.no_grad()
    def closest(self, points: Tensor, segment: Tensor) -> Closest:
        """What points (N, 3) [m] are closest to of a segment each (N,), in the pose that `touched` was asked for."""
        n = len(points)
        face = torch.zeros(n, dtype=torch.int32, device=self.device)
        weights, sign = torch.zeros(n, 3, device=self.device), torch.zeros(n, device=self.device)
        inputs = [as_warp(points.float().contiguous(), wp.vec3), as_warp(segment.int(), wp.int32), self._segments]
        outputs = [as_warp(face, wp.int32), as_warp(weights, wp.vec3), as_warp(sign, wp.float32)]
        if n:
            with torch_stream(self.device):
                wp.launch(kernels.closest_kernel, n, inputs, outputs, device=str(self.device))
        return Closest(face.long(), weights, sign)

    def with_caps(self, skin: Tensor) -> Tensor:
        """`skin` (V, 3) [m] and the middles of the caps after it. Differentiable."""
        start, vertex, weight, _ = (wp.to_torch(one) for one in self._caps)
        of_middle = torch.repeat_interleave(torch.arange(len(start) - 1, device=skin.device), start.long().diff())
        middles = skin.new_zeros(len(start) - 1, 3)
        return torch.cat((skin, middles.index_add(0, of_middle, skin[vertex.long()] * weight.to(skin)[:, None])))

    def _ints(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=str(self.device))

    def _floats(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.float32, device=str(self.device))

    def _vectors(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=str(self.device))


class _Tensors:
    """The memory of `kernels.Work`, as torch sees it."""

    def __init__(self, n_vertices: int, n_edges: int, device: torch.device) -> None:
        self._device, self._sizes = device, (n_vertices, n_edges)
        self.skin, self.here, self.there = (torch.zeros(n_vertices, 3, device=device) for _ in range(3))
        self.rotation = torch.zeros(len(PARENTS), 3, 3, device=device)
        self.between = torch.zeros(len(PARENTS) * len(LEVELS), 3, 3, device=device)
        # What every call begins with as zeros.
        self.ints = torch.zeros(2 * n_vertices + kernels.N_COUNTS, dtype=torch.int32, device=device)
        self.counts = self.ints[2 * n_vertices :]

    def add_points(self, n_middles: int, n_segments: int) -> None:
        """Makes what depends on how the body is cut."""
        self.points = torch.zeros(self._sizes[0] + n_middles, 3, device=self._device)
        self.low, self.high = (torch.zeros(n_segments, 3, device=self._device) for _ in range(2))

    def bound(self) -> Any:
        """As the kernels take it."""
        n, n_edges = self._sizes
        work = kernels.Work()
        for name in ("skin", "points", "here", "there"):
            setattr(work, name, as_warp(getattr(self, name), wp.vec3))
        for name in ("moved", "near", "boxed", "ends", "touched", "outside"):
            setattr(work, name, wp.zeros(n, dtype=wp.int32, device=str(self._device)))
        work.share = wp.zeros(n, dtype=wp.float32, device=str(self._device))
        work.hot = wp.zeros(n_edges, dtype=wp.int32, device=str(self._device))
        work.steps = wp.zeros(n_edges, dtype=wp.vec3, device=str(self._device))
        work.meets = wp.zeros(len(self.low), dtype=wp.int32, device=str(self._device))
        work.is_moved, work.is_end = as_warp(self.ints[:n], wp.int32), as_warp(self.ints[n : 2 * n], wp.int32)
        work.counts = as_warp(self.counts, wp.int32)
        return work


def _smooth_normals(vertices: NDArray[np.float64], mesh: Connectivity) -> NDArray[np.float64]:
    """Unit normals at the vertices (V, 3) [m], levelled over two rings."""
    a, b, c = vertices[mesh.faces].transpose(1, 0, 2)
    normals = np.zeros_like(vertices)
    np.add.at(normals, mesh.faces, np.cross(b - a, c - a)[:, None])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    ring = mesh.ring
    for _ in range(2):
        means = np.zeros_like(normals)
        np.add.at(means, ring.owner, normals[ring.items])
        normals = 0.5 * (normals + means / np.diff(ring.start)[:, None])
    unit: NDArray[np.float64] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return unit
