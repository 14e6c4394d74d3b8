"""What `Collider` knows of a body, prepared once from its file, in the forms that kernels and torch code take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray

from refu_core._cache import remembered
from refu_core._warp import Repeated, as_torch, as_warp, ints, memory, readable
from refu_core.body import _collider_kernels as kernels
from refu_core.body import _part_kernels as parting
from refu_core.body._aside import Aside
from refu_core.body._bundles import bundled
from refu_core.body._creases import LEVELS, find_creases
from refu_core.body._model import SmplBody
from refu_core.body._segments import SOFTNESS, Solids, cut, shares
from refu_core.body._skinning import JointWeights
from refu_core.mesh import Connectivity, vertex_normals
from refu_core.skeleton import CARRIED, PARENTS

DEFAULT_GAP = 0.012
"""Room between two parts of a body [m]: for two layers of cloth, each 4 mm off the skin, and some to spare."""

FADE = 0.035
"""Skin farther beyond a crease's reach than this isn't held [m]: out there the kept height falls by 1 m per metre."""


@dataclass(frozen=True, kw_only=True)
class ColliderSettings:
    """How a body is pulled apart. `benchmarks/sensitivity.py` measures what halving and doubling each number does."""

    gap: float = DEFAULT_GAP
    """Room that is left between two parts [m]."""
    crease_share: float = 0.5
    """Share of its rest-pose height over a seam that skin keeps, at most half of the gap: nothing moves until a fold
    has squeezed skin to half of that height."""
    crease_reach: float = 0.045
    """Skin up to this far from a seam is kept on its side [m], and skin beyond that less and less. Farther out segments
    are parted by their distance instead: each gives way by its half, which a plane doesn't provide for."""
    segment_share: float = 0.6
    """Share of its rest-pose distance from another segment that skin keeps, at most the gap: at a joint segments are
    0 apart. Half this value leaves 97 % of recorded frames free of intersections, instead of 99 %."""
    farthest: float = 0.035
    """No skin gives way by more than this [m]. Parts that overlap by more than twice as much still overlap afterwards:
    flesh doesn't give way to a pose that no body can take."""
    thin: float = 0.4
    """Nor by more than this share of the thickness below it: a finger gives way by millimetres, and isn't inverted."""
    aside_farthest: float = 0.14
    """No arm moves aside by more than this [m]. Recorded people take half of it. With noise of 8° on each coordinate
    of a joint, as of a poor pose estimate, 93 % of colliders are free; with 70 mm 82 %, with 280 mm no more."""
    aside_rounds: int = 4
    """Newton steps that bring an arm out of the body, or out of the other one. With two, 86 % are free, not 93."""
    crease_rounds: int = 3
    """How often skin is brought to its side of the seams: at the groin several of them meet. With two rounds faces
    of a sitting male body cut each other there."""
    part_rounds: int = 4
    """Newton steps to the surface between two segments."""
    deepen_rounds: int = 8
    """How far inside another segment skin is looked for [edges], starting from skin within the gap of its surface."""
    smooth_first: int = 3
    """Smoothing sweeps over creases, before segments are parted."""
    smooth_last: int = 1
    """Smoothing sweeps over all skin that was moved, and what is next to it, after that."""
    smooth_full: float = 0.004
    """Skin that was moved this far, or is next to such skin, is levelled in full [m]; less of a move levels it less."""
    smooth_step: float = 0.5
    """Share of the way to the mean of its neighbours that a sweep moves a vertex."""
    edge_rounds: int = 2
    """How often the midpoints of edges are pushed out: a triangle cuts the corner between its vertices."""
    steep: float = 0.004
    """Edges whose ends' moves differ by more than this are pushed out [m], in full from twice that on."""


