"""How accurate and fast the outputs for robots are, on held-out simulated cloth; docs/guide/outputs.md has the figures.

    python benchmarks/outputs.py                  # all parts, some minutes
    python benchmarks/outputs.py openings times   # some of them

Ground truth is the test samples in bags/eval_*. Whatever was tuned or fitted used every other style-shape pair of a
bag; its figures are for the rest. Times are medians on one thread.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import igl
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from refu_core import GarmentPipeline, SmplFrame, outputs
from refu_core.observation import Observer
from refu_lab.truth import TrueFrame, coverage, cross_checked, held_out, moments_of

BAGS = Path(__file__).parents[1] / "bags"
GARMENTS = ("tshirt-male", "shirt-male", "short-pant-male", "skirt-female")
SENSOR = 0.003
"""Noise of a depth camera at 2 m [m]."""
STEREO = (0.01, 0.02, 0.03)
"""Noise of stereo cameras, at 2 to 5 m [m]."""
Points = NDArray[np.float64]


def bag_of(garment: str) -> Path:
    return BAGS / f"eval_{garment.replace('-', '_')}"


def openings() -> None:
    """Centres and normals compared with those of the simulated garment, and how steady they are."""
    for garment in GARMENTS:
        pipeline = GarmentPipeline.load([garment])
        of = outputs.Openings(pipeline.garments[garment])
        off: dict[str, list[tuple[float, float]]] = {name: [] for name in of.names}
        for moment in moments_of(bag_of(garment), pipeline.garments[garment]):
            worn = of.frames(pipeline(moment.frame)[garment].local)
            for mine, true in zip(worn, of.frames(moment.truth), strict=True):
                turn = np.degrees(np.arccos(np.clip(mine.rotation[:, 2] @ true.rotation[:, 2], -1, 1)))
                off[mine.name].append((1e3 * float(np.linalg.norm(mine.centre - true.centre)), float(turn)))
        for name, rows in off.items():
            centre, turn = np.array(rows).T
            within = 100 * np.mean(centre <= 10)
            print(
                f"openings   {garment:16} {name:13} centre {centre.mean():4.1f} mm "
                f"(p95 {np.percentile(centre, 95):4.1f}; "
                f"within 10 mm: {within:3.0f} %), normal {turn.mean():3.1f}° "
                f"(p95 {np.percentile(turn, 95):3.1f}°)"
            )
    steadiness()


def steadiness() -> None:
    """How steady openings are on someone standing still, whose joints are measured with a new error in each frame."""
    rng = np.random.default_rng(0)
    for outfit in (["tshirt-male", "short-pant-male"], ["skirt-female"]):
        pipeline = GarmentPipeline.load(outfit)
        every = {name: outputs.Openings(garment) for name, garment in pipeline.garments.items()}
        pose = np.zeros((24, 3))
        pose[16, 2], pose[17, 2] = -1.1, 1.1
        for degrees in (0.0, 0.1, 0.2):
            places, skins, near = [], [], None
            for _ in range(60):
                wrong = rng.normal(0, np.radians(degrees), (24, 3))
                wrong[0] = 0
                out = pipeline(SmplFrame(pose=pose + wrong))
                rims = [rim for name, of in every.items() for rim in of.frames(out[name].local)]
                if near is None:
                    near = [np.linalg.norm(out.skin[:, None] - rim.ring, axis=2).argmin(0) for rim in rims]
                places.append([rim.centre for rim in rims])
                skins.append([out.skin[rows].mean(0) for rows in near])
            step, own = (
                1e3 * np.linalg.norm(np.diff(np.array(x), axis=0), axis=2) for x in (places, np.subtract(places, skins))
            )
            names = [name for of in every.values() for name in of.names]
            said = ", ".join(f"{n} {a:.1f} ({b:.1f})" for n, a, b in zip(names, step.mean(0), own.mean(0), strict=True))
            print(f"steadiness {degrees:.1f}° a joint, mm from frame to frame (beside the skin below): {said}")


def planner() -> None:
    """How far the planner's solid and the garment are apart, beyond half the thickness."""
    for garment in GARMENTS:
        pipeline = GarmentPipeline.load([garment])
        template = pipeline.garments[garment]
        coarse, faces = outputs.PlannerMesh.of(pipeline, garment), template.faces.numpy()
        there, back, closed = [], [], True
        for moment in moments_of(bag_of(garment), template)[::4]:
            worn = pipeline(moment.frame)[garment].local.astype(np.float64)
            solid = coarse.solid(worn)
            mesh = trimesh.Trimesh(solid, coarse.faces, process=False)
            closed &= bool(mesh.is_watertight and mesh.volume > 0)
            places = np.concatenate((solid, mesh.triangles_center, mesh.sample(2000, seed=0)))
            there.append(np.sqrt(igl.point_mesh_squared_distance(places, worn, faces)[0]))
            back.append(np.sqrt(igl.point_mesh_squared_distance(worn, solid, coarse.faces)[0]))
        for what, found in (("solid to garment", there), ("garment to solid", back)):
            beyond = 1e3 * np.maximum(np.concatenate(found) - coarse.half_thickness, 0)
            print(
                f"planner    {garment:16} {what}: beyond half the thickness {beyond.mean():.2f} mm "
                f"(p95 {np.percentile(beyond, 95):.1f}, p99 {np.percentile(beyond, 99):.1f}, most {beyond.max():.1f}; "
                f"within 5 mm: {100 * np.mean(beyond <= 5):.1f} %), {len(coarse.faces)} triangles, closed: {closed}"
            )


