"""The signed distance of a garment's vertices, ours and others', side by side in one process on one thread.

    python benchmarks/sdf.py [--garment tshirt-male] [--rounds 10] [--poses 6] [--network] [--json FILE]

Every method gets the same poses, in turn, so that a busy machine slows all alike; times are the processor's. Each
answers for every vertex of a new pose, its preparation for the pose included. The ratio is to Warp's refit and query,
built once in the rest pose.
Errors are to the exact distance, of vertices within 2 cm of the skin; "missed" are vertices deeper inside than 2 mm
that are taken to be outside, a pose. Half of the poses bend limbs at random; the others bring limbs together (squat,
crossed arms, hands on hips). The garments are skinned and disturbed by 8 mm, so that they run into the body.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before any library reads it

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core.body import SmplBody, load_body
from refu_core.garments import GarmentTemplate, load_garment
from refu_core.repulsion import resolve
from refu_core.sdf import ApproxSdf, BandSdf, ExactSdf, Links, NeuralSdf, RestFaces, SdfNetwork

Array = NDArray[np.float32]
REFERENCE = "warp refit + query"
NEAR, DEEP = 0.02, 0.002  # [m]


@dataclass(frozen=True, eq=False)
class Frame:
    """A body and what it wears."""

    body: Array
    """Posed body [m], shape (V, 3)."""
    garment: Array
    """Posed garment [m], shape (N, 3)."""
    unposed: Tensor
    """The garment on the mean shape in the rest pose [m], shape (N, 3)."""
    pose: Tensor
    """Shape (24, 3) [rad]."""
    betas: Tensor
    """Shape (10,)."""


Method = Callable[[Frame], Array]  # signed distances


@wp.kernel(enable_backward=False)
def plain_query(  # type: ignore[no-untyped-def]
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    gradient: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    hit = wp.mesh_query_point_sign_normal(mesh, points[i], 10.0)
    offset = points[i] - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
    distance[i] = hit.sign * wp.length(offset)
    gradient[i] = hit.sign * wp.normalize(offset)


def plain_warp(faces: NDArray[np.int32], rest: Array) -> Method:
    mesh = wp.Mesh(wp.array(rest, dtype=wp.vec3, device="cpu"), wp.array(faces.ravel(), dtype=wp.int32, device="cpu"))

    def ask(frame: Frame) -> Array:
        body, garment = frame.body, frame.garment
        mesh.points.assign(body)
        mesh.refit()
        points = wp.array(garment, dtype=wp.vec3, device="cpu", copy=False)
        distance = wp.empty(len(garment), dtype=float, device="cpu")
        gradient = wp.empty(len(garment), dtype=wp.vec3, device="cpu")
        wp.launch(plain_query, len(garment), [mesh.id, points], [distance, gradient], device="cpu")
        return distance.numpy()

    return ask


def ours(faces: NDArray[np.int32], rest: Array, **options: object) -> Method:
    sdf = ExactSdf(faces, **options)  # type: ignore[arg-type]
    sdf.update(torch.from_numpy(rest))

    def ask(frame: Frame) -> Array:
        body, garment = frame.body, frame.garment
        sdf.update(torch.from_numpy(body))
        return sdf.query(torch.from_numpy(garment)).distance.numpy()

    return ask


def ours_with_refu(faces: NDArray[np.int32], rest: Array, edges: torch.Tensor | None) -> Method:
    sdf = ExactSdf(faces)
    sdf.update(torch.from_numpy(rest))

    def ask(frame: Frame) -> Array:
        body, garment = frame.body, frame.garment
        sdf.update(torch.from_numpy(body))
        return resolve(torch.from_numpy(garment), sdf, edges=edges).distance.numpy()

    return ask


def approximate(body: SmplBody) -> Method:
    sdf, rest_faces = ApproxSdf(body), RestFaces(body)

    def ask(frame: Frame) -> Array:
        sdf.update(torch.from_numpy(frame.body))
        return sdf.query(torch.from_numpy(frame.garment), near=rest_faces(frame.unposed)).distance.numpy()

    return ask


def approximate_again(body: SmplBody) -> Method:
    """As in a video: every vertex starts at its face in the last frame, here found beforehand."""
    sdf = ApproxSdf(body)
    faces: dict[int, Tensor | None] = {}

    def ask(frame: Frame) -> Array:
        sdf.update(torch.from_numpy(frame.body))
        sample = sdf.query(torch.from_numpy(frame.garment), near=faces.get(id(frame)))
        faces[id(frame)] = sample.face
        return sample.distance.numpy()

    return ask


def in_a_band(body: SmplBody, garment: GarmentTemplate) -> Method:
    sdf, links = BandSdf(body.faces), Links.of(garment.edges, garment.n_vertices)

    def ask(frame: Frame) -> Array:
        sdf.update(torch.from_numpy(frame.body))
        return sdf.clipped(torch.from_numpy(frame.garment), links).distance.numpy()

    return ask


def by_network(body: SmplBody) -> Method:
    """The paper's network as it is drawn: what it answers is nothing, what it costs is what it would cost trained."""
    sdf = NeuralSdf(SdfNetwork(), body)

    @torch.no_grad()
    def ask(frame: Frame) -> Array:
        sdf.update(torch.from_numpy(frame.body), pose=frame.pose, betas=frame.betas)
        return sdf.query(torch.from_numpy(frame.garment)).distance.numpy()

    return ask


