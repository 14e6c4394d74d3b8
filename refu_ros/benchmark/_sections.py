"""The parts of a benchmark: each measures its contenders in turn with the plain query, and adds rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from refu_core import GarmentPipeline, SmplFrame, load_body, load_garment
from refu_core.backbones import load_backbone
from refu_core.benchmark import (
    PLAIN_QUERY,
    PaperSettings,
    PaperStructure,
    Timing,
    least_work,
    measure,
    processor_clock,
    sdf_methods,
)
from refu_core.realtime import FrameStats, GarmentMesh, PipelineOutput
from refu_core.weights import shipped_weights
from refu_ros.benchmark._frames import FrameRunner, load_pipeline
from refu_ros.benchmark._inputs import Moment, Window, sdf_frame
from refu_ros.benchmark._meshes import resized
from refu_ros.benchmark._options import BenchmarkOptions
from refu_ros.benchmark._rows import BenchmarkResult, Row

Pipelines = Mapping[tuple[str, str], GarmentPipeline]
MAIN_MODES = ("hybrid", "accurate")
"""Of which the stages, persons and skips are measured."""
GRAPH, LAUNCHES = "CUDA graph", "launch by launch"
"""How a GPU is told what to do in a frame."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """What all sections of a garment share."""

    garment: str
    windows: Sequence[Window]
    options: BenchmarkOptions
    result: BenchmarkResult
    progress: Callable[[], None]
    device: str = "cpu"

    @property
    def label(self) -> str:
        """The device as rows name it."""
        return torch.cuda.get_device_name() if self.device == "cuda" else self.device

    def measure(
        self, contenders: Mapping[str, Callable[[Any], object]], windows: Sequence[Sequence[Any]], **how: Any
    ) -> dict[str, Timing]:
        """`refu_core.benchmark.measure` with this run's rounds."""
        with nullcontext() if self.device == "cuda" else processor_clock():
            return measure(
                contenders,
                windows,
                rounds=self.options.sizes.rounds,
                on_gpu=self.device == "cuda",
                progress=self.progress,
                **how,
            )

    def plain(self) -> Callable[[Moment], object]:
        """The plain query on this section's device."""
        garment = load_garment(self.garment)
        body = load_body(garment.body)
        methods, _ = sdf_methods(body, garment, network=False, device=self.device)
        ask = methods[0].ask
        return lambda moment: ask(moment.sdf)

    def add(self, stage: str, mode: str, timing: Timing, plain: Timing, **facts: Any) -> None:
        """Adds a row."""
        facts = {"garment": self.garment, "device": self.label, **facts}
        self.result.rows.append(Row.of(timing, plain, stage=stage, mode=mode, **facts))


def measure_sdfs(section: Section, *, network: bool) -> None:
    """Every way to the distances, of the same vertices; the paper's `network`, too, where it is asked for."""
    garment = load_garment(section.garment, device=section.device)
    body = load_body(garment.body, device=section.device)
    methods, missing = sdf_methods(body, garment, network=network, device=section.device)
    section.result.missing.update(missing)
    asks = {method.name: _asking(method.ask) for method in methods}
    slow = {method.name for method in methods if method.is_slow}
    times = section.measure(asks, section.windows, slow=slow)
    for method in sorted(methods, key=lambda method: method.mode not in MAIN_MODES):
        section.add(
            "sdf", method.mode, times[method.name], times[PLAIN_QUERY], method=method.name, vertices=garment.n_vertices
        )


def _asking(ask: Callable[[Any], object]) -> Callable[[Moment], object]:
    return lambda moment: ask(moment.sdf)


def measure_frames(
    section: Section, pipelines: Pipelines, figures: Mapping[tuple[str, str], Mapping[str, float]]
) -> None:
    """Whole frames of every pipeline, and the stages of the main ones. `figures` are added to the rows."""
    runners = frame_runners(section, pipelines)
    names = {", ".join(filter(None, key)): key for key in runners}
    contenders: dict[str, Callable[[Moment], object]] = {PLAIN_QUERY: section.plain()}
    contenders |= {name: runners[key] for name, key in names.items()}
    times = section.measure(contenders, section.windows)
    plain = times[PLAIN_QUERY]
    n = load_garment(section.garment).n_vertices
    for name, (backbone, mode, method) in names.items():
        facts = {"backbone": backbone, "vertices": n, "persons": 1, "method": method}
        errors = {} if method == LAUNCHES else figures.get((backbone, mode), {})
        section.add("frame", mode, times[name], plain, figures=errors, **facts)
    for (backbone, mode, method), runner in runners.items():
        if backbone == _backbone(pipelines) and mode in MAIN_MODES:
            for stage, ms in runner.stage_times().items():
                section.add(f"frame.{stage}", mode, Timing(ms, ms), plain, backbone=backbone, vertices=n, method=method)


