"""Ways to the signed distances of a garment, ours and others', on one thread; and the input of all contenders."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

import msg_adapters as adapters
from refu_core import GarmentPipeline, RefuError, SmplFrame
from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_core.sdf import ApproxSdf, BandSdf, BodySdf, ExactSdf, NeuralSdf, RestFaces, SdfNetwork

Array = NDArray[np.float32]
PLAIN_QUERY = "warp refit + query"
"""The unit of all ratios: a BVH of the rest pose is refitted to the body and queried for every vertex."""


@wp.kernel(enable_backward=False)
def plain_kernel(
    mesh: wp.uint64, points: wp.array[wp.vec3], distance: wp.array[wp.float32], gradient: wp.array[wp.vec3]
) -> None:
    """Warp's own query as in its documentation: the signed distance [m] and its gradient at `points` [m]."""
    i = wp.tid()
    hit = wp.mesh_query_point_sign_normal(mesh, points[i], 10.0)
    offset = points[i] - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
    distance[i] = hit.sign * wp.length(offset)
    gradient[i] = hit.sign * wp.normalize(offset)


@dataclass(frozen=True, eq=False)
class SdfFrame:
    """A body and what it wears."""

    body: Array
    """Posed body [m], shape (V, 3)."""
    garment: Array
    """Posed garment [m], shape (N, 3)."""
    unposed: Tensor
    """The garment in the rest pose without the displacement of β [m], shape (N, 3)."""
    pose: Tensor
    """Shape (24, 3) [rad]."""
    betas: Tensor
    """Shape (10,)."""


Ask = Callable[[SdfFrame], Any]
"""Computes the signed distances [m], shape (N,), including the preparation for the pose."""


@dataclass(frozen=True, eq=False)
class SdfMethod:
    name: str
    mode: str
    """The pipeline's mode that works this way, or `other`."""
    ask: Ask
    is_slow: bool = False
    """Whether it takes so long that only a few calls are timed."""


def sdf_methods(
    body: SmplBody, garment: GarmentTemplate, *, network: bool = True, device: str = "cpu"
) -> tuple[list[SdfMethod], dict[str, str]]:
    """All methods whose library is installed, the plain query first; and what to install for the others, by name.

    `network` adds the paper's network, which takes seconds a call on a CPU.
    """
    faces = body.faces.cpu().numpy().astype(np.int32)
    methods = [SdfMethod(PLAIN_QUERY, "plain", plain_query(body, device))]
    if device == "cpu":
        methods.append(SdfMethod("band, exact (accurate)", "accurate", _band(body, garment)))
    walk = _ours(ApproxSdf(body, device=device), body, device, rest_faces=RestFaces(body))
    methods.append(SdfMethod("walk, approximate (hybrid, approx)", "hybrid", walk))
    methods.append(SdfMethod("exact, unfiltered", "other", _ours(ExactSdf(faces, device=device), body, device)))
    missing = {}
    if device == "cpu":
        winding = _ours(ExactSdf(faces, sign="winding", rebuild_distance=math.inf), body, device)
        methods.append(SdfMethod("exact, sign by winding number", "other", winding, is_slow=True))
        for name, module, package, make, is_slow in _OTHERS:
            if find_spec(module) is None:
                missing[name] = f"pip install {package}"
            else:
                methods.append(SdfMethod(name, "other", make(faces), is_slow=is_slow))
    if network:  # random weights: its answers mean nothing, but it costs as much as a trained one
        paper = NeuralSdf(SdfNetwork().to(body.device).eval().requires_grad_(False), body)
        name = "paper's network, 9 x 1024, untrained"
        methods.append(SdfMethod(name, "paper", _ours(paper, body, device), is_slow=True))
    return methods, missing


def plain_query(body: SmplBody, device: str) -> Ask:
    """The plain query: a search tree, fitted to each body and asked for the distance of every vertex."""
    faces, rest = body.faces.cpu().numpy().astype(np.int32), body.v_template.cpu().numpy()
    mesh = wp.Mesh(wp.array(rest, dtype=wp.vec3, device=device), wp.array(faces.ravel(), dtype=wp.int32, device=device))

    def ask(frame: SdfFrame) -> Any:
        mesh.points.assign(frame.body)
        mesh.refit()
        n = len(frame.garment)
        points = wp.array(frame.garment, dtype=wp.vec3, device=device, copy=False)
        distance = wp.empty(n, dtype=float, device=device)
        gradient = wp.empty(n, dtype=wp.vec3, device=device)
        wp.launch(plain_kernel, n, [mesh.id, points], [distance, gradient], device=device)
        return distance.numpy()

    return ask


def _band(body: SmplBody, garment: GarmentTemplate) -> Ask:
    sdf = BandSdf(body.faces)

    def ask(frame: SdfFrame) -> Any:
        sdf.update(torch.from_numpy(frame.body))
        return sdf.clipped(torch.from_numpy(frame.garment), garment.mesh.ring).distance.numpy()

    return ask