def with_igl(faces: NDArray[np.int32]) -> Method:
    import igl

    indices = faces.astype(np.int64)

    def ask(frame: Frame) -> Array:
        body, garment = frame.body, frame.garment
        distance, *_ = igl.signed_distance(
            garment.astype(np.float64),
            body.astype(np.float64),
            indices,
            sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
        )
        return np.asarray(distance, np.float32)

    return ask


def with_trimesh(faces: NDArray[np.int32]) -> Method:
    import trimesh

    def ask(frame: Frame) -> Array:
        body, garment = frame.body, frame.garment
        mesh = trimesh.Trimesh(body, faces, process=False)
        closest, distance, face = trimesh.proximity.closest_point(mesh, garment)
        outward = ((garment - closest) * mesh.face_normals[face]).sum(1)
        return np.where(outward < 0, -distance, distance).astype(np.float32)

    return ask


def with_open3d(faces: NDArray[np.int32]) -> Method:
    import open3d

    core = open3d.core

    def ask(frame: Frame) -> Array:
        body, garment = frame.body, frame.garment
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(core.Tensor(body), core.Tensor(faces.astype(np.uint32)))
        return scene.compute_signed_distance(core.Tensor(garment), nthreads=1).numpy()

    return ask


def methods(body: SmplBody, garment: GarmentTemplate, *, network: bool) -> dict[str, Method]:
    """Those whose library is installed, by name."""
    faces, rest = body.faces.numpy().astype(np.int32), body.v_template.numpy()
    found = {
        REFERENCE: plain_warp(faces, rest),
        "exact": ours(faces, rest),
        "exact, built once": ours(faces, rest, rebuild_distance=float("inf")),
        "exact, sign by winding number": ours(faces, rest, sign="winding"),
        "exact within a band": in_a_band(body, garment),
        "approximate": approximate(body),
        "approximate, from last faces": approximate_again(body),
        "exact + ReFU": ours_with_refu(faces, rest, None),
        "exact + ReFU + edges": ours_with_refu(faces, rest, garment.edges),
    }
    if network:
        found["network 9 x 1024, untrained"] = by_network(body)
    for name, module, make in (
        ("libigl pseudonormal", "igl", with_igl),
        ("open3d compute_signed_distance", "open3d", with_open3d),
        ("trimesh closest_point", "rtree", with_trimesh),
    ):
        if importlib.util.find_spec(module):
            found[name] = make(faces)
    return found


_TOGETHER: tuple[dict[int, tuple[float, float, float]], ...] = (
    {1: (-1.5, 0, 0.2), 2: (-1.5, 0, -0.2), 4: (1.8, 0, 0), 5: (1.8, 0, 0)},  # squat
    {16: (0, -0.6, -1.1), 17: (0, 0.6, 1.1), 18: (0, -2.0, 0), 19: (0, 2.0, 0)},  # crossed arms
    {16: (0.3, 0.5, -0.9), 17: (0.3, -0.5, 0.9), 18: (0, -1.7, 0), 19: (0, 1.7, 0)},  # hands on hips
)


