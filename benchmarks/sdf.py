"""How right the signed distances are, ours and others', where bodies fold; `refu benchmark` says only what they cost.

    python benchmarks/sdf.py [--garment tshirt-male] [--rounds 10] [--poses 6] [--network] [--json FILE]

Every method gets the same poses, in turn, by the processor's time; the ratio is to Warp's refit and query.
Errors are to the exact distance, of vertices within 2 cm of the skin; "missed" are vertices deeper inside than 2 mm
that are taken to be outside, a pose. Half of the poses bend limbs at random; the others bring limbs together (squat,
crossed arms, hands on hips). The garments are skinned and disturbed by 8 mm, so that they run into the body.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # before any library reads it

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core.benchmark import PLAIN_QUERY, SdfFrame, SdfMethod, measure, one_core, sdf_methods
from refu_core.body import SmplBody, load_body
from refu_core.garments import GarmentTemplate, load_garment
from refu_core.sdf import ApproxSdf

Array = NDArray[np.float32]
EXACT = "exact, unfiltered"
NEAR, DEEP = 0.02, 0.002  # [m]


def walk_again(body: SmplBody) -> SdfMethod:
    """As in a video: every vertex starts at its face in the last frame, here found beforehand."""
    sdf = ApproxSdf(body)
    faces: dict[int, Tensor | None] = {}

    def ask(frame: SdfFrame) -> Array:
        sdf.update(torch.from_numpy(frame.body))
        sample = sdf.query(torch.from_numpy(frame.garment), near=faces.get(id(frame)))
        faces[id(frame)] = sample.face
        answer: Array = sample.distance.numpy()
        return answer

    return SdfMethod("walk, from last frame's faces", "other", ask)


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


def frames(body: SmplBody, garment: GarmentTemplate, n: int) -> list[SdfFrame]:
    """Bodies of drawn shapes in these poses, and what they wear."""
    generator = torch.Generator().manual_seed(1)
    pose, betas = poses(n), torch.randn(n, 10, generator=generator)
    waves, phase = 12 * torch.randn(3, 24, generator=generator), 6.3 * torch.rand(24, generator=generator)
    shift = torch.sin(garment.v_template @ waves + phase) @ torch.randn(24, 3, generator=generator)
    shift *= 0.008 / shift.square().sum(1).mean().sqrt()
    output = body(pose, betas)
    worn = garment.pose(garment.rest(betas) + shift, output.transforms)
    return [
        SdfFrame(output.vertices[k].numpy(), worn[k].numpy(), garment.v_template + shift, pose[k], betas[k])
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


def rows(garment: GarmentTemplate, *, n_poses: int, rounds: int, network: bool) -> list[dict[str, Any]]:
    """Times and errors of every method, those of the paper's untrained network without errors."""
    body = load_body(garment.body)
    worn = frames(body, garment, n_poses)
    methods, missing = sdf_methods(body, garment, network=network)
    methods.append(walk_again(body))
    for name, need in missing.items():
        print(f"not measured: {name}: {need}")
    answers = {method.name: [method.ask(frame) for frame in worn] for method in methods if method.is_trained}
    # Poses have nothing to do with each other, so every one is warmed up by the one before.
    pairs = [[worn[k - 1], frame] for k, frame in enumerate(worn)]
    slow = [method.name for method in methods if method.is_slow]
    times = measure({method.name: method.ask for method in methods}, pairs, rounds=rounds, slow=slow)
    unit = times[PLAIN_QUERY].median
    found = []
    for method in methods:
        low, high = times[method.name].quartiles
        median = times[method.name].median
        row = {"stage": "sdf", "mode": method.mode, "method": method.name, "garment": garment.name}
        row |= {"ms_median": median, "ms_q1": low, "ms_q3": high, "ratio": median / unit}
        if method.is_trained:
            row |= errors(answers[method.name], answers[EXACT], clipped=method.is_clipped)
        found.append(row)
    return found


def main() -> None:
    """Prints a table, and writes it as JSON where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garment", default="tshirt-male")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--network", action="store_true", help="also the paper's network: some seconds a pose")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    args = parser.parse_args()
    garment = load_garment(args.garment)
    with one_core():
        found = rows(garment, n_poses=args.poses, rounds=args.rounds, network=args.network)
    print(f"{garment.name}, {garment.n_vertices} vertices, {args.poses} poses; errors within 2 cm of the skin")
    figures = f"{'mean mm':>8} {'p99 mm':>7} {'sign %':>7} {'missed':>7}"
    print(f"{'method':40} {'ms':>8} {'quartiles':>17} {'ratio':>7} {figures}")
    for row in found:
        line = (
            f"{row['method']:40} {row['ms_median']:8.2f} {row['ms_q1']:7.2f} … {row['ms_q3']:7.2f} {row['ratio']:7.3f}"
        )
        if "missed" in row:
            line += f" {row['mean_error_mm']:8.4f} {row['p99_error_mm']:7.3f} {row['other_sign_percent']:7.3f}"
            line += f" {row['missed']:7.2f}"
        print(line)
    if args.json:
        args.json.write_text(json.dumps({"rows": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
