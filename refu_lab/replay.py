"""Replays recorded motion through the garment pipeline without ROS: bytes in, garments out, measured frame by frame."""

from __future__ import annotations

import itertools
import math
import sys
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from tqdm import tqdm

import msg_adapters as adapters
from msg_adapters import FrameRecord
from refu_core import GarmentPipeline, RefuError, SmplFrame
from refu_core._device import one_thread
from refu_core.metrics import CollisionChecker, Figures, GarmentMetrics
from refu_core.modes import BackboneName
from refu_core.realtime import PipelineOutput
from refu_lab.commands.replay import ReplayOptions
from refu_lab.dressed_bag import DressedBag, garment_meshes
from refu_lab.sources import Source, body_facts, open_source
from refu_lab.truth import GroundTruth

When = Literal["before", "after"]
"""Before or after collision handling."""
_MAX_REASONS = 20
"""Most reasons for skipping that are counted separately."""
_LONGEST_PAUSE_S = 60.0  # of a recording's pauses; longer ones are skipped
_TOLD_S = 0.2  # between two reports of progress


class Findings(NamedTuple):
    """What exact checks find in a frame, of one garment or of all together."""

    n_inside: int
    """Vertices inside the body."""
    n_pairs: int
    """Pairs of a garment's and the body's triangles that intersect."""
    max_depth: float
    """Depth of the deepest vertex [m]."""


@dataclass(frozen=True)
class GarmentRecord:
    """One garment in one frame, before and after collision handling."""

    latency_ms: float
    before: Findings
    after: Findings


@dataclass(frozen=True)
class FrameResult:
    """One replayed frame; enough to find it again and to plot it."""

    frame: SmplFrame
    latency_ms: float
    """From input bytes to output bytes."""
    stage_ms: Mapping[str, float]
    garments: Mapping[str, GarmentRecord]

    def total(self, when: When) -> Findings:
        """The findings of all garments together."""
        found: list[Findings] = [getattr(one, when) for one in self.garments.values()]
        deepest = max((one.max_depth for one in found), default=0.0)
        return Findings(sum(one.n_inside for one in found), sum(one.n_pairs for one in found), deepest)

    @property
    def badness(self) -> tuple[int, float, int, float]:
        """Orders frames from best to worst: first by the collisions that are left, then by those there were before."""
        before, after = self.total("before"), self.total("after")
        return after.n_inside + after.n_pairs, after.max_depth, before.n_pairs, before.max_depth