class Anatomy:
    """The rings, bones, seams and segments of a body of V vertices and K segments, and memory to part them in."""

    def __init__(self, body: SmplBody, settings: ColliderSettings) -> None:
        """Raises `MeshError` for a body that isn't a closed, consistently oriented surface."""
        self.settings, self.device = settings, body.device
        rest = body.v_template.double().cpu().numpy()
        weights = body.weights.double().cpu().numpy()
        mesh = Connectivity.of(body.faces.cpu(), len(rest))
        mesh.require_closed()
        self.mesh = mesh
        """The connectivity of the body's mesh."""
        self.edges = torch.as_tensor(mesh.edges.astype(np.int64), device=self.device)
        """Shape (E, 2)."""
        self.weights = torch.as_tensor(weights, device=self.device)
        """Skinning weights, shape (V, 24)."""
        solids = cut(mesh.faces, shares(weights))
        n_middles = len(solids.middle_start) - 1
        self.memory = Memory(len(rest), n_middles, len(mesh.edges), settings.deepen_rounds, self.device)
        self.rings = self._bind_rings(mesh)
        self.bones = self._bind_bones(rest, mesh, weights)
        self.seams = self._bind_seams(body)
        self.segments = self._bind_segments(rest, solids, weights)
        thickness = _thickness(rest, mesh, solids.of_vertex, str(self.device))
        self.thickness = torch.as_tensor(thickness, device=self.device)
        """How far it is through the body from each vertex [m], shape (V,)."""
        self.farthest = self.thickness.mul(settings.thin).clamp(max=settings.farthest)
        """How far skin may be moved [m], shape (V,)."""
        self.aside = Aside(body, mesh, farthest=settings.aside_farthest, rounds=settings.aside_rounds)
        """Brings arms out of the rest of the body."""
        self.work = self.memory.work
        self.work.farthest = as_warp(self.farthest, wp.float32)

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
        bones = kernels.Bones()
        device, n = str(self.device), len(PARENTS)
        bones.rotation = as_warp(self.memory.rotation, wp.mat33)
        bones.between = wp.zeros(n * len(LEVELS), dtype=wp.mat33, device=device)
        bones.bent = wp.zeros(n, dtype=wp.float32, device=device)
        start, joint, weight = JointWeights.of(torch.as_tensor(weights))
        bones.start, bones.joint, bones.weight = self._ints(start), self._ints(joint), self._floats(weight)
        normals = _smooth_normals(rest, mesh)
        bones.normal = self._vectors(normals)
        self.normals = torch.as_tensor(normals, device=self.device)
        """Unit normals of the skin in the rest pose, levelled, shape (V, 3)."""
        bones.parent, bones.levels = self._ints([max(parent, 0) for parent in PARENTS]), self._floats(LEVELS)
        return bones

    def _bind_seams(self, body: SmplBody) -> Any:
        how = self.settings
        found = find_creases(body, how.crease_reach + FADE)
        beyond = np.clip(found.along - how.crease_reach, 0.0, None)
        held, first = np.unique(found.vertex, return_index=True)
        seams = kernels.Seams()
        seams.start = self._ints([*first, len(found.vertex)])
        seams.rotation = self._ints(found.rotation)
        seams.normal = self._vectors(found.normal)
        least = np.minimum(how.gap / 2, how.crease_share * found.height) - beyond
        seams.least = self._floats(least)
        self.creases, self.least = found, torch.as_tensor(least, device=self.device)
        """Which skin each seam holds, and the height over its plane that is kept [m], shape (R,)."""
        seams.stations = wp.array(found.stations.astype(np.int32), dtype=kernels.Stations, device=str(self.device))
        seams.weights = wp.array(
            found.weights.astype(np.float32), dtype=kernels.StationWeights, device=str(self.device)
        )
        seams.vertex = self._ints(held)
        self.stations = kernels.Means()
        self.stations.start, self.stations.vertex = self._ints(found.station_start), self._ints(found.station_vertex)
        self.stations.weight = self._floats(found.station_weight)
        self.stations.mean = wp.zeros(len(found.station_start) - 1, dtype=wp.vec3, device=str(self.device))
        return seams

    def _bind_segments(self, rest: NDArray[np.float64], solids: Solids, weights: NDArray[np.float64]) -> Any:
        how, n, device = self.settings, len(rest), str(self.device)
        n_segments, sizes = len(solids.faces), np.diff(solids.middle_start)
        self.memory.points[:n] = torch.as_tensor(rest)
        points = as_warp(self.memory.points, wp.vec3)
        self.caps = kernels.Means()
        self.caps.start, self.caps.vertex = self._ints(solids.middle_start), self._ints(solids.middle_vertex)
        self.caps.weight, self.caps.mean = self._floats(np.repeat(1 / np.maximum(sizes, 1), sizes)), points[n:]
        if len(sizes):
            wp.launch(kernels.mean_kernel, len(sizes), [points, self.caps], device=device)
        self.trees = [wp.Mesh(points, self._ints(faces.ravel())) for faces in solids.faces]
        segments = parting.Segments()
        segments.trees = wp.array([tree.id for tree in self.trees], dtype=wp.uint64, device=device)
        segments.own = self._ints(solids.of_vertex)
        faces = np.concatenate(solids.faces)
        segments.faces = wp.array(faces, dtype=wp.vec3i, device=device)
        segments.first_face = self._ints(np.cumsum([0, *map(len, solids.faces)]))
        softness = np.array([one for _, one in SOFTNESS])
        segments.ratio = self._floats(softness[None] / softness[:, None])
        segments.path = self._ints(_paths(weights, solids.of_vertex))
        clearance = wp.zeros((n, n_segments), dtype=wp.float32, device=device)
        segments.gap = clearance
        most = how.gap / max(how.segment_share, 1e-3)  # skin farther away keeps the whole gap
        wp.launch(parting.clearance_kernel, (n, n_segments), [most, points, segments, clearance], device=device)
        segments.gap = self._floats(np.minimum(how.gap, how.segment_share * clearance.numpy()))
        kinds = (wp.vec3, wp.int32, wp.int32, wp.vec3, wp.float32)
        self.ask_closest = Repeated(parting.closest_kernel, kinds, [segments])
        """Finds points' closest faces, and their sides of these, in the pose that the trees were fitted to last."""
        self.bundles = bundled(points.numpy(), solids.faces, self.device)
        self.skins = self._bind_skins(segments.gap.numpy())
        self.own = torch.as_tensor(solids.of_vertex.astype(np.int64), device=self.device)
        """The segment of each vertex, shape (V,)."""
        self.faces = torch.as_tensor(faces.astype(np.int64), device=self.device)
        """Faces of all segments, one after another, indexing vertices and the middles of caps, shape (F, 3)."""
        self.kept, self.ratio = as_torch(segments.gap), as_torch(segments.ratio)
        """What vertices keep from segments [m], shape (V, K), and how many times as soft k is as i, shape (K, K)."""
        return segments

    def _bind_skins(self, gap: NDArray[np.float32]) -> Any:
        """Shares vertices out among bundles, each to the first one that has it; `gap` (V, K) is what they keep [m].

        A thread takes one piece: on a CPU all vertices of a bundle, on a GPU a single vertex.
        """
        start, corner = self.bundles.start.numpy(), self.bundles.corner.numpy()
        is_free = np.ones(len(gap), np.bool_)
        own: list[NDArray[np.int32]] = []
        bundle: list[int] = []
        for i, vertices in enumerate(np.split(corner, start[1:-1])):
            some = vertices[vertices < len(gap)]
            some = some[is_free[some]]
            is_free[some] = False
            n_pieces = max(len(some), 1) if self.device.type == "cuda" else 1
            own += np.split(some, n_pieces)
            bundle += [i] * n_pieces
        skins = parting.Skins()
        skins.start, skins.vertex = self._ints(np.cumsum([0, *map(len, own)])), self._ints(np.concatenate(own))
        first = self.bundles.first.numpy()
        skins.bundle = self._ints(bundle)
        skins.of = self._ints(np.repeat(np.arange(len(first) - 1), np.diff(first))[bundle])
        skins.gap = self._floats(np.stack([gap[some].max(axis=0, initial=0.0) for some in own]))
        return skins

    def _ints(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=str(self.device))

    def _floats(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.float32, device=str(self.device))

    def _vectors(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=str(self.device))


