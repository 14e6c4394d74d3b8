"""How right the garments are: frames with ground truth, measured as `refu replay` measures them."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import msg_adapters as adapters
from refu_core import GarmentPipeline
from refu_core.evaluation.reproduction import METRICS
from refu_ros.replay import Evaluator
from refu_ros.truth import GroundTruth

FIGURES = ("mpve_mm", "vfcp_percent", "cfmp_percent", "max_depth_mm")
assert set(FIGURES) <= set(METRICS)


def truth_bag(garment: str, bags: Path) -> Path | None:
    """The bag of unseen bodies with the true garment, None where there is none."""
    path = bags / f"eval_{garment.replace('-', '_')}"
    return path if path.is_dir() else None


def accuracy(
    pipeline: GarmentPipeline, garment: str, bag: Path, *, frames: int | None, progress: Callable[[], None]
) -> dict[str, float]:
    """MPVE [mm], VFCP and CFMP [%] and the greatest depth [mm] of the garment in up to `frames` frames of a bag.

    Raises:
        RefuError: the bag can't be read.
    """
    faces = {garment: pipeline.garments[garment].faces.cpu().numpy()}
    evaluator = Evaluator(pipeline, GroundTruth.of_bag(bag, faces))
    with adapters.open_smpl_bag(bag) as source:
        for record in itertools.islice(source, frames):
            if record.frame is not None:
                evaluator.add(record.frame, pipeline(record.frame), 0.0)
                progress()
    figures = evaluator.after[garment].summary().all.as_dict()
    return {name: float(figures[name]) for name in FIGURES if figures[name] is not None}