@dataclass(eq=False)
class ReplayResult:
    """Everything a table, a JSON file or a report needs."""

    options: ReplayOptions
    source: str
    """What was read: a topic and its type, or a motion file."""
    pipeline: GarmentPipeline
    frames: list[FrameResult] = field(default_factory=list)
    """The frames that were evaluated."""
    latencies_ms: array[float] = field(default_factory=lambda: array("d"))
    """Latency of each frame, from input bytes to output bytes."""
    shift_sum: float = 0.0
    """How far the collider is from the skin: the mean shift of all vertices, summed over the frames [m]."""
    shift_largest: float = 0.0
    """The largest shift of any vertex [m]."""
    skips: Counter[str] = field(default_factory=Counter)
    """Messages that were not replayed, by reason."""
    warnings: list[str] = field(default_factory=list)
    before: dict[str, Figures] = field(default_factory=dict)
    after: dict[str, Figures] = field(default_factory=dict)
    on_skin: dict[str, Figures] = field(default_factory=dict)
    """As `after`, but measured against the skin instead of the collider."""
    interrupted: bool = False

    def add(
        self, frame: SmplFrame, output: PipelineOutput, latency_ms: float, garments: Mapping[str, GarmentRecord] | None
    ) -> None:
        """Takes in a frame and, where it was evaluated, what was found of its `garments`."""
        shift = output.stats.shift
        self.latencies_ms.append(latency_ms)
        self.shift_sum += shift.mean
        self.shift_largest = max(self.shift_largest, shift.largest)
        if garments is not None:
            self.frames.append(FrameResult(frame, latency_ms, output.stats.stage_ms, garments))

    def skip(self, reason: str) -> None:
        known = reason in self.skips or len(self.skips) < _MAX_REASONS
        self.skips[reason if known else "other reasons"] += 1

    def latency_ms(self, garment: str | None = None) -> dict[str, float]:
        """Percentiles of the latency of the frame or of a garment (the frame less the others' own stages) [ms]."""
        values = self.latencies_ms if garment is None else [f.garments[garment].latency_ms for f in self.frames]
        p50, p95, p99 = np.percentile(values, (50, 95, 99)) if len(values) else (0.0, 0.0, 0.0)
        return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}

    def skin_shift_mm(self) -> dict[str, float]:
        """How far the collider is from the skin: mean and largest shift over all vertices of all frames [mm]."""
        mean = 1e3 * self.shift_sum / max(1, len(self.latencies_ms))
        return {"mean": mean, "largest": 1e3 * self.shift_largest}

    def as_dict(self) -> dict[str, Any]:
        garments: dict[str, Any] = {}
        for name, after in self.after.items():
            garments[name] = {
                "latency_ms": self.latency_ms(name),
                **after.as_dict(),
                "skin_cfmp_percent": self.on_skin[name].cfmp_percent,
                "before": self.before[name].as_dict(),
            }
        return {
            "input": str(self.options.input),
            "source": self.source,
            "output": None if self.options.output is None else str(self.options.output),
            "backbone": str(self.options.backbone),
            "sdf": self.options.sdf,
            "margin_m": self.options.margin,
            "device": self.options.device,
            "frames": len(self.latencies_ms),
            "skipped": dict(self.skips),
            "warnings": self.warnings,
            "interrupted": self.interrupted,
            "collider": self.options.collider,
            "body": body_facts(self.pipeline),
            "skin_shift_mm": self.skin_shift_mm(),
            "latency_ms": self.latency_ms(),
            "garments": garments,
        }


class Evaluator:
    """Exact metrics of every frame, before and after collision handling, against the collider and against the skin."""

    def __init__(self, pipeline: GarmentPipeline, truth: GroundTruth) -> None:
        self._checker, self._skin = (CollisionChecker(pipeline.body.faces) for _ in range(2))
        self._truth = truth
        self._before, self._after, self._on_skin = (
            {name: GarmentMetrics(garment.faces) for name, garment in pipeline.garments.items()} for _ in range(3)
        )

    def add(self, frame: SmplFrame, output: PipelineOutput, latency_ms: float) -> dict[str, GarmentRecord]:
        self._checker.update(output.body)
        self._skin.update(output.skin)
        own_ms = {name: output.stats.garments[name].ms for name in output}
        records = {}
        for name, mesh in output.items():
            raw, done = (self._checker.check(vertices, mesh.faces) for vertices in (mesh.raw, mesh.local))
            truth = self._truth.of(name, frame)
            self._before[name].add(mesh.raw, raw, truth=truth)
            self._after[name].add(mesh.local, done, truth=truth)
            self._on_skin[name].add(mesh.local, self._skin.check(mesh.local, mesh.faces))
            records[name] = GarmentRecord(
                latency_ms=latency_ms - sum(own_ms.values()) + own_ms[name],
                before=Findings(raw.n_inside, raw.n_pairs, raw.max_depth),
                after=Findings(done.n_inside, done.n_pairs, done.max_depth),
            )
        return records

    def summarise(self, result: ReplayResult) -> None:
        result.before, result.after, result.on_skin = (
            {name: metrics.summary() for name, metrics in of.items()}
            for of in (self._before, self._after, self._on_skin)
        )


