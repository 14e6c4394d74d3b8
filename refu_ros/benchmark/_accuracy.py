"""How right the garments are: frames with ground truth, measured as `refu replay` measures them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import msg_adapters as adapters
from refu_core import GarmentPipeline
from refu_core.evaluation import CollisionChecker, GarmentMetrics
from refu_ros.truth import GroundTruth

FIGURES = ("mpve_mm", "vfcp_percent", "cfmp_percent", "max_depth_mm")
Key = TypeVar("Key")


def truth_bag(garment: str, bags: Path) -> Path | None:
    """The bag of unseen bodies with the true garment, None where there is none."""
    path = bags / f"eval_{garment.replace('-', '_')}"
    return path if path.is_dir() else None


def accuracies(
    pipelines: Mapping[Key, GarmentPipeline],
    garment: str,
    bag: Path,
    *,
    frames: int | None,
    progress: Callable[[], None],
) -> dict[Key, dict[str, float]]:
    """MPVE [mm], VFCP and CFMP [%] and the greatest depth [mm] of each pipeline in up to `frames` frames of a bag.

    Raises:
        RefuError: the bag can't be read.
    """
    one = next(iter(pipelines.values()))
    faces = one.garments[garment].faces.cpu().numpy()
    checker = CollisionChecker(one.body.faces.cpu().numpy())
    truth = GroundTruth.of_bag(bag, {garment: faces})
    metrics = {key: GarmentMetrics(faces) for key in pipelines}
    with adapters.open_smpl_bag(bag) as source:
        for record in itertools.islice(source, frames):
            if record.frame is None:
                continue
            for i, (key, pipeline) in enumerate(pipelines.items()):
                output = pipeline(record.frame)
                if i == 0:  # they all dress the same body
                    checker.update(output.body)
                vertices = output[garment].local
                found = checker.check(vertices, faces)
                metrics[key].add(vertices, found, truth=truth.of(garment, record.frame))
                progress()
    summaries = {key: one.summary().all.as_dict() for key, one in metrics.items()}
    return {key: {name: float(s[name]) for name in FIGURES if s[name] is not None} for key, s in summaries.items()}
