"""Real motion: the metrics that need no ground truth, clip by clip."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from refu_core.errors import RefuError
from refu_core.frames import SmplFrame
from refu_core.metrics import CollisionChecker, GarmentMetrics, temporal_jitter
from refu_core.realtime import GarmentPipeline
from refu_lab.body_contact import BodyContact
from refu_lab.reproduction._load import Library
from refu_lab.reproduction._methods import METHODS
from refu_lab.reproduction._tables import Missing, ResultRow, ResultTable, weighted

MOTION_METHODS = ("skinned", "node-skinned", "tailornet", "node-approx", "node-accurate", "node-hybrid")
"""What is shown for every clip, in the order of the rows."""
_AWAY = ", away from self-contact"
_METRICS = ("vfcp_percent", "cfmp_percent", "max_depth_mm")


def motion_table(
    clips: Mapping[str, Sequence[SmplFrame]],
    garments: Sequence[str],
    *,
    library: Library,
    every: int,
    progress: Callable[[int, int], None] | None = None,
) -> ResultTable:
    """VFCP, CFMP, depth and jitter of each clip, overall and away from where the body touches itself.

    Args:
        clips: Recorded motions by name.
        garments: Built-in garments, each worn alone.
        library: Where trained networks are.
        every: Every so many frames three consecutive ones are dressed; the middle one is checked for collisions.
        progress: Called with (frames done, frames in all).
    """
    table = ResultTable(
        "motion",
        "Recorded motion",
        "Recorded motion (CMU motion capture) has no ground truth: what is measured is how free of the body the "
        "garments are, and how calm. Where the body touches itself (an arm in the flank) no garment can be free of it; "
        'such frames are never left out, the rows "away from self-contact" leave out the vertices near such places. '
        "Jitter is the mean length of x(t+1) - 2 x(t) + x(t-1): the moving body's own acceleration is in it, so "
        "compare it with the skinned template's.",
        labels={name + end: METHODS[name].label + end for name in MOTION_METHODS for end in ("", _AWAY)},
    )
    middles = {name: range(1, len(frames) - 1, every) for name, frames in clips.items()}
    total, done = len(garments) * sum(map(len, middles.values())), 0
    for garment in garments:
        pipelines: dict[str, GarmentPipeline] = {}
        for name in MOTION_METHODS:
            method = METHODS[name]
            try:
                pipelines[name] = library.pipeline(method, garment)
            except RefuError as error:
                table.missing.append(Missing(garment, name, str(error), method.train_command(garment)))
        contact = BodyContact(pipelines["skinned"].body)
        rows: list[ResultRow] = []
        counts: dict[str, int] = {}
        for name, frames in clips.items():
            worn = _WornClip(garment, pipelines, contact)
            for middle in middles[name]:
                worn.add(frames[middle - 1 : middle + 2])
                done += 1
                if progress is not None:
                    progress(done, total)
            if middles[name]:
                group = f"{garment}, {name}"
                rows += worn.rows(group)
                counts[group] = len(middles[name])
        table.rows += [*_over_clips(garment, rows, counts), *rows]
    return table


class _WornClip:
    """One garment, as every method makes it, over a clip."""

    def __init__(self, garment: str, pipelines: Mapping[str, GarmentPipeline], contact: BodyContact) -> None:
        self._garment = garment
        self._pipelines = pipelines
        self._contact = contact
        self._faces = pipelines["skinned"].garments[garment].faces.numpy()
        self._checker = CollisionChecker(pipelines["skinned"].body.faces)
        self._metrics = {name: GarmentMetrics(self._faces) for name in pipelines}
        self._jitter: dict[str, list[float]] = {name: [] for name in pipelines}

    def add(self, frames: Sequence[SmplFrame]) -> None:
        """Takes in three consecutive frames."""
        contact = None
        for name, pipeline in self._pipelines.items():
            outputs = pipeline(frames)
            if contact is None:
                self._checker.update(outputs[1].body)
                contact = self._contact.detect(frames[1].betas, outputs[1].body)
            local = outputs[1][self._garment].local
            self._metrics[name].add(local, self._checker.check(local, self._faces), near_contact=contact.near(local))
            self._jitter[name].append(temporal_jitter(*(output[self._garment].vertices for output in outputs)))

    def rows(self, group: str) -> list[ResultRow]:
        """Overall and away from self-contact, method by method."""
        rows = []
        for name, metrics in self._metrics.items():
            summary = metrics.summary()
            rows += [ResultRow.of("motion", group, name, metric, getattr(summary.all, metric)) for metric in _METRICS]
            rows.append(ResultRow.of("motion", group, name, "jitter_mm", float(np.mean(self._jitter[name]))))
            away = summary.contact_free_vertices
            rows += [ResultRow.of("motion", group, name + _AWAY, metric, getattr(away, metric)) for metric in _METRICS]
        return rows


def _over_clips(garment: str, rows: Sequence[ResultRow], counts: Mapping[str, int]) -> list[ResultRow]:
    """All clips of a garment together: the deepest depth, means weighted by frames; None for what isn't trained."""
    value = {(row.garment, row.method, row.metric): row.value for row in rows}
    summed = []
    for method in dict.fromkeys([*(row.method for row in rows), *MOTION_METHODS]):
        for metric in (*_METRICS, "jitter_mm"):
            known = [(v, n) for group, n in counts.items() if (v := value.get((group, method, metric))) is not None]
            deepest, mean = max((v for v, _ in known), default=None), weighted(known)
            kept = deepest if metric == "max_depth_mm" else mean
            summed.append(ResultRow.of("motion", f"{garment}, all clips", method, metric, kept))
    return summed