def frame_runners(section: Section, pipelines: Pipelines) -> dict[tuple[str, str, str | None], FrameRunner]:
    """Of every pipeline, by backbone, mode and, of a GPU, method: the main ones are measured without graphs, too."""
    method = GRAPH if section.device == "cuda" else None
    runners = {(*key, method): FrameRunner.of(pipeline) for key, pipeline in pipelines.items()}
    for backbone, mode in _main(pipelines) if section.device == "cuda" else ():
        pipeline = load_pipeline(
            [section.garment], section.options, mode=mode, backbone=backbone, device=section.device, graph=False
        )
        runners[backbone, mode, LAUNCHES] = FrameRunner.of(pipeline)
    return runners


def measure_persons(section: Section, pipelines: Pipelines) -> None:
    """One message a person in, one message of all out."""
    counts = section.options.sizes.persons
    windows = section.windows
    crowd = [
        [tuple(windows[(i + person) % len(windows)][k] for person in range(max(counts))) for k in range(len(window))]
        for i, window in enumerate(windows)
    ]
    runners = {
        (mode, n): FrameRunner.of(pipelines[key], persons=n)
        for key in _main(pipelines)
        for n in counts
        for mode in (key[1],)
    }
    plain = section.plain()
    contenders: dict[str, Callable[[Any], object]] = {PLAIN_QUERY: lambda moments: plain(moments[0])}
    contenders |= {f"{mode} {n}": runner for (mode, n), runner in runners.items()}
    times = section.measure(contenders, crowd)
    for mode, n in runners:
        alone = times[f"{mode} {counts[0]}"].median
        timing = times[f"{mode} {n}"]
        figures = {"ratio_to_one_person": timing.median / alone}
        section.add(
            "persons", mode, timing, times[PLAIN_QUERY], persons=n, backbone=_backbone(pipelines), figures=figures
        )


def measure_still(section: Section, pipelines: Pipelines) -> None:
    """The same pose again and again, beside one that moves: the whole frame, and the pipeline alone."""
    contenders: dict[str, Callable[[Moment], object]] = {PLAIN_QUERY: section.plain()}
    keys = list(_main(pipelines))
    backbone = _backbone(pipelines)
    # Pipelines of their own: one that moves would make the other's pose a new one.
    still = {
        mode: load_pipeline([section.garment], section.options, mode=mode, backbone=backbone, device=section.device)
        for _, mode in keys
    }
    held = section.windows[0][1]
    for key in keys:
        mode = key[1]
        contenders[f"{mode} moving"] = FrameRunner.of(pipelines[key])
        contenders[f"{mode} still"] = _always(FrameRunner.of(still[mode]), held)
        contenders[f"{mode} moving, pipeline"] = _of_frame(pipelines[key])
        contenders[f"{mode} still, pipeline"] = _always(_of_frame(still[mode]), held)
    times = section.measure(contenders, section.windows)
    for _, mode in keys:
        frame, pipeline = (
            times[f"{mode} still{part}"].median / times[f"{mode} moving{part}"].median for part in ("", ", pipeline")
        )
        figures = {"share_of_frame": frame, "share_of_pipeline": pipeline}
        section.add("unchanged", mode, times[f"{mode} still"], times[PLAIN_QUERY], backbone=backbone, figures=figures)


def _always(run: Callable[[Moment], object], held: Moment) -> Callable[[Moment], object]:
    return lambda _: run(held)


def _of_frame(pipeline: GarmentPipeline) -> Callable[[Moment], object]:
    return lambda moment: pipeline(moment.frame)


def measure_skips(section: Section, pipelines: Pipelines) -> None:
    """The pipeline without each of the things that it skips, of bodies that move and of one that doesn't."""
    backbone = _backbone(pipelines)
    held = section.windows[0][1]
    for _, mode in _main(pipelines):
        contenders: dict[str, Callable[[Moment], object]] = {PLAIN_QUERY: section.plain()}
        for skip in ("", *section.result.skips):
            off = [skip] if skip else []
            for kind in ("moving", "still"):
                pipeline = load_pipeline(
                    [section.garment], section.options, mode=mode, backbone=backbone, device=section.device, no_skip=off
                )
                run = _of_frame(pipeline)
                contenders[f"{kind} {skip}"] = run if kind == "moving" else _always(run, held)
        times = section.measure(contenders, section.windows)
        for skip in section.result.skips:
            moving, still = times[f"moving {skip}"], times[f"still {skip}"]
            figures = {
                "worth_moving": moving.median / times["moving "].median,
                "worth_still": still.median / times["still "].median,
            }
            section.add("skip", mode, moving, times[PLAIN_QUERY], backbone=backbone, skip=skip, figures=figures)