def poses(n: int) -> Tensor:
    """Bent limbs, the arms lowered, and every other one with limbs brought together, shape (n, 24, 3) [rad]."""
    pose = 0.15 * torch.randn(n, 24, 3, generator=torch.Generator().manual_seed(0))
    pose[::2, 16, 2] -= 1.0
    pose[::2, 17, 2] += 1.0
    for k in range(1, n, 2):
        for joint, rotation in _TOGETHER[k // 2 % len(_TOGETHER)].items():
            pose[k, joint] = torch.tensor(rotation)
    return pose


def frames(body: SmplBody, garment: GarmentTemplate, n: int) -> list[Frame]:
    """Bodies of drawn shapes in these poses, and what they wear."""
    generator = torch.Generator().manual_seed(1)
    pose, betas = poses(n), torch.randn(n, 10, generator=generator)
    waves, phase = 12 * torch.randn(3, 24, generator=generator), 6.3 * torch.rand(24, generator=generator)
    shift = torch.sin(garment.v_template @ waves + phase) @ torch.randn(24, 3, generator=generator)
    shift *= 0.008 / shift.square().sum(1).mean().sqrt()
    output = body(pose, betas)
    worn = garment.pose(garment.rest(betas) + shift, output.transforms)
    return [
        Frame(output.vertices[k].numpy(), worn[k].numpy(), garment.v_template + shift, pose[k], betas[k])
        for k in range(n)
    ]


def errors(answers: list[Array], true: list[Array], *, clipped: bool) -> dict[str, float]:
    """How far answers are from the exact distance near the skin [mm], wrong signs there [%], and vertices missed."""
    near_errors, signs, missed = [], [], []
    for found, exact in zip(answers, true, strict=True):
        near = np.abs(exact) < NEAR
        wanted = np.minimum(exact, found.max()) if clipped else exact
        near_errors.append(1e3 * np.abs(found - wanted)[near])
        signs.append(((found < 0) != (exact < 0))[near])
        missed.append(int(((exact < -DEEP) & (found >= 0)).sum()))
    error = np.concatenate(near_errors)
    return {
        "mean_error_mm": float(error.mean()),
        "p99_error_mm": float(np.percentile(error, 99)),
        "other_sign_percent": float(100 * np.concatenate(signs).mean()),
        "missed": float(np.mean(missed)),
    }


def main() -> None:
    """Prints a table, and writes it as JSON where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garment", default="tshirt-male")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--network", action="store_true", help="also the paper's network: some seconds a pose")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    args = parser.parse_args()
    torch.set_num_threads(1)

    garment = load_garment(args.garment)
    body = load_body(garment.body)
    worn = frames(body, garment, args.poses)
    contenders = methods(body, garment, network=args.network)
    answers = {name: [ask(frame) for frame in worn] for name, ask in contenders.items()}
    milliseconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(args.rounds):
        for frame in worn:
            for name, ask in contenders.items():
                start = time.process_time()
                ask(frame)
                milliseconds[name].append(1e3 * (time.process_time() - start))

    reference = float(np.median(milliseconds[REFERENCE]))
    rows = []
    print(f"{args.garment}, {garment.n_vertices} vertices, {len(body.faces)} body faces, {args.poses} poses, 1 thread")
    print(f"{'':54} within 2 cm of the skin")
    times, figures = f"{'ms':>9} {'p10':>7} {'p90':>7} {'ratio':>7}", f"{'mean mm':>9} {'p99 mm':>8} {'sign':>8}"
    print(f"{'method':32} {times} {figures} {'missed':>7}")
    for name, samples in milliseconds.items():
        low, median, high = np.percentile(samples, [10, 50, 90])
        row = {
            "stage": "sdf",
            "method": name,
            "garment": args.garment,
            "ms_median": median,
            "ms_p10": low,
            "ms_p90": high,
            "ratio": median / reference,
        }
        accuracy = ""
        if "ReFU" not in name and "untrained" not in name:  # those answer for other places, and for nothing
            found = errors(answers[name], answers["exact"], clipped="band" in name)
            row |= found
            accuracy = (
                f"{found['mean_error_mm']:9.4f} {found['p99_error_mm']:8.3f} {found['other_sign_percent']:6.3f} % "
                f"{found['missed']:7.2f}"
            )
        rows.append(row)
        print(f"{name:32} {median:9.2f} {low:7.2f} {high:7.2f} {row['ratio']:7.3f} {accuracy}")
    if args.json:
        args.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
