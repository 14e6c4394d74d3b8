"""Compare figures of the bags, with the weights that ship, with those kept in docs/results/quick.json.

    python scripts/check_figures.py
    python scripts/check_figures.py --set

Exits with 1 where a figure is worse by more than its tolerance, or missing; `--set` writes the file anew.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

from refu_core.modes import DEFAULT_GARMENTS
from refu_lab.commands.replay import ReplayOptions
from refu_lab.fleet.replay import pipeline_for
from refu_lab.replay import replay
from refu_lab.reproduction import METRICS
from refu_lab.sources import open_source
from refu_lab.tables import write_json
from refu_lab.truth import garments_of

ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "docs" / "results" / "quick.json"
TOLERANCES: dict[str, float] = {"mpve_mm": 0.3, "vfcp_percent": 0.02, "cfmp_percent": 7.0, "max_depth_mm": 1.0}
"""How much worse a figure may be than its reference: as much as other processors and releases of torch change with the
same weights, far less than a worse method would."""
FRAMES = 15
"""Frames of a bag, at most."""
MODES = (("skinned", "accurate"), ("auto", "hybrid"))
"""(backbone, sdf) of the pipelines that are measured."""
Figures = dict[tuple[str, str, str, str], float]
"""By bag, garment, method and metric."""


def figures_of(bag: Path) -> Figures:
    """What a replay measures in a bag, before and after collisions are removed."""
    found: Figures = {}
    for backbone, sdf in MODES:
        garments = tuple(garments_of(bag)) or DEFAULT_GARMENTS
        options = ReplayOptions(input=bag, max_frames=FRAMES, garments=garments, backbone=backbone, sdf=sdf)
        result = replay(options, source=open_source(options, pipeline_for(options)))
        for garment in options.garments:
            methods = {backbone: result.before[garment], f"node, {backbone}, {sdf}": result.after[garment]}
            for (method, figures), metric in product(methods.items(), TOLERANCES):
                value = getattr(figures, metric)
                if value is not None:
                    found[bag.stem, garment, method, metric] = value
    return found


def fallen(found: Mapping[Any, float], known: Mapping[Any, float]) -> list[str]:
    """A line for each figure that is worse than its reference by more than the tolerance, or missing."""
    lines = []
    for key, reference in known.items():
        value, tolerance = found.get(key), TOLERANCES[key[-1]]
        loss = float("inf") if value is None else value - reference
        if value is not None and METRICS[key[-1]].higher_is_better:
            loss = -loss
        if loss > tolerance:
            lines.append(f"{', '.join(key)}: {value}, the reference is {reference:.4g}, tolerance {tolerance:g}")
    return lines


def write(found: Figures, file: Path = REFERENCE) -> None:
    names = ("bag", "garment", "method", "metric")
    rows = [{**dict(zip(names, key, strict=True)), "value": value} for key, value in found.items()]
    write_json(file, {"about": "scripts/check_figures.py holds its figures against these", "rows": rows})


def read(file: Path = REFERENCE) -> Figures:
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    return {(row["bag"], row["garment"], row["method"], row["metric"]): row["value"] for row in rows}


def bags() -> Iterable[Path]:
    return sorted(path.parent for path in (ROOT / "bags").glob("*/metadata.yaml"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", action="store_true", help="write the reference anew")
    arguments = parser.parse_args()
    found = {key: value for bag in bags() for key, value in figures_of(bag).items()}
    if arguments.set:
        write(found)
        print(f"wrote {REFERENCE}")
        return
    lines = fallen(found, read())
    print("\n".join([*lines, f"{len(lines)} of {len(found)} figures have fallen"]))
    parser.exit(1 if lines else 0)


if __name__ == "__main__":
    main()