class Memory:
    """The memory that a call works in: as torch tensors and, in `work`, as kernels take it."""

    def __init__(self, n_vertices: int, n_middles: int, n_edges: int, n_rounds: int, device: torch.device) -> None:
        self.rotation = memory(len(PARENTS), 3, 3, device=device)
        self.places = memory(4, n_vertices + n_middles, 3, device=device)
        self.skin, self.here, self.there = self.places[:3, :n_vertices].unbind()
        self.points = self.places[3]
        by_vertex = ("is_moved", "is_end", "is_front", "touched", "outside")
        n_ints = len(by_vertex) * n_vertices
        self.ints = memory(n_ints + kernels.FRONT + n_rounds + 1, dtype=torch.int32, device=device)
        """All that is set to zero at the start of every call."""
        self.counts = self.ints[n_ints:]
        self.read_counts = readable(self.counts)
        self.work = work = kernels.Work()
        for name in ("skin", "points", "here", "there"):
            setattr(work, name, as_warp(getattr(self, name), wp.vec3))
        for name, numbers in zip(by_vertex, self.ints[:n_ints].view(len(by_vertex), -1), strict=True):
            setattr(work, name, as_warp(numbers, wp.int32))
        work.counts = as_warp(self.counts, wp.int32)
        for name in ("moved", "near", "boxed", "ends", "touching"):
            setattr(work, name, wp.zeros(n_vertices, dtype=wp.int32, device=str(device)))
        work.front = wp.zeros((n_rounds + 1, n_vertices), dtype=wp.int32, device=str(device))
        work.around, work.reach = (wp.zeros(n_vertices, dtype=wp.float32, device=str(device)) for _ in range(2))
        work.parted = wp.zeros(n_vertices, dtype=wp.vec3, device=str(device))
        work.hot = wp.zeros(n_edges, dtype=wp.int32, device=str(device))
        work.steps = wp.zeros(n_edges, dtype=wp.vec3, device=str(device))

    def take(self, skin: torch.Tensor) -> None:
        """Copies a posed body (V, 3) [m] in."""
        self.places[:, : len(self.skin)] = skin


