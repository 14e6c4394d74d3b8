"""The signed distance of all of a garment's vertices to a body in a new pose: ours and others', on one thread."""

from __future__ import annotations

import importlib
import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core.benchmark._kernels import plain_kernel
from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_core.sdf import ApproxSdf, BandSdf, ExactSdf, Links, NeuralSdf, RestFaces, SdfNetwork

Array = NDArray[np.float32]
PLAIN_QUERY = "warp refit + query"
"""What every time is a ratio to: a BVH of the rest pose, refitted to the body and asked for every vertex."""


@dataclass(frozen=True, eq=False)
class SdfFrame:
    """A body and what it wears."""

    body: Array
    """Posed body [m], shape (V, 3)."""
    garment: Array
    """Posed garment [m], shape (N, 3)."""
    unposed: Tensor
    """The garment in the rest pose, β taken off [m], shape (N, 3)."""
    pose: Tensor
    """Shape (24, 3) [rad]."""
    betas: Tensor
    """Shape (10,)."""


@dataclass(frozen=True, eq=False)
class SdfMethod:
    """One way to the distances."""

    name: str
    mode: str
    """The pipeline's mode that works this way, or `other`."""
    ask: Callable[[SdfFrame], Array]
    """Signed distances [m], shape (N,), the preparation for the pose included."""
    is_slow: bool = False
    """Takes so long that few calls must do."""
    is_clipped: bool = False
    """Says no more than "farther than the band" of most vertices."""
    is_trained: bool = True
    """Whether its answers mean something."""


def sdf_methods(
    body: SmplBody, garment: GarmentTemplate, *, network: bool = True, device: str = "cpu"
) -> tuple[list[SdfMethod], dict[str, str]]:
    """All methods whose library is installed, the plain query first; and what to install for the others, by name.

    `network` asks for the paper's, which takes seconds a call on a CPU.
    """
    faces, rest = body.faces.cpu().numpy().astype(np.int32), body.v_template.cpu().numpy()
    methods = [SdfMethod(PLAIN_QUERY, "plain", _plain(faces, rest, device))]
    if device == "cpu":
        methods.append(SdfMethod("band, exact (accurate)", "accurate", _band(body, garment), is_clipped=True))
    methods += [
        SdfMethod("walk, approximate (hybrid, approx)", "hybrid", _walk(body, device)),
        SdfMethod("exact, unfiltered", "other", _exact(faces, rest, device)),
    ]
    if device == "cpu":
        methods.append(SdfMethod("exact, sign by winding number", "other", _winding(faces, rest), is_slow=True))
    missing = {}
    for name, module, package, make, is_slow in _OTHERS:
        if importlib.util.find_spec(module) is None:
            missing[name] = f"pip install {package}"
        elif device == "cpu":
            methods.append(SdfMethod(name, "other", make(faces), is_slow=is_slow))
    if network:
        paper = SdfMethod(
            "paper's network, 9 x 1024, untrained", "paper", _network(body), is_slow=True, is_trained=False
        )
        methods.append(paper)
    return methods, missing


def _plain(faces: NDArray[np.int32], rest: Array, device: str) -> Callable[[SdfFrame], Array]:
    mesh = wp.Mesh(wp.array(rest, dtype=wp.vec3, device=device), wp.array(faces.ravel(), dtype=wp.int32, device=device))

    def ask(frame: SdfFrame) -> Array:
        mesh.points.assign(frame.body)
        mesh.refit()
        n = len(frame.garment)
        points = wp.array(frame.garment, dtype=wp.vec3, device=device, copy=False)
        distance = wp.empty(n, dtype=float, device=device)
        gradient = wp.empty(n, dtype=wp.vec3, device=device)
        wp.launch(plain_kernel, n, [mesh.id, points], [distance, gradient], device=device)
        answer: Array = distance.numpy()
        return answer

    return ask


def _band(body: SmplBody, garment: GarmentTemplate) -> Callable[[SdfFrame], Array]:
    sdf, links = BandSdf(body.faces), Links.of(garment.edges, garment.n_vertices)

    def ask(frame: SdfFrame) -> Array:
        sdf.update(torch.from_numpy(frame.body))
        answer: Array = sdf.clipped(torch.from_numpy(frame.garment), links).distance.numpy()
        return answer

    return ask


