"""How right the garments are: frames with ground truth, measured as `refu replay` measures them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import msg_adapters as adapters
from refu_core import GarmentPipeline
from refu_core.metrics import CollisionChecker, GarmentMetrics
from refu_lab.truth import GroundTruth

FIGURES = ("mpve_mm", "vfcp_percent", "cfmp_percent", "max_depth_mm")
Key = TypeVar("Key")


def accuracies(
    pipelines: Mapping[Key, GarmentPipeline],
    garment: str,
    bags: Path,
    *,
    frames: int | None,
    progress: Callable[[], object],
) -> dict[Key, dict[str, float]]:
    """MPVE [mm], VFCP and CFMP [%] and the greatest depth [mm] of each pipeline in up to `frames` frames.

    They are those of the bag of unseen bodies with the true garment, `eval_<garment>`; empty where there is none.

    Raises:
        RefuError: the bag can't be read.
    """
    bag = bags / f"eval_{garment.replace('-', '_')}"
    if not bag.is_dir():
        return {}
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
    summaries = {key: one.summary().as_dict() for key, one in metrics.items()}
    return {key: {name: float(s[name]) for name in FIGURES if s[name] is not None} for key, s in summaries.items()}
