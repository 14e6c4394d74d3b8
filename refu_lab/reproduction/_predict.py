"""Runs a method: takes one sample's body, gives the garment that the method makes for it, and times each stage."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from refu_core.backbones import Skinned
from refu_core.body import Collider, load_body
from refu_core.contact import Blend
from refu_core.errors import WeightsError
from refu_core.frames import SmplFrame
from refu_core.garments import load_garment, worn_on
from refu_core.realtime import GarmentPipeline, Outfit, Wearable, Wearer, dress
from refu_core.refu import Refu, repulse
from refu_core.sdf import ApproxSdf, BodySdf, ExactSdf, SdfSample
from refu_lab.baselines import PostProcess
from refu_lab.reproduction._methods import Library, Method


class GarmentSetup:
    """What all methods share for one garment: template, body, distances, and the hints that the fast one needs."""

    def __init__(self, garment: str, library: Library) -> None:
        """Prepares a built-in garment on the library's body, with or without its collider."""
        fit = library.fit
        self.template = worn_on(load_garment(garment), fit)
        self.body = load_body(self.template.body) if fit is None else fit.body
        self.collider = Collider(self.body) if library.collider else None
        self.exact, self.approx = ExactSdf(self.body.faces), ApproxSdf(self.body)
        self.ask = {"accurate": self.exact.of_garment(self.template), "approx": self.approx.of_garment(self.template)}
        """Functions that give the distances of the garment's own vertices."""
        self.post_process = PostProcess(self.template.faces, self.template.n_vertices)
        self.blend = Blend.of_faces(self.template.faces, self.template.n_vertices)


class SampleScene:
    """One sample's posed body; the distances to it are prepared when a method first asks for them."""

    def __init__(self, setup: GarmentSetup, pose: ArrayLike, betas: ArrayLike, style: ArrayLike) -> None:
        """Poses the body: pose (24, 3) [rad], betas (10,), style (4,)."""
        self.setup = setup
        self.pose, self.betas, self.style = (
            torch.from_numpy(np.asarray(value, np.float32))[None] for value in (pose, betas, style)
        )
        dressed = dress(self.pose, Wearer.of(Outfit(setup.body, {}, setup.collider), self.betas))
        self.vertices: Tensor = dressed.turns[0](dressed.body[0])
        """The collider [m], shape (V, 3)."""
        self.transforms = setup.body(self.pose, self.betas).transforms
        self._update_ms: dict[str, float] = {}

    def sdf(self, name: str) -> tuple[BodySdf, float]:
        """The distance of that name to this body, and how long its update to the body took [ms]."""
        sdf: BodySdf = self.setup.exact if name == "accurate" else self.setup.approx
        if name not in self._update_ms:
            start = time.perf_counter()
            sdf.update(self.vertices, pose=self.pose[0], betas=self.betas[0])
            self._update_ms[name] = 1e3 * (time.perf_counter() - start)
        return sdf, self._update_ms[name]


class MethodOutput(NamedTuple):
    vertices: Tensor
    """Garment [m], shape (N, 3)."""
    ms: Mapping[str, float]
    """Wall time by component: backbone (with posing), sdf, refu, post-process; node and its stages [ms]."""
    scale: Tensor = torch.zeros(0)
    """α of the vertices that ReFU pushed, shape (R,); empty for other methods."""
    approx: Tensor = torch.zeros(0)
    """Their signed distance as ReFU saw it [m], shape (R,)."""
    accurate: Tensor = torch.zeros(0)
    """Their accurate signed distance [m], shape (R,)."""


