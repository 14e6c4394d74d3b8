"""The sections of a benchmark: each measures its contenders in turn with the plain query, and adds rows."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch

import msg_adapters as adapters
from refu_core import GarmentPipeline, SmplFrame, WeightsError, load_garment
from refu_lab.benchmark._measure import BenchmarkResult, BenchmarkRow, Timing, measure, processor_clock
from refu_lab.benchmark._paper import PaperSettings, PaperStructure
from refu_lab.benchmark._sdfs import PLAIN_QUERY, EncodedFrame, Window, plain_query, sdf_methods
from refu_lab.commands.benchmark import BenchmarkOptions
from refu_lab.dressed_bag import garment_meshes

Pipelines = Mapping[tuple[str, str], GarmentPipeline]
"""By backbone and mode. The default backbone comes first, or the other one if that has no weights."""
BACKBONES = ("tailornet", "skinned")
"""The default one, and the one that needs no weights."""
MAIN_MODES = ("hybrid", "accurate")
"""Modes whose stages are measured, and that are measured with several persons."""
GRAPH, LAUNCHES = "CUDA graph", "launch by launch"
"""How a frame's work is submitted to a GPU."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """What the sections of one garment on one device share."""

    garment: str
    windows: Sequence[Window]
    options: BenchmarkOptions
    result: BenchmarkResult
    progress: Callable[[], object]
    device: str

    def measure(
        self, contenders: Mapping[str, Callable[[Any], object]], windows: Sequence[Sequence[Any]] = (), **how: Any
    ) -> dict[str, Timing]:
        """Times contenders and the plain query in this run's rounds, and in its windows unless others are given."""
        on_gpu = self.device == "cuda"
        _, body = self.options.on_body(self.garment)
        plain = plain_query(body, self.device)

        def ask(given: EncodedFrame | Sequence[EncodedFrame]) -> object:
            return plain((given if isinstance(given, EncodedFrame) else given[0]).sdf)

        how |= {"rounds": self.options.sizes.rounds, "on_gpu": on_gpu, "progress": self.progress}
        with nullcontext() if on_gpu else processor_clock():
            return measure({PLAIN_QUERY: ask, **contenders}, windows or self.windows, **how)

    def add(self, stage: str, mode: str, timing: Timing, plain: Timing, **facts: Any) -> None:
        device = torch.cuda.get_device_name() if self.device == "cuda" else self.device
        facts = {"garment": self.garment, "device": device, **facts}
        self.result.rows.append(BenchmarkRow.of(timing, plain, stage=stage, mode=mode, **facts))

    def add_stages(self, stages: Sequence[Mapping[str, float]], mode: str, plain: Timing, **facts: Any) -> None:
        """Adds a row for each stage from its times in each frame [ms]."""
        for stage in stages[0]:
            ms = np.array([one[stage] for one in stages])
            self.add(f"frame.{stage}", mode, Timing(ms, ms), plain, **facts)

    def load_pipeline(self, mode: str, backbone: str, *, graph: bool = True) -> GarmentPipeline:
        return self.options.load_pipeline(self.garment, mode=mode, backbone=backbone, device=self.device, graph=graph)


