"""Recorded motion: checks every vertex in every frame of clips against the collider and against the skin."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from msg_adapters import Motion
from refu_core import metrics
from refu_core.errors import RefuError
from refu_core.frames import LAGS, N_BETAS, SmplFrame
from refu_core.history import PoseHistory
from refu_core.modes import DEFAULT_GARMENTS
from refu_core.realtime import GarmentPipeline, PipelineOutput
from refu_lab.reproduction._methods import METHODS, Library
from refu_lab.reproduction._tables import Missing, ResultTable

OUTFITS = (DEFAULT_GARMENTS, ("shirt-male",), ("skirt-female",))
MOTION_METHODS = ("node-hybrid", "node-accurate")
"""Methods that are shown for every clip, in the order of the rows."""
NEAR = 0.02
"""A self-intersection of the collider counts if it is this close to a garment [m]."""
SPREAD = 2.0
"""Every other person has betas drawn evenly from within ± this; the rest have those of the recording."""
_RATE = 60.0
"""Jumps are measured between frames that are about 1/`_RATE` s apart [Hz]."""
_MOVED = 1e-4
"""A vertex of the skin that went farther than this counts as moved [m]."""
_BIN = 1e-5  # [m]; resolution of the percentiles of the skin's shift
_LONGEST_WAY = 0.2  # [m]
_STRETCHED = 2.0
_SKIN = "skin"


def motion_table(clips: Mapping[str, Motion], *, library: Library, every: int, progress: bool = False) -> ResultTable:
    """Collisions, jumps, stretch and crossings of each garment, and how far skin was moved, clip by clip.

    `clips` are recorded motions by name; one frame in `every` so many is dressed and judged.
    """
    labels = {name: METHODS[name].label for name in MOTION_METHODS} | {_SKIN: "skin to collider"}
    table = ResultTable.of("motion", labels=labels, spread=SPREAD, near_mm=1e3 * NEAR, rate=_RATE)
    indices = {name: range(0, len(clip) - _step(clip), every) for name, clip in clips.items()}
    n_pairs = sum(map(len, indices.values()))
    shapes = drawn_shapes(n_pairs)
    bar = tqdm(total=len(OUTFITS) * n_pairs, desc="motion", unit="frame", disable=None if progress else True)
    found: dict[str, dict[tuple[str, str], list[Judged]]] = {}
    shifts: dict[tuple[str, str], SkinShifts] = {}
    for garments in OUTFITS:
        pipelines: dict[str, GarmentPipeline] = {}
        for method in MOTION_METHODS:
            made_by = METHODS[method]
            try:
                pipelines[method] = library.pipeline(made_by, *garments)
            except RefuError as error:
                command = made_by.train_command(garments[0])
                table.missing += [Missing(garment, method, str(error), command) for garment in garments]
        if not pipelines:
            continue
        worn = OutfitJudge(garments, pipelines)
        whole = worn.body.name, "all clips"
        is_first = whole not in shifts
        persons = iter(shapes)
        for name, clip in clips.items():
            for index in indices[name]:
                judged, way = worn.judge(frame_pair(clip, index, next(persons)))
                for (garment, method), one in judged.items():
                    found.setdefault(garment, {}).setdefault((name, method), []).append(one)
                for key in (whole, (worn.body.name, name)) if is_first else ():
                    shifts.setdefault(key, SkinShifts()).add(way)
                bar.update()
    bar.close()
    for garment, by_clip in found.items():
        for method in MOTION_METHODS:
            everything = [one for (_, of), ones in by_clip.items() if of == method for one in ones]
            table.add(f"{garment}, all clips", method, figures_of(everything) if everything else {})
        for (name, method), ones in by_clip.items():
            table.add(f"{garment}, {name}", method, figures_of(ones))
    for (body, name), moved in shifts.items():
        table.add(f"{body} body, {name}", _SKIN, moved.figures())
    return table


class SkinShifts:
    """How far vertices of the skin are moved to their places on the collider, over many frames."""

    def __init__(self) -> None:
        self._count = np.zeros(int(_LONGEST_WAY / _BIN) + 1, np.int64)
        self._sum, self._largest, self._moved = 0.0, 0.0, 0

    def add(self, way: NDArray[np.floating]) -> None:
        """Adds the distances that a frame's vertices were moved by [m], shape (V,)."""
        np.add.at(self._count, np.minimum((way / _BIN).astype(np.int64), len(self._count) - 1), 1)
        self._sum += float(way.sum())
        self._largest = max(self._largest, float(way.max()))
        self._moved += int((way > _MOVED).sum())

    def figures(self) -> dict[str, float | None]:
        """The mean, 99th percentile (to 0.01 mm) and largest shift, and the share of vertices that moved."""
        n = int(self._count.sum())
        return {
            "shift_mean_mm": 1e3 * self._sum / n,
            "shift_p99_mm": 1e3 * int(np.searchsorted(self._count.cumsum(), 0.99 * n)) * _BIN,
            "shift_max_mm": 1e3 * self._largest,
            "shift_moved_percent": 100 * self._moved / n,
        }


