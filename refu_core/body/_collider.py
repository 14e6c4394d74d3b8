"""A body that doesn't run through itself: the repulsive force unit, applied to the body."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import argument, as_warp, torch_stream
from refu_core.body import _collider_kernels as kernels
from refu_core.body._creases import find_creases
from refu_core.body._kinematics import PARENTS, RigidTransforms
from refu_core.body._model import SmplBody
from refu_core.body._segments import cut
from refu_core.mesh import Connectivity

DEFAULT_GAP = 0.012
"""Room that is left between two parts of a body [m]: two layers of cloth, each 4 mm off the skin, and some to spare."""
SOFTNESS = (
    ((0, 3, 6, 9, 13, 14), 1.0),
    ((12, 15), 0.5),
    ((16,), 1.0),
    ((17,), 1.0),
    ((18,), 0.7),
    ((19,), 0.7),
    ((20, 22), 0.25),
    ((21, 23), 0.25),
    ((1,), 1.0),
    ((2,), 1.0),
    ((4,), 0.7),
    ((5,), 0.7),
    ((7, 10), 0.25),
    ((8, 11), 0.25),
)
P = dict(rho_c=0.25, d0=0.045, slope=1.0, reach=0.08, rho=0.3, n1=3, n2=2, scale=0.004, lam=0.5, rounds=4, crounds=2)


class Collider:
    def __init__(self, body: SmplBody, *, gap: float = DEFAULT_GAP, **kw) -> None:
        P = dict(globals()["P"], **kw)
        self.P = P
        device = str(body.device)
        self._body, self.gap = body, gap
        rest = body.v_template.cpu().double().numpy()
        mesh = Connectivity.of(body.faces.cpu(), len(rest))
        weights = body.weights.cpu().double().numpy()
        creases = find_creases(rest, mesh.edges, weights, reach=P["reach"])
        solids = cut(mesh.faces, np.stack([weights[:, list(j)].sum(1) for j, _ in SOFTNESS], 1))

        def ints(a):
            return wp.array(np.ascontiguousarray(a, np.int32), dtype=wp.int32, device=device)

        def floats(a):
            return wp.array(np.ascontiguousarray(a, np.float32), dtype=wp.float32, device=device)

        def vectors(a):
            return wp.array(np.ascontiguousarray(a, np.float32), dtype=wp.vec3, device=device)

        n = self._n = len(rest)
        self._parent = ints(PARENTS)
        self._station = [ints(creases.station_start), ints(creases.station_vertex), floats(creases.station_weight)]
        self._n_stations = len(creases.station_start) - 1
        f = self._folds = kernels.Folds()
        f.start = ints(np.searchsorted(creases.vertex, np.arange(n + 1)))
        f.joint, f.side, f.normal = ints(creases.joint), floats(creases.side), vectors(creases.normal)
        least = np.minimum(gap / 2, P["rho_c"] * creases.height) - P["slope"] * np.clip(creases.along - P["d0"], 0, None)
        f.least = floats(least)
        f.stations, f.weights = ints(creases.stations), floats(creases.weights)
        skel = self._skeleton = kernels.Skeleton()
        s = body._skinning
        self._csr = (s._start, s._joint, s._weight)
        skel.start, skel.joint, skel.weight = as_warp(s._start, wp.int32), as_warp(s._joint, wp.int32), as_warp(s._weight, wp.float32)
        normal = _vertex_normals(rest, mesh.faces)
        ring = mesh.ring
        for _ in range(2):
            normal = 0.5 * normal + 0.5 * np.stack([np.bincount(ring.owner, normal[ring.items, c], n) for c in range(3)], 1) / np.diff(ring.start)[:, None]
        skel.normal = vectors(normal / np.linalg.norm(normal, axis=1, keepdims=True))
        self._ring = [ints(ring.start), ints(ring.items)]
        self._middle = [ints(solids.middle_start), ints(solids.middle_vertex), floats(np.repeat(1 / np.diff(solids.middle_start), np.diff(solids.middle_start)))]
        m = self._m = len(solids.middle_start) - 1
        K = len(solids.faces)
        self._points = torch.zeros(n + m, 3, device=body.device)
        self._points[:n] = body.v_template
        self._points_wp = as_warp(self._points, wp.vec3)
        wp.launch(kernels.mean_kernel, m, [self._points_wp, *self._middle], [self._points_wp[n:]], device=device)
        self._meshes = [wp.Mesh(self._points_wp, ints(g.ravel()), support_winding_number=True) for g in solids.faces]
        bd = self._bodies = kernels.Bodies()
        bd.of_vertex = ints(solids.of_vertex)
        bd.trees = wp.array([g.id for g in self._meshes], dtype=wp.uint64, device=device)
        bd.faces = wp.array(np.concatenate(solids.faces), dtype=wp.vec3i, device=device)
        bd.first_face = ints(np.cumsum([0, *map(len, solids.faces)]))
        self._low, self._high = torch.zeros(K, 3), torch.zeros(K, 3)
        bd.low, bd.high = as_warp(self._low, wp.vec3), as_warp(self._high, wp.vec3)
        soft = np.array([c for _, c in SOFTNESS])
        bd.ratio = floats(soft[None] / soft[:, None])
        clear = wp.empty((n, K), dtype=wp.float32)
        wp.launch(clearance_kernel, (n, K), [self._points_wp, bd.of_vertex, bd.trees], [clear])
        bd.gap = floats(np.minimum(gap, P["rho"] * clear.numpy()))
        self._moved = torch.zeros(1, dtype=torch.int32)

    def __call__(self, skin: Tensor, transforms: RigidTransforms) -> Tensor:
        return torch.stack([self._one(v, r) for v, r in zip(skin, transforms.rotation)])

    def _one(self, skin, rotation):
        P = self.P
        n = self._n
        skel = self._skeleton
        rot = rotation.contiguous()[None]
        skel.rotation = as_warp(rot.view(1, 24, 3, 3), wp.mat33)
        half = torch.empty_like(rot)
        skel.half = as_warp(half, wp.mat33)
        wp.launch(kernels.half_kernel, (1, 24), [skel.rotation, self._parent], [skel.half])
        stations = torch.empty(self._n_stations, 3)
        skin_wp = as_warp(skin.contiguous(), wp.vec3)
        st = as_warp(stations, wp.vec3)
        wp.launch(kernels.mean_kernel, self._n_stations, [skin_wp, *self._station], [st])
        a, b2 = torch.empty(2, n, 3).unbind(0)
        a_wp, b_wp = as_warp(a, wp.vec3), as_warp(b2, wp.vec3)
        out = self._points
        out_wp = self._points_wp
        self._moved.zero_()
        wp.launch(kernels.crease_kernel, n, [skin_wp, st, skel, 0, self._folds, P["crounds"]], [a_wp, as_warp(self._moved, wp.int32)])
        src = a_wp
        moved = a.clone(); mw = as_warp(moved, wp.vec3)
        for i in range(P["n1"]):
            dst = b_wp if src is a_wp else a_wp
            wp.launch(kernels.smooth_kernel, n, [skin_wp, mw, *self._ring, P["scale"], P["lam"], src], [dst])
            src = dst
        self._points[:n] = b2 if src is b_wp else a
        wp.launch(kernels.mean_kernel, self._m, [out_wp, *self._middle], [out_wp[n:]])
        for g in self._meshes:
            g.refit()
        self._low.fill_(1e9)
        self._high.fill_(-1e9)
        wp.launch(kernels.box_kernel, n, [out_wp, self._bodies.of_vertex, self._bodies.low, self._bodies.high])
        wp.launch(kernels.part_kernel, n, [out_wp, n, skel, 0, self._bodies, self.gap, P["rounds"]], [a_wp])
        src = a_wp
        moved = a.clone(); mw = as_warp(moved, wp.vec3)
        for i in range(P["n2"]):
            dst = b_wp if src is a_wp else a_wp
            wp.launch(kernels.smooth_kernel, n, [skin_wp, mw, *self._ring, P["scale"], P["lam"], src], [dst])
            src = dst
        return (b2 if src is b_wp else a).clone()


def _vertex_normals(v, f):
    a, b, c = v[f].transpose(1, 0, 2)
    n = np.zeros_like(v)
    np.add.at(n, f, np.cross(b - a, c - a)[:, None])
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-20)


@wp.kernel(enable_backward=False)
def clearance_kernel(points: wp.array[wp.vec3], of_vertex: wp.array[int], trees: wp.array[wp.uint64], clear: wp.array2d[float]) -> None:
    v, k = wp.tid()
    d = float(0.0)
    if of_vertex[v] != k:
        hit = wp.mesh_query_point_sign_winding_number(trees[k], points[v], 10.0, 2.0, 0.5)
        if hit.result:
            d = hit.sign * wp.length(points[v] - wp.mesh_eval_position(trees[k], hit.face, hit.u, hit.v))
    clear[v, k] = d
