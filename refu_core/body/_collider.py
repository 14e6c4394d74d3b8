"""A posed body that doesn't run through itself: the repulsive force unit, applied to the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from refu_core._warp import argument, as_warp, is_plain, torch_stream
from refu_core.body import _collider_kernels as kernels
from refu_core.body._creases import LEVELS, find_creases
from refu_core.body._kinematics import PARENTS, RigidTransforms
from refu_core.body._model import SmplBody
from refu_core.body._segments import SOFTNESS, cut
from refu_core.mesh import Connectivity

DEFAULT_GAP = 0.012
"""Room that is left between two parts of a body [m]: two layers of cloth, each 4 mm off the skin, and some to spare."""


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
        rest = body.v_template.double().cpu().numpy()
        weights = body.weights.double().cpu().numpy()
        mesh = Connectivity.of(body.faces.cpu(), len(rest))
        mesh.require_closed()
        self._n_vertices, self._n_edges = len(rest), len(mesh.edges)
        self._ring = [self._ints(mesh.ring.start), self._ints(mesh.ring.items)]
        ends = mesh.edges.ravel()
        by_vertex = np.argsort(ends, kind="stable")
        self._edges = wp.array(mesh.edges, dtype=wp.vec2i, device=str(self.device))
        self._edges_of = [
            self._ints(np.searchsorted(ends[by_vertex], np.arange(len(rest) + 1))),
            self._ints(by_vertex // 2),
        ]
        self._seams, self._stations = self._bind_seams(rest, mesh, weights)
        self._bones = self._bind_bones(rest, mesh, weights)
        self._segments, self._caps = self._bind_segments(body, mesh, weights)

    def __call__(self, skin: Tensor, transforms: RigidTransforms) -> Tensor:
        """The bodies `skin` [m], shape (B, V, 3), pulled apart, in the same axes.

        `transforms` are those that they were posed with, leading shape (B, 24).
        """
        return torch.stack([self._part(one, turn) for one, turn in zip(skin, transforms.rotation, strict=True)])

    @torch.no_grad()
    def _part(self, skin: Tensor, rotation: Tensor) -> Tensor:
        how, n = self.settings, self._n_vertices
        self._skin.copy_(skin)
        self._rotation.copy_(rotation)
        with torch_stream(self.device):
            self._crease()
            if self.device.type == "cpu" and not self._moved[0]:
                self._points[:n] = self._skin
            self._launch(kernels.mean_kernel, len(self._points) - n, [self._points_wp, *self._caps], [self._points_wp[n:]])
            self._low.fill_(torch.inf)
            self._high.fill_(-torch.inf)
            segments, bones = self._segments, self._bones
            self._launch(kernels.box_kernel, n, [self._points_wp, segments.own], [segments.low, segments.high])
            for tree in self._trees:
                tree.refit()
            touched, outside = self._touched
            self._launch(kernels.touch_kernel, n, [self._points_wp, segments, how.gap], [touched, outside])
            for _ in range(how.deepen_rounds):
                self._launch(kernels.deepen_kernel, n, [self._points_wp, segments, *self._ring], [touched, outside])
            a, b = self._buffers_wp
            self._launch(kernels.part_kernel, n, [self._points_wp, touched, segments, bones, how.part_rounds], [a])
            a, b = self._smooth(a, b, how.smooth_last)
            for _ in range(how.edge_rounds):
                inputs = [self._points_wp, self._edges, touched, a, how.steep, segments, bones]
                self._launch(kernels.edge_kernel, self._n_edges, inputs, [self._steps])
                self._launch(kernels.follow_kernel, n, [*self._edges_of, self._steps], [a])
        return self._buffers[0 if a is self._buffers_wp[0] else 1].clone()

    def _crease(self) -> None:
        how, n = self.settings, self._n_vertices
        bones = self._bones
        self._moved.zero_()
        self._launch(kernels.between_kernel, len(PARENTS), [bones.rotation, self._parent, self._levels], [bones.between])
        self._launch(kernels.mean_kernel, len(self._station), [self._skin_wp, *self._stations], [self._station_wp])
        a, b = self._buffers_wp
        inputs = [self._skin_wp, self._station_wp, bones, self._seams, how.crease_rounds]
        self._launch(kernels.crease_kernel, n, inputs, [a, self._moved_wp])
        a, b = self._smooth(a, b, how.smooth_first)
        self._points[:n] = self._buffers[0 if a is self._buffers_wp[0] else 1]

    def _smooth(self, a: Any, b: Any, sweeps: int) -> tuple[Any, Any]:
        how, n = self.settings, self._n_vertices
        wp.copy(self._at_wp, a)
        for _ in range(sweeps):
            inputs = [self._skin_wp, self._at_wp, *self._ring, how.smooth_full, how.smooth_step, a]
            self._launch(kernels.smooth_kernel, n, inputs, [b])
            a, b = b, a
        return a, b

    def _launch(self, kernel: Any, n: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, n, inputs, outputs, device=str(self.device))

    def _bind_seams(self, rest: NDArray[np.float64], mesh: Connectivity, weights: NDArray[np.float64]) -> Any:
        how = self.settings
        found = find_creases(rest, mesh.edges, weights, reach=how.crease_reach + 0.035)
        beyond = np.clip(found.along - how.crease_reach, 0.0, None)
        seams = kernels.Seams()
        seams.start = self._ints(np.searchsorted(found.vertex, np.arange(len(rest) + 1)))
        seams.rotation = self._ints(found.rotation)
        seams.normal = self._vectors(found.normal)
        seams.least = self._floats(np.minimum(how.gap / 2, how.crease_share * found.height) - beyond)
        seams.stations = wp.array(found.stations, dtype=kernels.Stations, device=str(self.device))
        seams.weights = wp.array(found.weights.astype(np.float32), dtype=kernels.StationWeights, device=str(self.device))
        n_stations = len(found.station_start) - 1
        self._station = torch.zeros(n_stations, 3, device=self.device)
        self._station_wp = as_warp(self._station, wp.vec3)
        self._parent = self._ints([max(parent, 0) for parent in PARENTS])
        self._levels = self._floats(LEVELS)
        self._moved = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._moved_wp = as_warp(self._moved, wp.int32)
        stations = [self._ints(found.station_start), self._ints(found.station_vertex), self._floats(found.station_weight)]
        return seams, stations

    def _bind_bones(self, rest: NDArray[np.float64], mesh: Connectivity, weights: NDArray[np.float64]) -> Any:
        n = len(rest)
        self._buffers = [torch.zeros(n, 3, device=self.device) for _ in range(2)]
        self._buffers_wp = [as_warp(one, wp.vec3) for one in self._buffers]
        self._skin, self._at = (torch.zeros(n, 3, device=self.device) for _ in range(2))
        self._skin_wp, self._at_wp = as_warp(self._skin, wp.vec3), as_warp(self._at, wp.vec3)
        self._rotation = torch.zeros(len(PARENTS), 3, 3, device=self.device)
        self._between = torch.zeros(len(PARENTS) * len(LEVELS), 3, 3, device=self.device)
        self._steps = wp.zeros(self._n_edges, dtype=wp.vec3, device=str(self.device))
        self._touched = [wp.zeros(n, dtype=wp.int32, device=str(self.device)) for _ in range(2)]
        vertex, joint = np.nonzero(weights)
        bones = kernels.Bones()
        bones.rotation, bones.between = as_warp(self._rotation, wp.mat33), as_warp(self._between, wp.mat33)
        bones.start = self._ints(np.searchsorted(vertex, np.arange(n + 1)))
        bones.joint, bones.weight = self._ints(joint), self._floats(weights[vertex, joint])
        bones.normal = self._vectors(_smooth_normals(rest, mesh))
        return bones

    def _bind_segments(self, body: SmplBody, mesh: Connectivity, weights: NDArray[np.float64]) -> Any:
        how, n, device = self.settings, self._n_vertices, str(self.device)
        share = np.stack([weights[:, list(joints)].sum(axis=1) for joints, _ in SOFTNESS], axis=1)
        solids = cut(mesh.faces, share)
        sizes = np.diff(solids.middle_start)
        caps = [self._ints(solids.middle_start), self._ints(solids.middle_vertex), self._floats(np.repeat(1 / sizes, sizes))]
        n_segments = len(solids.faces)
        self._points = torch.zeros(n + len(sizes), 3, device=self.device)
        self._points[:n] = body.v_template
        self._points_wp = as_warp(self._points, wp.vec3)
        self._launch(kernels.mean_kernel, len(sizes), [self._points_wp, *caps], [self._points_wp[n:]])
        self._trees = [wp.Mesh(self._points_wp, self._ints(faces.ravel())) for faces in solids.faces]
        self._low, self._high = (torch.zeros(n_segments, 3, device=self.device) for _ in range(2))
        segments = kernels.Segments()
        segments.trees = wp.array([tree.id for tree in self._trees], dtype=wp.uint64, device=device)
        segments.own = self._ints(solids.of_vertex)
        segments.low, segments.high = as_warp(self._low, wp.vec3), as_warp(self._high, wp.vec3)
        segments.faces = wp.array(np.concatenate(solids.faces), dtype=wp.vec3i, device=device)
        segments.first_face = self._ints(np.cumsum([0, *map(len, solids.faces)]))
        softness = np.array([one for _, one in SOFTNESS])
        segments.ratio = self._floats(softness[None] / softness[:, None])
        clearance = wp.zeros((n, n_segments), dtype=wp.float32, device=device)
        segments.gap = clearance
        wp.launch(kernels.clearance_kernel, (n, n_segments), [self._points_wp, segments], [clearance], device=device)
        segments.gap = self._floats(np.minimum(how.gap, how.segment_share * clearance.numpy()))
        return segments, caps

    def _ints(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=str(self.device))

    def _floats(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.float32, device=str(self.device))

    def _vectors(self, values: ArrayLike) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=str(self.device))


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