def sigma() -> None:
    """How often a 90 % interval holds on a style-shape pair when it is fitted to all the others."""
    for garment in GARMENTS:
        samples = held_out(bag_of(garment), garment)
        found, share = outputs.load_sigma(samples.garment), cross_checked(samples)
        print(f"sigma      {garment:16} {1e3 * found.sigma.mean():.1f} mm; 90 % holds {100 * share:.1f} % of the rest")
    moving = held_out(BAGS / "eval_tshirt_male_sequence", "tshirt-male")
    share = coverage(outputs.load_sigma(moving.garment), moving)
    print(f"sigma      tshirt-male in motion: 90 % holds {100 * share:.1f} %")


def measured(
    depth: NDArray[np.float32], camera: outputs.PinholeCamera, rng: np.random.Generator, *, noise: float = SENSOR
) -> Points:
    """A depth picture as points in the world's axes, with a sensor's noise."""
    row, column = np.nonzero(np.isfinite(depth))
    z = depth[row, column] + rng.normal(0, noise, len(row))
    ways = [(column + 0.5 - camera.centre[0]) / camera.focal[0], (row + 0.5 - camera.centre[1]) / camera.focal[1]]
    return (np.stack((ways[0] * z, ways[1] * z, z), 1) - camera.translation) @ camera.rotation


def observation() -> None:
    """How far the cloth that a camera sees is from the predicted garment, without the camera's points and with them."""
    for garment in GARMENTS:
        pipeline = GarmentPipeline.load([garment])
        moments = moments_of(bag_of(garment), pipeline.garments[garment])
        for noise in (SENSOR, *STEREO):
            _follow(pipeline, garment, [one for one in moments if one.pair % 2 == 1], keeps=False, noise=noise)
    pipeline = GarmentPipeline.load(["tshirt-male"])
    moments = moments_of(BAGS / "eval_tshirt_male_sequence", pipeline.garments["tshirt-male"])
    _follow(pipeline, "tshirt-male", moments, keeps=True)


