"""What the collider costs, and what half and twice of each of its numbers do, on recorded motion.

python benchmarks/collider.py motions/ --output docs/results
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core import load_body, load_garment
from refu_core._warp import as_warp
from refu_core.body import Collider, ColliderSettings, SmplBody
from refu_core.metrics import SelfContactDetector
from refu_lab.benchmark._sdfs import plain_kernel

REACH = 0.02
"""Skin at most this far from a built-in garment at rest counts as within its reach [m]."""
GARMENTS = ("tshirt-male", "short-pant-male", "shirt-male")


class Bench:
    """Poses of a folder, sampled, and what the collider does to them."""

    def __init__(self, folder: Path, stride: int) -> None:
        self.body: SmplBody = load_body("male")
        clips = [np.load(path)["poses"][:, :72].reshape(-1, 24, 3) for path in sorted(folder.glob("*.npz"))]
        self.poses = np.concatenate([clip[::stride] for clip in clips])
        self.pairs = [(clip[i], clip[i + 1]) for clip in clips for i in range(0, len(clip) - 1, 4 * stride)]
        rest = self.body.v_template.numpy()
        self.detector = SelfContactDetector(self.body.faces, rest)
        worn = torch.cat([load_garment(name).v_template for name in GARMENTS])
        is_near = torch.cdist(self.body.v_template, worn).amin(dim=1) < REACH
        self.near = is_near[self.body.faces].any(dim=1).numpy()

    def measure(self, settings: ColliderSettings) -> dict[str, float]:
        """How many frames are free of intersections near a garment, how far skin is shifted, and how it leaps."""
        collider = Collider(self.body, settings=settings)
        free, shift, moved = [], [], []
        for pose in self.poses:
            skin, apart = self._apart(collider, pose)
            pairs = self.detector.detect(apart).pairs
            free.append(not self.near[pairs].any())
            away = np.linalg.norm(apart - skin, axis=1)
            shift.append(away.max())
            moved.append((away > 1e-4).mean())
        leaps = []
        for first, second in self.pairs:
            (skin, apart), (skin_, apart_) = (self._apart(collider, pose) for pose in (first, second))
            went = np.linalg.norm(apart_ - apart, axis=1) - 1.5 * np.linalg.norm(skin_ - skin, axis=1)
            leaps.append(went.max())
        return {
            "free_percent": 100 * float(np.mean(free)),
            "median_shift_mm": 1e3 * float(np.median(shift)),
            "largest_shift_mm": 1e3 * float(np.max(shift)),
            "moved_percent": 100 * float(np.mean(moved)),
            "largest_leap_mm": 1e3 * float(np.max(leaps)),
        }

    def _apart(self, collider: Collider, pose: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        skin = self.body(pose=pose[None])
        return skin.vertices[0].numpy(), collider(skin.vertices, skin.transforms)[0].numpy()

    def cost(self) -> dict[str, float]:
        """The collider's time by that of the plain query of a T-shirt (BVH refitted, every vertex asked), medians."""
        collider, garment = Collider(self.body), load_garment("tshirt-male")
        distance = torch.zeros(garment.n_vertices)
        points, gradient = (torch.zeros(garment.n_vertices, 3) for _ in range(2))
        posed = torch.zeros_like(self.body.v_template).copy_(self.body.v_template)
        tree = wp.Mesh(as_warp(posed, wp.vec3), as_warp(self.body.faces.int().view(-1), wp.int32))
        took: dict[str, list[float]] = {"plain": [], "motion": [], "rest": []}
        rest = self.body(pose=np.zeros((1, 24, 3)))
        for pose in [*self.poses, *self.poses]:
            skin = self.body(pose=pose[None])
            posed.copy_(skin.vertices[0])
            points.copy_(garment.pose(garment.v_template[None], skin.transforms)[0])
            start = time.process_time()
            tree.refit()
            inputs = [tree.id, as_warp(points, wp.vec3), as_warp(distance, wp.float32), as_warp(gradient, wp.vec3)]
            wp.launch(plain_kernel, len(points), inputs, device="cpu")
            took["plain"].append(time.process_time() - start)
            for name, one in (("motion", skin), ("rest", rest)):
                start = time.process_time()
                collider(one.vertices, one.transforms)
                took[name].append(time.process_time() - start)
        median = {name: float(np.median(times)) for name, times in took.items()}
        return {
            "plain_query_ms": 1e3 * median["plain"],
            "motion": median["motion"] / median["plain"],
            "nothing_near": median["rest"] / median["plain"],
        }


def main() -> None:
    """Writes collider.json and collider.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of AMASS-style .npz")
    parser.add_argument("--stride", type=int, default=60, help="every so many frames")
    parser.add_argument("--output", type=Path, default=Path())
    parser.add_argument("--cost-only", action="store_true")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    bench = Bench(asked.folder, asked.stride)
    cost = bench.cost()
    print(json.dumps(cost))
    if asked.cost_only:
        return
    shipped = ColliderSettings()
    rows = {"as shipped": bench.measure(shipped)}
    for field in fields(shipped):
        value = getattr(shipped, field.name)
        for factor in (0.5, 2):
            changed = type(value)(value * factor)
            rows[f"{field.name} = {changed:g}"] = bench.measure(replace(shipped, **{field.name: changed}))
            print(field.name, changed, rows[f"{field.name} = {changed:g}"], flush=True)
    report = {"cost": cost, "frames": len(bench.poses), "settings": asdict(shipped), "rows": rows}
    (asked.output / "collider.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (asked.output / "collider.md").write_text(_page(report), encoding="utf-8")


def _page(report: dict[str, Any]) -> str:
    lines = [
        "# The collider: cost, and what its numbers do",
        "",
        f"`python benchmarks/collider.py`, {report['frames']} frames of recorded motion, male body. *Free*: no",
        "intersection within 2 cm of a garment that the rest pose lacks. *Leap*: the farthest that skin moves",
        "from a frame at 60 Hz to the next, beyond 1.5 times what it moves without the collider.",
        "",
        f"Cost by the plain query of a T-shirt: {report['cost']['motion']:.3f} in motion, "
        f"{report['cost']['nothing_near']:.3f} where nothing is near.",
        "",
        "| | free % | median of largest shifts [mm] | largest shift [mm] | skin moved % | largest leap [mm] |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, row in report["rows"].items():
        lines.append(f"| {name} | " + " | ".join(f"{value:.1f}" for value in row.values()) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