class FrameRunner:
    """Decodes, dresses and encodes. A frame of several persons takes one message for each and gives one message."""

    def __init__(self, pipeline: GarmentPipeline, *, persons: int = 1) -> None:
        self._pipeline, self._persons = pipeline, range(persons)
        self._decode = adapters.decoder_for("multiarray").from_bytes
        names = [f"p{person}" if persons > 1 else "" for person in self._persons]
        self._encoder = adapters.MarkerArrayEncoder([mesh for name in names for mesh in garment_meshes(pipeline, name)])
        self.stages: list[dict[str, float]] = []
        """Time of each stage in each frame that wasn't a jump, by whichever clock `time.perf_counter` reads [ms]."""

    def __call__(self, moments: EncodedFrame | Sequence[EncodedFrame]) -> bytes:
        given = [moments] if isinstance(moments, EncodedFrame) else moments
        laps = [time.perf_counter()]
        frames = [self._decode(given[i].raw) for i in self._persons]
        laps.append(time.perf_counter())
        outputs = self._pipeline(frames)
        laps.append(time.perf_counter())
        data = self._encoder.encode(
            [mesh.local for output in outputs for mesh in output.values()],
            stamp_ns=0,
            transl=[mesh.transl for output in outputs for mesh in output.values()],
        )
        laps.append(time.perf_counter())
        if not given[0].is_jump:
            decode, _, encode = 1e3 * np.diff(laps)
            spent = [output.stats.stage_ms for output in outputs]
            own = {stage: sum(one[stage] for one in spent) for stage in spent[0]}
            self.stages.append({"decode": float(decode), **own, "encode": float(encode)})
        return data


def _of_frame(pipeline: Callable[[SmplFrame], object]) -> Callable[[EncodedFrame], object]:
    return lambda moment: pipeline(moment.frame)


def _always(run: Callable[[EncodedFrame], object], held: EncodedFrame) -> Callable[[EncodedFrame], object]:
    return lambda _: run(held)


def _backbone(pipelines: Pipelines) -> str:
    return next(iter(pipelines))[0]


def measure_sdfs(section: Section, *, network: bool) -> None:
    """Every signed distance at the same vertices, with `network` also the paper's network."""
    garment, body = section.options.on_body(section.garment, device=section.device)
    methods, missing = sdf_methods(body, garment, network=network, device=section.device)
    section.result.missing.update(missing)
    slow = {method.name for method in methods if method.is_slow}
    windows = [[moment.sdf for moment in window] for window in section.windows]
    times = section.measure({method.name: method.ask for method in methods}, windows, slow=slow)
    for method in sorted(methods, key=lambda method: method.mode not in MAIN_MODES):
        facts = {"method": method.name, "vertices": garment.n_vertices}
        section.add("sdf", method.mode, times[method.name], times[PLAIN_QUERY], **facts)


def measure_frames(
    section: Section, pipelines: Pipelines, figures: Mapping[tuple[str, str], Mapping[str, float]]
) -> None:
    """Whole frames of every pipeline, and the stages of the main ones. `figures` are added to the rows."""
    runners = frame_runners(section, pipelines)
    times = section.measure({", ".join(filter(None, key)): runner for key, runner in runners.items()})
    plain = times[PLAIN_QUERY]
    n = load_garment(section.garment).n_vertices
    for backbone, mode, method in runners:
        timing = times[", ".join(filter(None, (backbone, mode, method)))]
        errors = {} if method == LAUNCHES else figures.get((backbone, mode), {})
        facts = {"backbone": backbone, "vertices": n, "persons": 1, "method": method, "figures": errors}
        section.add("frame", mode, timing, plain, **facts)
    for (backbone, mode, method), runner in runners.items():
        if backbone == _backbone(pipelines) and mode in MAIN_MODES:
            section.add_stages(runner.stages, mode, plain, backbone=backbone, vertices=n, method=method)


def frame_runners(section: Section, pipelines: Pipelines) -> dict[tuple[str, str, str | None], FrameRunner]:
    """A runner for each pipeline, by backbone, mode and (on a GPU) method: the main modes run without graphs, too."""
    on_gpu, backbone = section.device == "cuda", _backbone(pipelines)
    runners = {(*key, GRAPH if on_gpu else None): FrameRunner(pipeline) for key, pipeline in pipelines.items()}
    for mode in MAIN_MODES if on_gpu else ():
        runners[backbone, mode, LAUNCHES] = FrameRunner(section.load_pipeline(mode, backbone, graph=False))
    return runners