class Predictor:
    def __init__(self, method: Method, setup: GarmentSetup, library: Library) -> None:
        """Loads what the method needs. Raises `WeightsError` for networks that aren't trained."""
        self._method = method
        self._setup = setup
        self._pipeline: GarmentPipeline | None = None
        worn = Wearable(setup.template, Skinned(), None, margin=0.0)
        if method.handling == "node":
            self._pipeline = library.pipeline(method, setup.template.name)
        elif method.backbone != "skinned":
            worn = library.load(method, setup.template.name)
        self._refu: Refu | None = None
        if method.handling == "refu":
            if worn.refu is None:
                raise WeightsError(f"{method.weights}: weights of a backbone alone, wanted those of one with ReFU")
            self._refu = _with_margin(worn.refu, method.margin)
        self._name = setup.template.name
        self._outfit = Outfit(setup.body, {self._name: replace(worn, refu=self._refu)}, setup.collider)

    @torch.no_grad()
    def __call__(self, scene: SampleScene) -> MethodOutput:
        if self._pipeline is not None:
            return self._of_node(self._pipeline, scene)
        ended: dict[str, float] = {}
        dressed = dress(
            scene.pose,
            Wearer.of(self._outfit, scene.betas, scene.style),
            lap=lambda stage, _: ended.update({stage: time.perf_counter()}),
        )
        drape = dressed.drapes[self._name]
        points = dressed.turns[0](drape.vertices[0])
        ms = {"backbone": 1e3 * (ended["backbone"] - ended["body"])}
        if self._method.sdf is None:
            return MethodOutput(points, ms)
        _, update_ms = scene.sdf(self._method.sdf)
        start = time.perf_counter()
        ask = partial(self._setup.ask[self._method.sdf], on_mean=drape.on_mean[0])
        if self._refu is not None:
            sample = ask(points)
            ms["sdf"] = update_ms + 1e3 * (time.perf_counter() - start)
            return self._push(self._refu, scene, points, sample, drape.feature, ms)
        if self._method.handling == "naive":
            done = repulse(points, ask(points))  # onto the skin exactly (paper, Sec. 4.5)
        else:
            margin = self._method.margin
            kept = {} if margin is None else {"clearance": margin, "reach": margin if self._method.is_kept else 0.0}
            done = self._setup.post_process.optimise(points, ask, **kept)
        ms["post-process"] = update_ms + 1e3 * (time.perf_counter() - start)
        return MethodOutput(done, ms)

    def _push(
        self, refu: Refu, scene: SampleScene, points: Tensor, sample: SdfSample, z: Tensor | None, ms: dict[str, float]
    ) -> MethodOutput:
        """ReFU as in training, one push, no second look; its time is added to `ms` [ms]."""
        start = time.perf_counter()
        batch = SdfSample(sample.distance[None], sample.gradient[None])
        pushed = refu(points[None], batch, z)
        if self._method.is_blended:
            pushed = self._setup.blend.follow(points[None], pushed, batch, refu.margin)
        ms["refu"] = 1e3 * (time.perf_counter() - start)
        rows = torch.nonzero(sample.distance < refu.margin)[:, 0]
        scale, f = refu.of_body(z), sample.distance[rows]
        scales = torch.full_like(f, scale) if isinstance(scale, float) else scale(rows, f)
        exact, _ = scene.sdf("accurate")
        return MethodOutput(pushed[0], ms, scales, f, exact.query(points[rows]).distance)

    def _of_node(self, pipeline: GarmentPipeline, scene: SampleScene) -> MethodOutput:
        frame = SmplFrame(pose=scene.pose[0].numpy(), betas=scene.betas[0].numpy(), style=scene.style[0].numpy())
        start = time.perf_counter()
        output = pipeline(frame)
        ms = {"node": 1e3 * (time.perf_counter() - start)}
        ms |= {f"node {stage}": spent for stage, spent in output.stats.stage_ms.items()}
        return MethodOutput(torch.tensor(output[self._setup.template.name].local), ms)


def _with_margin(refu: Refu, margin: float | None) -> Refu:
    """The layer with another ε; with None, the layer itself."""
    if margin is None:
        return refu
    other = Refu.from_config({**refu.config, "margin": margin})
    other.load_state_dict(refu.state_dict())
    return other.eval()
