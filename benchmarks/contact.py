"""What half and twice of each number of `ContactSettings` do on recorded motion; writes contact.md.

    python benchmarks/contact.py MOTIONS [--pairs 60] [--output docs/results]

MOTIONS is a folder of AMASS-style npz files at 60 Hz. T-shirt and shorts are worn together, mode `hybrid`, β = 0; no
frame is left out. Networks run once a frame; collision handling once a frame and setting.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from msg_adapters import read_motion
from refu_core import GarmentPipeline
from refu_core.contact import DEFAULT_CONTACT, ContactSettings
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.modes import SdfMode
from refu_core.realtime import ContactStage, Outfit, Wearer
from refu_core.realtime._frame import FrameStep

GARMENTS = ("tshirt-male", "short-pant-male")
JUMP = 0.02
"""A vertex that goes this much farther than the raw garment's from frame to frame has jumped [m]."""


class Figures(NamedTuple):
    """Of one setting, over all frames."""

    cfmp: tuple[float, ...]
    """Frames free of body-garment collisions, by garment [%]."""
    inside: float
    """Vertices inside the body, both garments [%]."""
    cut: float
    """Frames in which the garments cut each other [%]."""
    jumps: float
    """Pairs of frames in which a vertex jumps [%]."""
    shift: float
    """Mean distance of vertices from those of the default settings [mm]."""


def chosen_pairs(motions: Path, count: int) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Poses (24, 3) [rad] of frames spread over all clips, each with the next one."""
    poses = [read_motion(file).poses for file in sorted(motions.glob("*.npz"))]
    starts = [(clip, t) for clip, found in enumerate(poses) for t in range(len(found) - 1)]
    picked = np.linspace(0, len(starts) - 1, count).astype(int)
    return [(poses[clip][t], poses[clip][t + 1]) for clip, t in (starts[i] for i in picked)]


class Sweep:
    """Frames dressed once, to be brought off the body by many settings."""

    def __init__(self, pairs: list[tuple[NDArray[np.float32], NDArray[np.float32]]]) -> None:
        pipeline = GarmentPipeline.load(GARMENTS, certify=False)
        self.outfit: Outfit = pipeline.outfit
        self.wearer = Wearer.of(self.outfit, torch.zeros(1, 10))
        self.poses = [tuple(torch.tensor(pose)[None] for pose in pair) for pair in pairs]
        self.checker = CollisionChecker(self.outfit.body.faces)
        self.faces = {name: one.template.faces.numpy() for name, one in self.outfit.wearables.items()}
        self.sheet = SheetChecker(self.faces[GARMENTS[1]])
        self.margins = [one.margin for one in self.outfit.wearables.values()]
        self.default: list[NDArray[np.float32]] = []

    @torch.no_grad()
    def run(self, settings: ContactSettings) -> Figures:
        """The figures of some settings; those of the default ones have to be the first."""
        step = FrameStep(self.outfit, ContactStage(self.outfit, sdf=SdfMode.HYBRID, certify=False, settings=settings))
        free, n_inside, n_vertices, n_cut, n_jumps, shifts = dict.fromkeys(GARMENTS, 0), 0, 0, 0, 0, []
        is_default = not self.default
        for i, pair in enumerate(self.poses):
            (first,), (second,) = (step(pose, self.wearer, self.margins) for pose in pair)
            self.checker.update(first.body)
            jump, worn = 0.0, []
            for name, one in first.garments.items():
                found = self.checker.check(one.vertices.numpy(), self.faces[name])
                free[name] += found.is_free
                n_inside, n_vertices = n_inside + found.n_inside, n_vertices + len(found.inside)
                other = second.garments[name]
                moved = (other.vertices - other.raw) - (one.vertices - one.raw)
                jump = max(jump, float(moved.norm(dim=1).max()))
                worn.append(one.vertices.numpy())
            n_jumps += jump > JUMP
            outer, inner = (first.garments[name].vertices.numpy() for name in GARMENTS)
            self.sheet.update(inner)
            n_cut += len(self.sheet.with_other(outer, self.faces[GARMENTS[0]])) > 0
            together = np.concatenate(worn)
            if is_default:
                self.default.append(together)
            shifts.append(np.linalg.norm(together - self.default[i], axis=1).mean())
        n = len(self.poses)
        return Figures(
            tuple(100 * free[name] / n for name in GARMENTS),
            100 * n_inside / n_vertices,
            100 * n_cut / n,
            100 * n_jumps / n,
            1e3 * float(np.mean(shifts)),
        )


def variants(value: float | tuple[float, ...]) -> list[float | tuple[float, ...]]:
    """Half and twice; whole numbers stay whole, and none is zero."""
    if isinstance(value, tuple):
        return [tuple(factor * part for part in value) for factor in (0.5, 2.0)]
    if isinstance(value, int):
        return [max(1, value // 2), 2 * value]
    return [0.5 * value, 2.0 * value]


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", type=Path)
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--output", type=Path, default=Path("docs/results"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    sweep = Sweep(chosen_pairs(args.motions, args.pairs))
    rows = [("default", "", sweep.run(DEFAULT_CONTACT))]
    for field in tqdm(dataclasses.fields(ContactSettings)):
        value = getattr(DEFAULT_CONTACT, field.name)
        for other in variants(value):
            try:
                found = sweep.run(dataclasses.replace(DEFAULT_CONTACT, **{field.name: other}))
            except Exception as error:  # a value that has no meaning
                rows.append((f"`{field.name}`", f"{value} → {other}: {error}", None))
                continue
            rows.append((f"`{field.name}`", f"{value} → {other}", found))
    lines = [
        "# Collision handling: what half and twice of each setting do",
        "",
        f"T-shirt over shorts, mode `hybrid`, β = 0, {args.pairs} frames of recorded motion and the frame after each.",
        "None is left out. Against the collider. By `benchmarks/contact.py`.",
        "",
        "CFMP: frames free of body-garment collisions. Cut: frames in which the garments cut each other. Jumps: pairs",
        "of frames in which a vertex moves more than 20 mm farther than the network's. Shift: mean distance of the",
        "vertices from those of the default settings.",
        "",
        "| setting | value | CFMP T-shirt % | CFMP shorts % | inside % | cut % | jumps % | shift mm |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, change, found in rows:
        if found is None:
            lines.append(f"| {name} | {change} | | | | | | |")
            continue
        numbers = [f"{one:.1f}" for one in (*found.cfmp, found.cut, found.jumps)]
        numbers[2:2] = [f"{found.inside:.3f}"]
        lines.append(f"| {name} | {change} | {' | '.join(numbers)} | {found.shift:.3f} |")
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "contact.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