def measure_persons(section: Section, pipelines: Pipelines) -> None:
    """Frames of several persons: one input message for each, one output message for all."""
    counts, backbone, windows = section.options.sizes.persons, _backbone(pipelines), section.windows
    crowd = [
        [tuple(windows[(i + person) % len(windows)][k] for person in range(max(counts))) for k in range(len(window))]
        for i, window in enumerate(windows)
    ]
    keys = list(product(MAIN_MODES, counts))
    times = section.measure({f"{m} {n}": FrameRunner(pipelines[backbone, m], persons=n) for m, n in keys}, crowd)
    for mode, n in keys:
        timing = times[f"{mode} {n}"]
        figures = {"ratio_to_one_person": timing.median / times[f"{mode} {counts[0]}"].median}
        section.add("persons", mode, timing, times[PLAIN_QUERY], persons=n, backbone=backbone, figures=figures)


def measure_still(section: Section, pipelines: Pipelines) -> None:
    """An unchanging pose beside a moving one: the whole frame, and the pipeline alone."""
    contenders: dict[str, Callable[[EncodedFrame], object]] = {}
    backbone, held = _backbone(pipelines), section.windows[0][1]
    for mode in MAIN_MODES:
        # It needs a pipeline of its own: in a shared one, frames of the moving pose would come between.
        moving, still = pipelines[backbone, mode], section.load_pipeline(mode, backbone)
        for what, of in (("frame", FrameRunner), ("pipeline", _of_frame)):
            contenders |= {f"{mode} moving {what}": of(moving), f"{mode} still {what}": _always(of(still), held)}
    times = section.measure(contenders)
    for mode in MAIN_MODES:
        figures = {
            f"share_of_{what}": times[f"{mode} still {what}"].median / times[f"{mode} moving {what}"].median
            for what in ("frame", "pipeline")
        }
        timing = times[f"{mode} still frame"]
        section.add("unchanged", mode, timing, times[PLAIN_QUERY], backbone=backbone, figures=figures)


def measure_paper(section: Section, pipelines: Pipelines) -> None:
    """The paper's structure, frame by frame; on a GPU also in half precision."""
    full = section.options.sizes.has_network
    types = (torch.float32, torch.bfloat16, torch.float16) if section.device == "cuda" else (torch.float32,)
    for dtype in types:
        settings = PaperSettings(dtype=dtype) if full else PaperSettings(pivots=2, width=64, dtype=dtype)
        paper = PaperStructure(*section.options.on_body(section.garment, device=section.device), settings=settings)
        contenders: dict[str, Callable[[EncodedFrame], object]] = {"paper": _of_frame(paper)}
        contenders |= {mode: FrameRunner(pipelines[_backbone(pipelines), mode]) for mode in MAIN_MODES}
        times = section.measure(contenders, section.windows[:2], slow={"paper"} if full else ())
        plain = times[PLAIN_QUERY]
        sizes = "dense, paper's sizes" if full else "dense, trial sizes"
        facts = {"backbone": f"tailornet, {sizes}, {str(dtype).removeprefix('torch.')}", "persons": 1}
        figures = {f"times_{mode}": times["paper"].median / times[mode].median for mode in MAIN_MODES}
        figures["parameters"] = float(paper.n_parameters)
        section.add("frame", "paper", times["paper"], plain, figures=figures, **facts)
        section.add_stages(paper.stages, "paper", plain, **facts)


def load_pipelines(
    garment: str, options: BenchmarkOptions, *, device: str = "cpu"
) -> tuple[dict[tuple[str, str], GarmentPipeline], dict[str, str]]:
    """The pipelines of a garment by (backbone, mode), the default backbone first; and how to train the missing ones."""
    pipelines: dict[tuple[str, str], GarmentPipeline] = {}
    missing: dict[str, str] = {}
    for backbone, mode in product(BACKBONES, options.sizes.modes):
        with suppress(WeightsError):
            pipelines[backbone, mode] = options.load_pipeline(garment, mode=mode, backbone=backbone, device=device)
            continue
        command = f"refu train {garment} --data DIR --backbone {backbone} --mode {mode}"
        missing[f"{garment}: {backbone}, {mode}"] = command
    return pipelines, missing