def _paths(weights: NDArray[np.float64], of_vertex: NDArray[np.int32]) -> NDArray[np.int32]:
    """The joints, as bits, that move any skin of segment i against any of segment k, shape (K, K).

    From skinning weights (V, 24) and the segment of each vertex.
    """
    # For each joint the bits of itself and its ancestors, without the root, which moves everything.
    above = CARRIED[:, 1:].astype(np.int64) @ (1 << np.arange(1, len(PARENTS)))
    move = [above[(weights[of_vertex == k] > 0).any(axis=0)] for k in range(len(SOFTNESS))]
    return np.array(
        [[np.bitwise_or.reduce(one[:, None] ^ other, axis=None) for other in move] for one in move], np.int32
    )


@remembered(4)
def _smooth_normals(vertices: NDArray[np.float64], mesh: Connectivity) -> NDArray[np.float64]:
    """Unit normals at the vertices (V, 3) [m], levelled over two rings."""
    normals, around = vertex_normals(vertices, mesh.faces), mesh.adjacency_matrix()
    for _ in range(2):
        normals = 0.5 * (normals + around @ normals / np.diff(mesh.ring.start)[:, None])
    unit: NDArray[np.float64] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return unit


def _meets() -> NDArray[np.int32]:
    """Whether segment i ends where segment k begins, or the other way round, or is it (1 or 0), shape (K, K)."""
    of_joint = {joint: k for k, (joints, _) in enumerate(SOFTNESS) for joint in joints}
    meets = np.eye(len(SOFTNESS), dtype=np.int32)
    for joint, above in enumerate(PARENTS[1:], start=1):
        meets[of_joint[joint], of_joint[above]] = meets[of_joint[above], of_joint[joint]] = 1
    return meets


@remembered(4)
def _thickness(
    rest: NDArray[np.float64], mesh: Connectivity, of_vertex: NDArray[np.int32], device: str
) -> NDArray[np.float32]:
    """Distance to the skin on the other side [m], the least over each vertex and its neighbours, shape (V,)."""
    points, normals = (
        wp.array(one.astype(np.float32), dtype=wp.vec3, device=device) for one in (rest, _smooth_normals(rest, mesh))
    )
    body = wp.Mesh(points, ints(mesh.faces.ravel(), device))
    of = [wp.array(one, dtype=wp.int32, device=device) for one in (mesh.faces, of_vertex, _meets())]
    across = wp.zeros(len(rest), dtype=wp.float32, device=device)
    wp.launch(parting.thickness_kernel, len(rest), [body.id, points, normals, *of, across], device=device)
    found = across.numpy()
    least: NDArray[np.float32] = found.copy()
    np.minimum.at(least, mesh.ring.owner, found[mesh.ring.items])
    return least
