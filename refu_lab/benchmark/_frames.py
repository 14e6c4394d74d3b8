"""Whole frames, from a message's bytes to a message's bytes, as `refu replay` and the node make them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import product

import numpy as np

import msg_adapters as adapters
from refu_core import GarmentPipeline, WeightsError
from refu_lab.benchmark._inputs import Moment
from refu_lab.commands.benchmark import BenchmarkOptions

BACKBONES = ("tailornet", "skinned")
"""The default one, and the one that needs no weights."""


class FrameRunner:
    """Decodes, dresses and encodes; a frame of several persons is one message a person in, and one out."""

    def __init__(self, pipeline: GarmentPipeline, *, persons: int = 1) -> None:
        self._pipeline, self._persons = pipeline, range(persons)
        self._decode = adapters.decoder_for("multiarray").from_bytes
        meshes = [
            adapters.MarkerMesh(
                ns=adapters.garment_namespace(name, f"p{person}" if persons > 1 else ""),
                faces=garment.faces.cpu().numpy(),
                n_vertices=garment.n_vertices,
            )
            for person in self._persons
            for name, garment in pipeline.garments.items()
        ]
        self._encoder = adapters.MarkerArrayEncoder(meshes)
        self.stages: list[dict[str, float]] = []
        """What each stage took in each frame that wasn't a jump, by the clock that `time.perf_counter` is [ms]."""

    def __call__(self, moments: Moment | Sequence[Moment]) -> bytes:
        """The message that goes out."""
        given = [moments] if isinstance(moments, Moment) else moments
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


def load_pipelines(
    garment: str, options: BenchmarkOptions, *, device: str = "cpu"
) -> tuple[dict[tuple[str, str], GarmentPipeline], dict[str, str]]:
    """The pipelines of a garment by (backbone, mode), the default backbone first; and what keeps others away."""
    pipelines: dict[tuple[str, str], GarmentPipeline] = {}
    missing: dict[str, str] = {}
    for backbone, mode in product(BACKBONES, options.sizes.modes):
        with suppress(WeightsError):
            pipelines[backbone, mode] = options.load_pipeline(garment, mode=mode, backbone=backbone, device=device)
            continue
        missing[f"{garment}: {backbone}, {mode}"] = f"refu train {garment} --backbone {backbone} --mode {mode}"
    return pipelines, missing
