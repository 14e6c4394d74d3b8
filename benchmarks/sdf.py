"""The exact signed distance of a garment's vertices, ours and others', side by side in one process on one thread.

    python benchmarks/sdf.py [--garment tshirt-male] [--rounds 15] [--poses 6] [--json FILE]

Every method gets the same poses, in turn, so that a busy machine slows all alike. Each answers for every vertex of a
new pose, its preparation for the pose included. The ratio is to Warp's refit and query, built once in the rest pose.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before any library reads it

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core.body import load_body
from refu_core.garments import load_garment
from refu_core.repulsion import resolve
from refu_core.sdf import ExactSdf

Array = NDArray[np.float32]
Method = Callable[[Array, Array], Array]  # body, garment -> signed distances
REFERENCE = "warp refit + query"


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

    def ask(body: Array, garment: Array) -> Array:
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

    def ask(body: Array, garment: Array) -> Array:
        sdf.update(torch.from_numpy(body))
        return sdf.query(torch.from_numpy(garment)).distance.numpy()

    return ask


def ours_with_refu(faces: NDArray[np.int32], rest: Array, edges: torch.Tensor | None) -> Method:
    sdf = ExactSdf(faces)
    sdf.update(torch.from_numpy(rest))

    def ask(body: Array, garment: Array) -> Array:
        sdf.update(torch.from_numpy(body))
        return resolve(torch.from_numpy(garment), sdf, edges=edges).distance.numpy()

    return ask


def with_igl(faces: NDArray[np.int32]) -> Method:
    import igl

    indices = faces.astype(np.int64)

    def ask(body: Array, garment: Array) -> Array:
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

    def ask(body: Array, garment: Array) -> Array:
        mesh = trimesh.Trimesh(body, faces, process=False)
        closest, distance, face = trimesh.proximity.closest_point(mesh, garment)
        outward = ((garment - closest) * mesh.face_normals[face]).sum(1)
        return np.where(outward < 0, -distance, distance).astype(np.float32)

    return ask


def with_open3d(faces: NDArray[np.int32]) -> Method:
    import open3d

    core = open3d.core

    def ask(body: Array, garment: Array) -> Array:
        scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(core.Tensor(body), core.Tensor(faces.astype(np.uint32)))
        return scene.compute_signed_distance(core.Tensor(garment), nthreads=1).numpy()

    return ask


def methods(faces: NDArray[np.int32], rest: Array, edges: torch.Tensor) -> dict[str, Method]:
    """Those whose library is installed, by name."""
    found = {
        REFERENCE: plain_warp(faces, rest),
        "ours": ours(faces, rest),
        "ours, built once": ours(faces, rest, rebuild_distance=float("inf")),
        "ours, sign by winding number": ours(faces, rest, sign="winding"),
        "ours + ReFU": ours_with_refu(faces, rest, None),
        "ours + ReFU + edges": ours_with_refu(faces, rest, edges),
    }
    for name, module, make in (
        ("libigl pseudonormal", "igl", with_igl),
        ("open3d compute_signed_distance", "open3d", with_open3d),
        ("trimesh closest_point", "rtree", with_trimesh),
    ):
        if importlib.util.find_spec(module):
            found[name] = make(faces)
    return found


def poses(n: int) -> torch.Tensor:
    """Bent limbs, the arms lowered, shape (n, 24, 3) [rad]."""
    pose = 0.15 * torch.randn(n, 24, 3, generator=torch.Generator().manual_seed(0))
    pose[:, 16, 2] -= 1.0
    pose[:, 17, 2] += 1.0
    return pose


def main() -> None:
    """Prints a table, and writes it as JSON where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garment", default="tshirt-male")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    args = parser.parse_args()
    torch.set_num_threads(1)

    garment = load_garment(args.garment)
    body = load_body(garment.body)
    output = body(pose=poses(args.poses), betas=torch.zeros(args.poses, 10))
    worn = garment.pose(garment.rest(torch.zeros(args.poses, 10)), output.transforms)
    skins, garments = output.vertices.numpy(), worn.numpy()
    faces = body.faces.numpy().astype(np.int32)
    contenders = methods(faces, body.v_template.numpy(), garment.edges)

    answers = {
        name: [ask(skin, cloth) for skin, cloth in zip(skins, garments, strict=True)]
        for name, ask in contenders.items()
    }
    milliseconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(args.rounds):
        for skin, cloth in zip(skins, garments, strict=True):
            for name, ask in contenders.items():
                start = time.perf_counter()
                ask(skin, cloth)
                milliseconds[name].append(1e3 * (time.perf_counter() - start))

    reference = float(np.median(milliseconds[REFERENCE]))
    rows = []
    print(f"{args.garment}, {garment.n_vertices} vertices, {len(faces)} body faces, {args.poses} poses, 1 thread")
    print(
        f"{'method':32} {'median ms':>10} {'p10':>7} {'p90':>7} {'ratio':>7} {'max |error| mm':>15} {'other sign':>11}"
    )
    for name, samples in milliseconds.items():
        low, median, high = np.percentile(samples, [10, 50, 90])
        row = {
            "stage": "sdf",
            "method": name,
            "garment": args.garment,
            "ms_median": median,
            "ms_p10": low,
            "ms_p90": high,
        }
        row["ratio"] = median / reference
        accuracy = ""
        if "ReFU" not in name:  # those answer for other places
            pairs = list(zip(answers[name], answers[REFERENCE], strict=True))
            row["max_error_mm"] = 1e3 * max(float(np.abs(np.abs(a) - np.abs(b)).max()) for a, b in pairs)
            row["other_sign_percent"] = 100 * float(np.mean([((a < 0) != (b < 0)).mean() for a, b in pairs]))
            accuracy = f"{row['max_error_mm']:15.5f} {row['other_sign_percent']:9.3f} %"
        rows.append(row)
        print(f"{name:32} {median:10.2f} {low:7.2f} {high:7.2f} {row['ratio']:7.2f} {accuracy}")
    if args.json:
        args.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