def _walk(body: SmplBody, device: str) -> Callable[[SdfFrame], Array]:
    sdf, rest_faces = ApproxSdf(body, device=device), RestFaces(body)

    def ask(frame: SdfFrame) -> Array:
        near = rest_faces(frame.unposed)
        sdf.update(torch.from_numpy(frame.body).to(device))
        answer: Array = sdf.query(torch.from_numpy(frame.garment).to(device), near=near).distance.cpu().numpy()
        return answer

    return ask


def _exact(faces: NDArray[np.int32], rest: Array, device: str) -> Callable[[SdfFrame], Array]:
    sdf = ExactSdf(faces, device=device)
    return _asking(sdf, rest, device)


def _winding(faces: NDArray[np.int32], rest: Array) -> Callable[[SdfFrame], Array]:
    return _asking(ExactSdf(faces, sign="winding", rebuild_distance=math.inf), rest, "cpu")


def _asking(sdf: ExactSdf, rest: Array, device: str) -> Callable[[SdfFrame], Array]:
    sdf.update(torch.from_numpy(rest).to(device))

    def ask(frame: SdfFrame) -> Array:
        sdf.update(torch.from_numpy(frame.body).to(device))
        answer: Array = sdf.query(torch.from_numpy(frame.garment).to(device)).distance.cpu().numpy()
        return answer

    return ask


def _network(body: SmplBody) -> Callable[[SdfFrame], Array]:
    """As it is drawn: what it answers is nothing, what it costs is what it would cost trained."""
    sdf = NeuralSdf(SdfNetwork().to(body.device).eval().requires_grad_(False), body)

    @torch.no_grad()
    def ask(frame: SdfFrame) -> Array:
        sdf.update(body.v_template, pose=frame.pose.to(body.device), betas=frame.betas.to(body.device))
        answer: Array = sdf.query(torch.from_numpy(frame.garment).to(body.device)).distance.cpu().numpy()
        return answer

    return ask


def _libigl(faces: NDArray[np.int32]) -> Callable[[SdfFrame], Array]:
    igl: Any = importlib.import_module("igl")
    indices = faces.astype(np.int64)

    def ask(frame: SdfFrame) -> Array:
        sign = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        points, body = frame.garment.astype(np.float64), frame.body.astype(np.float64)
        distance, *_ = igl.signed_distance(points, body, indices, sign_type=sign)
        return np.asarray(distance, np.float32)

    return ask


def _open3d(faces: NDArray[np.int32]) -> Callable[[SdfFrame], Array]:
    open3d: Any = importlib.import_module("open3d")
    core = open3d.core

    def ask(frame: SdfFrame) -> Array:
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(core.Tensor(frame.body), core.Tensor(faces.astype(np.uint32)))
        answer: Array = scene.compute_signed_distance(core.Tensor(frame.garment), nthreads=1).numpy()
        return answer

    return ask


def _trimesh(faces: NDArray[np.int32]) -> Callable[[SdfFrame], Array]:
    trimesh: Any = importlib.import_module("trimesh")

    def ask(frame: SdfFrame) -> Array:
        mesh = trimesh.Trimesh(frame.body, faces, process=False)
        closest, distance, face = trimesh.proximity.closest_point(mesh, frame.garment)
        outward = ((frame.garment - closest) * mesh.face_normals[face]).sum(1)
        return np.asarray(np.where(outward < 0, -distance, distance), np.float32)

    return ask


_Make = Callable[[NDArray[np.int32]], Callable[[SdfFrame], Array]]
_OTHERS: tuple[tuple[str, str, str, _Make, bool], ...] = (
    ("libigl signed_distance, pseudo-normal", "igl", "libigl", _libigl, False),
    ("open3d RaycastingScene", "open3d", "open3d", _open3d, False),
    ("trimesh closest_point", "rtree", "rtree", _trimesh, True),
)
"""Name, module that must be there, package that brings it, maker, whether it is slow."""
