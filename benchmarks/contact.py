"""What half and twice of each number of `ContactSettings` do on recorded motion; writes contact.md.

    python benchmarks/contact.py MOTIONS [--every 60] [--output docs/results]

MOTIONS is a folder of AMASS-style npz files at 60 Hz. Mode `hybrid`, β = 0; every so many frames one is judged, and
none is left out. Figures are those of `refu evaluate --table motion`.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from tqdm import tqdm

from msg_adapters import Motion, read_motion
from refu_core import GarmentPipeline
from refu_core.contact import DEFAULT_CONTACT, ContactSettings
from refu_lab.reproduction import OutfitJudge, figures_of, frame_pair

TOGETHER, SKIRT = ("shirt-male", "short-pant-male"), ("skirt-female",)
OUTFITS = (TOGETHER, SKIRT)
OF_TOGETHER = ("layer_", "unfold_", "parting")
"""Beginnings of names of what matters to garments worn together alone."""
COLUMNS = {
    "cfmp_percent": ("free %", "{:.1f}"),
    "max_depth_mm": ("deepest mm", "{:.1f}"),
    "layers_cut_percent": ("cut %", "{:.1f}"),
    "jump_20_percent": ("jumps %", "{:.1f}"),
    "jump_max_mm": ("largest mm", "{:.0f}"),
    "stretched_percent": ("torn %", "{:.4f}"),
    "self_crossings": ("own crossings", "{:.0f}"),
}
GARMENTS = {"shirt-male": "shirt", "short-pant-male": "shorts", "skirt-female": "skirt"}
ABOUT = """# Collision handling: what half and twice of each setting do

Shirt over shorts, and a skirt, mode `hybrid`, β = 0: {count} frames of recorded motion each, none left out. By
`benchmarks/contact.py`. One frame more or less is {one:.1f} %.

Free: of collisions with the body. Cut: through the shorts. Jumps: frames in which a vertex moves more than 20 mm
farther in 1/60 s than the skinned garment. Torn: edges twice as long as at rest. Own crossings: pairs of the garment's
faces, a frame.
"""


class Change(NamedTuple):
    """A setting of another value."""

    name: str
    text: str
    settings: ContactSettings


def changes() -> Iterator[Change]:
    """The default, then half and twice of each number; whole ones stay whole, even ones even, and none is zero."""
    yield Change("default", "", DEFAULT_CONTACT)
    for field in dataclasses.fields(ContactSettings):
        value = getattr(DEFAULT_CONTACT, field.name)
        for factor in (0.5, 2.0):
            if isinstance(value, tuple):
                other: object = tuple(factor * part for part in value)
            elif isinstance(value, int):
                least = 2 - value % 2
                other = max(least, int(factor * value) // least * least)
            else:
                other = factor * value
            if other == value:
                continue
            settings = dataclasses.replace(DEFAULT_CONTACT, **{field.name: other})
            yield Change(f"`{field.name}`", f"{value} → {other}", settings)


def figures(
    outfit: tuple[str, ...], settings: ContactSettings, clips: list[Motion], every: int
) -> dict[str, dict[str, float | None]]:
    """By garment, over all frames."""
    judge = OutfitJudge(outfit, {"hybrid": GarmentPipeline.load(outfit, contact=settings)})
    found: dict[str, list[object]] = {}
    for clip in clips:
        for index in range(0, len(clip) - 1, every):
            for (garment, _), judged in judge.judge(frame_pair(clip, index))[0].items():
                found.setdefault(garment, []).append(judged)
    return {garment: figures_of(ones) for garment, ones in found.items()}


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", type=Path)
    parser.add_argument("--every", type=int, default=60)
    parser.add_argument("--output", type=Path, default=Path("docs/results"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    clips = [read_motion(file) for file in sorted(args.motions.glob("*.npz"))]
    count = sum(len(range(0, len(clip) - 1, args.every)) for clip in clips)
    rows: dict[str, list[str]] = {garment: [] for outfit in OUTFITS for garment in outfit}
    for change in tqdm(list(changes())):
        for outfit in OUTFITS:
            if outfit == SKIRT and change.name.strip("`").startswith(OF_TOGETHER):
                continue
            for garment, values in figures(outfit, change.settings, clips, args.every).items():
                cells = [
                    "" if values[metric] is None else form.format(values[metric])
                    for metric, (_, form) in COLUMNS.items()
                ]
                rows[garment].append(f"| {change.name} | {change.text} | {' | '.join(cells)} |")
    lines = [ABOUT.format(count=count, one=100 / count)]
    for garment, made in rows.items():
        lines += [f"## {GARMENTS[garment]}", ""]
        lines += [f"| setting | value | {' | '.join(title for title, _ in COLUMNS.values())} |"]
        lines += ["| --- | --- |" + " ---: |" * len(COLUMNS), *made, ""]
    args.output.mkdir(parents=True, exist_ok=True)
    (args.output / "contact.md").write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