def _follow(
    pipeline: GarmentPipeline, garment: str, moments: list[TrueFrame], *, keeps: bool, noise: float = SENSOR
) -> None:
    observer, faces = Observer(pipeline), pipeline.garments[garment].faces.numpy()
    skin_faces, rng = pipeline.body.faces.numpy(), np.random.default_rng(0)
    plain, compared, followed, foreseen, inside = [], [], [], [], 0
    for moment in moments:
        if not keeps:
            observer.reset()
        out = pipeline(moment.frame)
        way = 0.4 if keeps else rng.uniform(-np.pi, np.pi)
        middle = moment.truth.mean(0)
        eye = middle + np.array([2 * np.sin(way), 0.5, 2 * np.cos(way)])
        camera = outputs.PinholeCamera.looking_at(middle, eye, width=320, height=240)
        skin = (out.skin, skin_faces)
        points = measured(outputs.depth_image([(moment.truth, faces), skin], camera), camera, rng, noise=noise)
        seen = moment.truth[outputs.visible(moment.truth, faces, camera, [skin])]

        def off(vertices: NDArray[np.float32], seen: Points = seen) -> float:
            square = igl.point_mesh_squared_distance(seen, vertices.astype(np.float64), faces)[0]
            return 1e3 * float(np.sqrt(square).mean())

        plain.append(off(out[garment].local))
        if keeps and len(plain) % 5 == 0:  # every fifth frame has no points: what was learnt has to suffice
            foreseen.append((plain[-1], off(observer(moment.frame)[garment].local)))
            continue
        done = observer(moment.frame, points + moment.frame.transl, eye=eye + moment.frame.transl)
        followed.append(off(done[garment].local))
        inside += done.stats.garments[garment].n_unresolved
        compared.append(plain[-1])
    before, after = np.mean(compared), np.mean(followed)
    print(
        f"observed   {garment:16} {'in motion ' if keeps else ''}{len(moments)} frames, noise {1e3 * noise:g} mm: "
        f"visible error {before:.2f} → {after:.2f} mm (-{100 * (1 - after / before):.0f} %), "
        f"worst {max(plain):.1f} → {max(followed):.1f}; {inside} vertices inside the body"
    )
    if foreseen:
        before, after = np.mean(foreseen, axis=0)
        print(f"observed   {garment:16} in motion, frames without points: {before:.2f} → {after:.2f} mm")


def times() -> None:
    """Times each part on the T-shirt and shorts of one person."""
    pipeline = GarmentPipeline.load(["tshirt-male", "short-pant-male"])
    shirt = pipeline.garments["tshirt-male"]
    pose = np.zeros((24, 3))
    pose[16, 2], pose[17, 2] = -1.1, 1.1
    frame = SmplFrame(pose=pose)
    out = pipeline(frame)
    worn, body = out["tshirt-male"].local, (out.body, pipeline.body.faces.numpy())
    meshes = [(out[name].local, out[name].faces) for name in out]
    camera = outputs.PinholeCamera.looking_at([0, 0, 0], [0.3, 0.4, 2.2], width=320, height=240)
    depth = outputs.depth_image([*meshes, body], camera)
    points = measured(depth, camera, np.random.default_rng(0))
    rims, solid, every = outputs.Openings(shirt), outputs.PlannerMesh.of(pipeline, shirt.name), outputs.Sigma(pipeline)
    clear, limbs, observer = outputs.Clearance.of(pipeline), outputs.LimbContacts.of(pipeline), Observer(pipeline)
    spread = np.tile(1e-4 * np.eye(3), (24, 1, 1))
    turned = [SmplFrame(pose=pose + 1e-4 * i) for i in range(40)]
    order = iter(turned * 20)
    parts: dict[str, Callable[[], object]] = {
        "openings of a T-shirt": lambda: rims.frames(worn),
        "planner mesh of a T-shirt": lambda: solid.solid(worn),
        "clearance, both garments": lambda: clear(out),
        "limb contacts, both garments": lambda: limbs(out),
        "visible, both garments and body": lambda: outputs.all_visible([*meshes, body], camera),
        "sigma": lambda: every(frame, out),
        "sigma with the pose's covariance": lambda: every(frame, out, pose_covariance=spread),
        "a frame of the pipeline": lambda: pipeline(next(order)),
        "a frame with points": lambda: observer(next(order), points, eye=camera.eye),
    }
    for name, part in parts.items():
        part()
        took = []
        for _ in range(30):
            start = time.perf_counter()
            part()
            took.append(1e3 * (time.perf_counter() - start))
        print(f"times      {name}: {statistics.median(took):.2f} ms")


PARTS = {
    "openings": openings,
    "planner": planner,
    "sigma": sigma,
    "observation": observation,
    "times": times,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help=f"of {', '.join(PARTS)}; all by default")
    torch.set_num_threads(1)
    for name in parser.parse_args().parts or PARTS:
        PARTS[name]()


if __name__ == "__main__":
    main()