def measure_growth(section: Section) -> None:
    """The plain query, the band and the walk, of parts of the garment and of finer ones."""
    whole = load_garment(section.garment)
    body = load_body(whole.body)
    meshes = [resized(whole, size) for size in section.options.sizes.growth]
    windows = [
        [[sdf_frame(body, mesh, moment.frame) for mesh in meshes] for moment in window] for window in section.windows
    ]
    contenders: dict[str, Callable[[Any], object]] = {}
    kinds = {}
    for i, mesh in enumerate(meshes):
        methods, _ = sdf_methods(body, mesh, network=False)
        for method in methods:
            if method.mode in ("plain", *MAIN_MODES):
                name = f"{method.mode} {mesh.n_vertices}"
                kinds[name] = (method, mesh)
                contenders[name] = _at(method.ask, i)
    times = section.measure(contenders, windows)
    unit = times[f"plain {whole.n_vertices}"]
    for name, (method, mesh) in kinds.items():
        section.add("growth", method.mode, times[name], unit, method=method.name, vertices=mesh.n_vertices)


def _at(ask: Callable[[Any], object], i: int) -> Callable[[Sequence[Any]], object]:
    return lambda frames: ask(frames[i])


def measure_paper(section: Section, pipelines: Pipelines) -> None:
    """The paper's structure, frame by frame, on a GPU in half precision, too."""
    full = section.options.sizes.has_network
    types = (torch.float32, torch.bfloat16, torch.float16) if section.device == "cuda" else (torch.float32,)
    for dtype in types:
        settings = PaperSettings(dtype=dtype) if full else PaperSettings(pivots=2, width=64, dtype=dtype)
        paper = PaperStructure(section.garment, settings=settings, device=section.device)
        runner = FrameRunner(_dressing(paper, section.garment), {section.garment: load_garment(section.garment)})
        contenders: dict[str, Callable[[Moment], object]] = {PLAIN_QUERY: section.plain(), "paper": runner}
        contenders |= {mode: FrameRunner.of(pipelines[key]) for key in _main(pipelines) for mode in (key[1],)}
        times = section.measure(contenders, section.windows[:2], slow={"paper"} if full else ())
        plain = times[PLAIN_QUERY]
        sizes = "dense, paper's sizes" if full else "dense, trial sizes"
        facts = {"backbone": f"tailornet, {sizes}, {str(dtype).removeprefix('torch.')}", "persons": 1}
        figures = {f"times_{mode}": times["paper"].median / times[mode].median for _, mode in _main(pipelines)}
        figures["parameters"] = float(paper.n_parameters)
        section.add("frame", "paper", times["paper"], plain, figures=figures, **facts)
        for stage, ms in runner.stage_times().items():
            section.add(f"frame.{stage}", "paper", Timing(ms, ms), plain, **facts)


def _dressing(paper: PaperStructure, name: str) -> Callable[[Sequence[SmplFrame]], Sequence[PipelineOutput]]:
    faces = load_garment(name).faces.numpy()

    def dress(frames: Sequence[SmplFrame]) -> list[PipelineOutput]:
        outputs = []
        for frame in frames:
            vertices = paper(frame)
            mesh = GarmentMesh(np.nan_to_num(vertices), lambda: np.empty((0, 3), np.float32), faces, frame.transl)
            outputs.append(PipelineOutput({name: mesh}, mesh.before, FrameStats(paper.stage_ms)))
        return outputs

    return dress


OF_MAIN_GARMENT: Mapping[str, Callable[[Section, Pipelines], None]] = {
    "persons": measure_persons,
    "unchanged": measure_still,
    "skips": measure_skips,
    "paper": measure_paper,
}
"""What is measured of the first garment alone, on every device."""


def count_work(section: Section, pipelines: Pipelines) -> None:
    """The least that the stages of the main pipeline need."""
    backbone, mode = next(iter(_main(pipelines)))
    pipeline = pipelines[backbone, mode]
    template = pipeline.garments[section.garment]
    weights = section.options.weights
    folder = shipped_weights(section.garment) if weights is None else weights / section.garment
    moment = section.windows[0][0]
    section.result.work = least_work(
        pipeline.body,
        template,
        load_backbone(backbone, template, mode=mode, folder=folder),
        message_bytes=len(moment.raw),
        betas=moment.sdf.betas[None],
    )


def _main(pipelines: Pipelines) -> Iterator[tuple[str, str]]:
    backbone = _backbone(pipelines)
    return ((backbone, mode) for mode in MAIN_MODES)


def _backbone(pipelines: Pipelines) -> str:
    """The default backbone, or the one that is there."""
    return next(iter(pipelines))[0]
