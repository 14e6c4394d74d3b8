"""Real motion: the metrics that need no ground truth, clip by clip."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.errors import RefuError
from refu_core.evaluation.collisions import CollisionChecker
from refu_core.evaluation.jitter import temporal_jitter
from refu_core.evaluation.metrics import GarmentMetrics
from refu_core.evaluation.reproduction._load import Library
from refu_core.evaluation.reproduction._methods import METHODS
from refu_core.evaluation.reproduction._tables import Missing, Row, Table, weighted
from refu_core.evaluation.self_contact import SelfContactDetector
from refu_core.frames import SmplFrame
from refu_core.realtime import GarmentPipeline

MOTION_METHODS: tuple[str, ...] = (
    "skinned",
    "node-skinned",
    "tailornet",
    "node-approx",
    "node-accurate",
    "node-hybrid",
)
"""What is shown for every clip, in the order of the rows."""
_AWAY = ", away from self-contact"
_METRICS = ("vfcp_percent", "cfmp_percent", "max_depth_mm")


@dataclass(eq=False)
class Clip:
    """A recorded motion."""

    name: str
    frames: Sequence[SmplFrame]


def motion_table(
    clips: Sequence[Clip],
    garments: Sequence[str],
    *,
    library: Library,
    every: int,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """VFCP, CFMP, depth and jitter of each clip, overall and away from where the body touches itself.

    Args:
        clips: Recorded motions.
        garments: Built-in garments, each worn alone.
        library: Where trained networks are.
        every: Every so many frames three consecutive ones are dressed; the middle one is checked for collisions.
        progress: Called with (frames done, frames in all).
    """
    table = Table(
        "motion",
        "Recorded motion",
        "Recorded motion (CMU motion capture) has no ground truth: what is measured is how free of the body the "
        "garments are, and how calm. Where the body touches itself (an arm in the flank) no garment can be free of it; "
        'such frames are never left out, the rows "away from self-contact" leave out the vertices near such places. '
        "Jitter is the mean length of x(t+1) - 2 x(t) + x(t-1): the moving body's own acceleration is in it, so "
        "compare it with the skinned template's.",
    )
    middles = [range(1, len(clip.frames) - 1, every) for clip in clips]
    total, done = len(garments) * sum(len(m) for m in middles), 0
    for garment in garments:
        pipelines: dict[str, GarmentPipeline] = {}
        for name in MOTION_METHODS:
            method = METHODS[name]
            try:
                pipelines[name] = library.pipeline(method, garment)
            except RefuError as error:
                table.missing.append(Missing(garment, name, str(error), method.train_command(garment)))
        rows: list[Row] = []
        groups = []
        for clip, frames in zip(clips, middles, strict=True):
            worn = _Wear(garment, pipelines, clip.frames[0].betas)
            for middle in frames:
                worn.add(clip.frames[middle - 1 : middle + 2])
                done += 1
                if progress is not None:
                    progress(done, total)
            if frames:
                rows += worn.rows(f"{garment}, {clip.name}")
                groups.append((f"{garment}, {clip.name}", len(frames)))
        table.rows += [*_over_clips(garment, rows, groups), *rows]
    return table


class _Wear:
    """One garment, as every method makes it, over a clip."""

    def __init__(self, garment: str, pipelines: Mapping[str, GarmentPipeline], betas: NDArray[np.float32]) -> None:
        self._garment = garment
        self._pipelines = pipelines
        body = pipelines["skinned"].body
        self._faces = pipelines["skinned"].garments[garment].faces.numpy()
        self._checker = CollisionChecker(body.faces)
        # Faces that overlap in the rest pose already (toes) depend on the shape.
        self._detector = SelfContactDetector(body.faces, body.rest_vertices(torch.tensor(betas)[None])[0])
        self._metrics = {name: GarmentMetrics(self._faces) for name in pipelines}
        self._jitter: dict[str, list[float]] = {name: [] for name in pipelines}

    def add(self, frames: Sequence[SmplFrame]) -> None:
        """Takes in three consecutive frames."""
        contact = None
        for name, pipeline in self._pipelines.items():
            outputs = pipeline(frames)
            if contact is None:
                self._checker.update(outputs[1].body)
                contact = self._detector.detect(outputs[1].body)
            local = outputs[1][self._garment].local
            self._metrics[name].add(local, self._checker.check(local, self._faces), near_contact=contact.near(local))
            self._jitter[name].append(temporal_jitter(*(output[self._garment].vertices for output in outputs)))

    def rows(self, group: str) -> list[Row]:
        """Overall and away from self-contact, method by method."""
        rows = []
        for name, metrics in self._metrics.items():
            summary = metrics.summary()
            rows += [Row.of("motion", group, name, metric, getattr(summary.all, metric)) for metric in _METRICS]
            rows.append(Row.of("motion", group, name, "jitter_mm", float(np.mean(self._jitter[name]))))
            away = summary.contact_free_vertices
            rows += [Row.of("motion", group, name + _AWAY, metric, getattr(away, metric)) for metric in _METRICS]
        return rows


def _over_clips(garment: str, rows: Sequence[Row], groups: Sequence[tuple[str, int]]) -> list[Row]:
    """All clips of a garment together: the deepest depth, means weighted by frames; None for what isn't trained."""
    value = {(row.garment, row.method, row.metric): row.value for row in rows}
    summed = []
    for method in dict.fromkeys([*(row.method for row in rows), *MOTION_METHODS]):
        for metric in (*_METRICS, "jitter_mm"):
            known = [(v, n) for group, n in groups if (v := value.get((group, method, metric))) is not None]
            deepest, mean = max((v for v, _ in known), default=None), weighted(known)
            kept = deepest if metric == "max_depth_mm" else mean
            summed.append(Row.of("motion", f"{garment}, all clips", method, metric, kept))
    return summed


def motion_labels() -> dict[str, str]:
    """The names of the table's rows for people."""
    return {name + end: METHODS[name].label + end for name in MOTION_METHODS for end in ("", _AWAY)}