@one_thread()
def replay(
    options: ReplayOptions,
    *,
    source: Source | None = None,
    progress: bool = False,
    told: Callable[[int, int], object] | None = None,
) -> ReplayResult:
    """Runs every frame of the input through the pipeline, writes the output bag, and measures.

    `source` is what `open_source` makes of the options, if it was called already. `progress` shows a bar. `told` is
    called a few times a second with how many frames are done, and of how many (0 where that isn't known).

    An interrupt (Ctrl-C) ends the replay early: the bag is closed and the result so far is returned. Raises
    `RefuError`: as `open_source`, an output that can't be written, or no frame that could be replayed.
    """
    source = source or open_source(options)
    pipeline, options = source.pipeline, replace(options, frame_id=options.frame_id or source.frame_id)
    with ExitStack() as stack:
        # Compiles the kernels, so that the first frame isn't late; in a pose nobody sends, so none counts as known.
        pipeline(SmplFrame(pose=np.full((24, 3), 1e-3, np.float32)))
        result = ReplayResult(options, source.description, pipeline)
        if options.backbone == BackboneName.AUTO:
            result.warnings += [f"{name} has no trained weights: worn by skinning" for name in pipeline.untrained]
        truth = GroundTruth()
        if options.evaluate and source.bag is not None:
            faces = {name: garment.faces.cpu().numpy() for name, garment in pipeline.garments.items()}
            truth = GroundTruth.of_bag(options.input, faces, axes=options.axes)
        evaluator = Evaluator(pipeline, truth) if options.evaluate else None
        encoder = adapters.MarkerArrayEncoder(garment_meshes(pipeline), frame_id=options.frame_id, axes=options.axes)
        bag = None if options.output is None else stack.enter_context(DressedBag(options, pipeline, source))
        records = itertools.islice(source.records, options.max_frames)
        total = source.count if options.max_frames is None else min(source.count or sys.maxsize, options.max_frames)
        bar = None if progress and told is None else True
        shown = tqdm(_paced(records, options.speed), total=total, unit="frame", disable=bar)
        try:
            for record in shown if told is None else _counted(shown, total or 0, told):
                start = time.perf_counter()
                try:
                    frame = source.frame_of(record)
                    output = pipeline(frame)
                    garments = [mesh.local for mesh in output.values()]
                    data = encoder.encode(garments, stamp_ns=frame.stamp_ns, transl=frame.transl)
                except RefuError as error:  # no body, an impossible one, or a result that can't be encoded
                    result.skip(str(error))
                    if bag is not None:
                        bag.add_skip(record, str(error))
                    continue
                latency_ms = 1e3 * (time.perf_counter() - start)
                found = None if evaluator is None else evaluator.add(frame, output, latency_ms)
                result.add(frame, output, latency_ms, found)
                if bag is not None:
                    bag.add_frame(record, frame, output, data, found)
        except KeyboardInterrupt:
            result.interrupted = True
        if evaluator is not None:
            evaluator.summarise(result)
        result.warnings += source.warnings(betas_are_told=bool(truth.garments))  # truth is on built-in bodies
    if not result.latencies_ms and not result.interrupted:
        reasons = "; ".join(f"{count} x {reason}" for reason, count in result.skips.most_common(3))
        reasons = reasons or "; ".join(() if source.bag is None else source.bag.reader.warnings)
        raise adapters.BagError(f"{options.input}: no frame could be replayed: {reasons or 'the input is empty'}")
    return result


def _counted(records: Iterable[FrameRecord], total: int, told: Callable[[int, int], object]) -> Iterator[FrameRecord]:
    """The records; `told` is called before the first, after the last, and in between at most every `_TOLD_S`."""
    done, last = 0, -math.inf
    for i, record in enumerate(records):
        if (now := time.monotonic()) > last + _TOLD_S:
            last = now
            told(i, total)
        yield record
        done = i + 1
    told(done, total)


def _paced(records: Iterable[FrameRecord], speed: Literal["max", "real"]) -> Iterator[FrameRecord]:
    """The records, as fast as they are taken or at the pace of their log times; pauses above a minute are skipped."""
    origin: tuple[float, int] | None = None
    for record in records:
        if speed == "real":
            origin = origin or (time.monotonic(), record.log_time_ns)
            pause = origin[0] + 1e-9 * (record.log_time_ns - origin[1]) - time.monotonic()
            if pause > _LONGEST_PAUSE_S:
                origin, pause = (time.monotonic(), record.log_time_ns), 0.0
            time.sleep(max(0.0, pause))
        yield record