@dataclass(frozen=True)
class Judged:
    """Figures of one garment in one frame, as one method makes it."""

    on_collider: metrics.FrameMetrics
    is_free_of_skin: bool
    is_collider_cut: bool
    jump_mm: float
    leap_mm: float
    stretched: float
    """Share of the edges that are longer than `_STRETCHED` times their rest length."""
    n_crossings: int
    is_layer_cut: bool | None
    """Whether it cuts through a garment worn with it; None for one worn alone."""


def figures_of(judged: Sequence[Judged]) -> dict[str, float | None]:
    """The figures of a garment over some frames, by metric; `layers_cut_percent` is None for one worn alone."""
    figures = metrics.Figures.over([one.on_collider for one in judged])
    jumps = np.array([one.jump_mm for one in judged])
    layers = [one.is_layer_cut for one in judged if one.is_layer_cut is not None]
    return {
        "vfcp_percent": figures.vfcp_percent,
        "cfmp_percent": figures.cfmp_percent,
        "max_depth_mm": figures.max_depth_mm,
        "skin_cfmp_percent": 100 * float(np.mean([one.is_free_of_skin for one in judged])),
        "collider_cut_percent": 100 * float(np.mean([one.is_collider_cut for one in judged])),
        "jump_20_percent": 100 * float((jumps > 20).mean()),
        "jump_40_percent": 100 * float((jumps > 40).mean()),
        "jump_max_mm": float(jumps.max()),
        "leap_20_percent": 100 * float(np.mean([one.leap_mm > 20 for one in judged])),
        "stretched_percent": 100 * float(np.mean([one.stretched for one in judged])),
        "self_crossings": float(np.mean([one.n_crossings for one in judged])),
        "layers_cut_percent": 100 * float(np.mean(layers)) if layers else None,
    }