def _ours(sdf: BodySdf, body: SmplBody, device: str, *, rest_faces: RestFaces | None = None) -> Ask:
    sdf.update(body.v_template.to(device), pose=torch.zeros(24, 3, device=device), betas=torch.zeros(10, device=device))

    @torch.no_grad()
    def ask(frame: SdfFrame) -> Any:
        near = None if rest_faces is None else rest_faces(frame.unposed)
        sdf.update(torch.from_numpy(frame.body).to(device), pose=frame.pose.to(device), betas=frame.betas.to(device))
        return sdf.query(torch.from_numpy(frame.garment).to(device), near=near).distance.cpu().numpy()

    return ask


def _libigl(faces: NDArray[np.int32]) -> Ask:
    import igl

    indices = faces.astype(np.int64)

    def ask(frame: SdfFrame) -> Any:
        sign = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        points, body = frame.garment.astype(np.float64), frame.body.astype(np.float64)
        distance, *_ = igl.signed_distance(points, body, indices, sign_type=sign)
        return np.asarray(distance, np.float32)

    return ask


def _trimesh(faces: NDArray[np.int32]) -> Ask:
    import trimesh

    def ask(frame: SdfFrame) -> Any:
        mesh = trimesh.Trimesh(frame.body, faces, process=False)
        closest, distance, face = trimesh.proximity.closest_point(mesh, frame.garment)
        outward = ((frame.garment - closest) * mesh.face_normals[face]).sum(1)
        return np.asarray(np.where(outward < 0, -distance, distance), np.float32)

    return ask


_Make = Callable[[NDArray[np.int32]], Ask]
_OTHERS: tuple[tuple[str, str, str, _Make, bool], ...] = (
    ("libigl signed_distance, pseudo-normal", "igl", "libigl", _libigl, False),
    ("trimesh closest_point", "rtree", "rtree", _trimesh, True),
)
"""Name, required module, package that provides it, maker, whether it is slow."""


RATE = 30.0
"""Frame rate of the measured motion [Hz]."""
_MOTION_BAGS = ("walk", "reach_squat")
Stretch = Sequence[SmplFrame]


@dataclass(frozen=True, eq=False)
class EncodedFrame:
    """One frame in every form that a contender may need."""

    frame: SmplFrame
    raw: bytes
    """The input message (`std_msgs/Float32MultiArray`)."""
    sdf: SdfFrame
    """The body, and the garment before collisions are handled."""
    is_jump: bool
    """Whether it doesn't continue the frame before it."""


Window = Sequence[EncodedFrame]


def read_stretches(motions: Path | None, bags: Path, *, count: int, length: int) -> list[Stretch]:
    """`count` stretches of `length` frames at 30 Hz, evenly spread over all the motion there is.

    Raises `RefuError`: there is no motion of that length, or a file can't be read.
    """
    starts = [(clip, start) for clip in _clips(motions, bags) for start in range(0, len(clip) - length + 1, length)]
    if not starts:
        where, wanted = (bags, "the repository's bags") if motions is None else (motions, "AMASS-style .npz files")
        raise RefuError(f"{where}: no motion of {length} frames at 30 Hz in it, wanted {wanted} (--motions DIR)")
    picked = [starts[(2 * i + 1) * len(starts) // (2 * count)] for i in range(count)]
    return [clip[start : start + length] for clip, start in picked]


def _clips(motions: Path | None, bags: Path) -> Iterator[Stretch]:
    if motions is not None:
        for path in sorted(motions.glob("*.npz")):
            yield list(adapters.read_motion(path).resampled(RATE).frames())
        return
    for name in _MOTION_BAGS:
        if (bags / name).is_dir():
            records = adapters.iter_smpl_frames(bags / name)
            yield [record.frame for record in records if record.frame is not None]


def moments(stretches: Sequence[Stretch], pipeline: GarmentPipeline) -> list[Window]:
    """The stretches as windows, with the only garment of `pipeline` in each frame before collision handling."""
    ((name, garment),) = pipeline.garments.items()
    encode = adapters.encoder_for("multiarray")
    windows: list[Window] = []
    for stretch in stretches:
        raw = [torch.tensor(pipeline(frame)[name].raw) for frame in stretch]
        worn = [sdf_frame(pipeline.body, garment, frame, posed) for frame, posed in zip(stretch, raw, strict=True)]
        windows.append(
            [EncodedFrame(f, encode(f), w, is_jump=i == 0) for i, (f, w) in enumerate(zip(stretch, worn, strict=True))]
        )
    return windows


@torch.no_grad()
def sdf_frame(body: SmplBody, garment: GarmentTemplate, frame: SmplFrame, posed: Tensor) -> SdfFrame:
    """A body, and a garment on it with vertices `posed` [m], shape (V, 3)."""
    pose, betas = torch.tensor(frame.pose)[None], torch.tensor(frame.betas)[None]
    output = body(pose, betas)
    unposed = garment.unpose(posed[None], output.transforms)
    on_mean_shape = unposed - (betas @ garment.shapedirs.T).view_as(unposed)
    return SdfFrame(output.vertices[0].numpy(), posed.numpy(), on_mean_shape[0], pose[0], betas[0])