class OutfitJudge:
    """Dresses garments worn together by every method, and judges them."""

    def __init__(self, garments: Sequence[str], pipelines: Mapping[str, GarmentPipeline]) -> None:
        self._pipelines = pipelines
        self._skinned = GarmentPipeline.load(
            garments, body=next(iter(pipelines.values())).body, backbone="skinned", sdf="none", collider=False
        )
        self.body = self._skinned.body
        self._collider, self._skin = (metrics.CollisionChecker(self.body.faces) for _ in range(2))
        self._of_shape = lru_cache(maxsize=8)(self._prepared)
        templates = self._skinned.garments
        self._metrics = {name: metrics.GarmentMetrics(one.faces.numpy()) for name, one in templates.items()}
        self._sheets = {name: metrics.SheetChecker(one.faces.numpy()) for name, one in templates.items()}

    def _prepared(self, betas: bytes) -> tuple[metrics.SelfContactDetector, dict[str, NDArray[np.floating]]]:
        """What depends on a person's shape: which faces cross at rest already (toes), and each garment's edges."""
        shape = torch.from_numpy(np.frombuffer(betas, np.float32).copy())[None]
        rest = {name: one.rest(shape)[0].numpy() for name, one in self._skinned.garments.items()}
        detector = metrics.SelfContactDetector(self.body.faces, self.body.rest_vertices(shape)[0])
        return detector, {name: self._edge_lengths(name, vertices) for name, vertices in rest.items()}

    def _edge_lengths(self, garment: str, vertices: NDArray[np.floating]) -> NDArray[np.floating]:
        """Length of each edge [m], shape (E,)."""
        a, b = vertices[self._skinned.garments[garment].mesh.edges.T]
        lengths: NDArray[np.floating] = np.linalg.norm(a - b, axis=1)
        return lengths

    def judge(self, frames: Sequence[SmplFrame]) -> tuple[dict[tuple[str, str], Judged], NDArray[np.floating]]:
        """Judges the first of two frames, by (garment, method); and how far its skin was moved [m], shape (V,)."""
        skinned, made = self._skinned(frames), {method: one(frames) for method, one in self._pipelines.items()}
        person = next(iter(made.values()))[0]  # every method has the same body
        self._collider.update(person.body)
        self._skin.update(person.skin)
        detector, lengths = self._of_shape(frames[0].betas.tobytes())
        contact = detector.detect(person.body)
        judged: dict[tuple[str, str], Judged] = {}
        for method, (now, then) in made.items():
            for garment in now:
                ways = [last[garment].local - first[garment].local for first, last in ((now, then), skinned)]
                judged[garment, method] = self._judge(garment, now, contact, lengths[garment], *ways)
        return judged, np.linalg.norm(person.body - person.skin, axis=1)

    def _judge(
        self,
        garment: str,
        out: PipelineOutput,
        contact: metrics.SelfContact,
        rest_lengths: NDArray[np.floating],
        way: NDArray[np.floating],
        way_of_skinned: NDArray[np.floating],
    ) -> Judged:
        local, faces, sheet = out[garment].local, out[garment].faces, self._sheets[garment]
        sheet.update(local)
        others = [out[name] for name in out if name != garment]
        stretch = self._edge_lengths(garment, local) / rest_lengths
        return Judged(
            self._metrics[garment].add(local, self._collider.check(local, faces)),
            self._skin.check(local, faces).is_free,
            bool(contact.near(local, distance=NEAR).any()),
            1e3 * float(np.linalg.norm(way - way_of_skinned, axis=1).max()),
            1e3 * float((np.linalg.norm(way, axis=1) - np.linalg.norm(way_of_skinned, axis=1)).max()),
            float((stretch > _STRETCHED).mean()),
            len(sheet.with_itself()),
            any(len(sheet.with_other(one.local, one.faces)) for one in others) if others else None,
        )


def drawn_shapes(n: int) -> list[NDArray[np.float32] | None]:
    """Betas of the persons in n frame pairs, shape (10,) each, by `SPREAD`; None for the recording's."""
    drawn = np.random.default_rng(0).uniform(-SPREAD, SPREAD, (n, N_BETAS)).astype(np.float32)
    return [None if i % 2 == 0 else betas for i, betas in enumerate(drawn)]


def frame_pair(clip: Motion, index: int, betas: NDArray[np.float32] | None = None) -> list[SmplFrame]:
    """A frame of a clip and the one 1/60 s later, with the poses before them; with other `betas` if given."""
    first = max(0, index - math.ceil(LAGS[-1] * clip.fps) - 1)
    frames = PoseHistory.told(map(clip.frame, range(first, index + _step(clip) + 1)))
    pair = [frames[index - first], frames[-1]]
    return pair if betas is None else [replace(frame, betas=betas) for frame in pair]


def _step(clip: Motion) -> int:
    """Number of frames from the first to the second of a pair."""
    return max(1, round(clip.fps / _RATE))
