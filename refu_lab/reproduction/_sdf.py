"""The supplement's errors of the approximate signed distance (Sec. A)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from tqdm import tqdm

from refu_core.errors import WeightsError
from refu_core.sdf import BodySdf, NeuralSdf, RestFaces, load_sdf_network
from refu_core.simulation import posture
from refu_lab.reproduction._methods import Library
from refu_lab.reproduction._predict import GarmentSetup, SampleScene
from refu_lab.reproduction._runs import Sample, SampleSet
from refu_lab.reproduction._tables import Missing, ResultTable

_AT_SURFACE = 1e-4
"""Closer to the skin than this [m], a relative error means nothing."""
MISS = 2e-3
"""An error above this [m] counts as a miss."""


def sdf_errors(approximate: ArrayLike, accurate: ArrayLike) -> dict[str, float | None]:
    """Errors of distances f against s [m], both of shape (P,), by metric; None if a metric has no points."""
    f, s = np.asarray(approximate, np.float64), np.asarray(accurate, np.float64)
    error: NDArray[np.float64] = np.abs(f - s)
    off = np.abs(s) > _AT_SURFACE

    def mean(factor: float, values: NDArray[Any]) -> float | None:
        return factor * float(values.mean()) if len(values) else None

    return {
        "mean_absolute_mm": mean(1e3, error),  # supplement, Eq. 12
        "mean_relative_percent": mean(100.0, error[off] / np.abs(s[off])),  # Eq. 15
        "p99_mm": 1e3 * float(np.percentile(error, 99)) if len(error) else None,
        "missed_percent": mean(100.0, error > MISS),
        "hidden_percent": mean(100.0, (s < -MISS) & (f >= 0)),  # inside but taken for outside, so it goes unnoticed
    }


DISTURBANCE = 0.01
"""Standard deviation along each axis of the Gaussian disturbance of half of the points [m]."""
NEAR_SKIN = 0.02
"""Within this distance of the skin [m], errors matter for what ReFU does."""
FOLDED_POSES = ("squat", "crossed arms", "hands on hips")
"""Names of the postures (of `POSTURES`) in which the body is folded."""
_FOLDED_SHAPES = 8
"""Number of body shapes that each of them is tried with."""
_POINTS_ASKED = 8
"""The network is asked for one vertex in so many: a thousand points take it a second on one core."""
_CLOSE = ", within 2 cm"
_NAMES = {"approx": "walk over the posed mesh (real time)", "neural": "the paper's network"}


def sdf_table(sets: Sequence[SampleSet], *, library: Library, progress: bool = False) -> ResultTable:
    """Errors of each approximation at (partly disturbed) garment vertices, in the test samples and in folded poses."""
    labels = dict(_NAMES)
    for name in _NAMES:
        labels[name + _CLOSE] = "the same, points within 2 cm of the skin"
        labels |= {f"{name}, {pose}": f"the same, {pose}, points within 2 cm of the skin" for pose in FOLDED_POSES}
    table = ResultTable.of("sdf", labels=labels, disturbance_mm=1e3 * DISTURBANCE, shapes=_FOLDED_SHAPES)
    for samples in sets:
        garment = samples.garment
        setup = GarmentSetup(garment, library)
        sdfs: dict[str, BodySdf] = {"approx": setup.approx}
        try:
            network = load_sdf_network(library.find("sdf-paper", garment), setup.body)
            sdfs["neural"] = NeuralSdf(network.eval().requires_grad_(False), setup.body)
        except WeightsError as error:
            command = f"refu train {garment} --data DIR --network sdf --preset paper"
            table.missing.append(Missing(garment, "neural", str(error), command))
            table.add(garment, "neural", dict.fromkeys(sdf_errors([], [])))
        questions = _Questions(setup, sdfs)
        bodies: dict[bytes, Sample] = {}
        numbers = tqdm(range(len(samples)), desc=f"sdf, {garment}", unit="sample", disable=None if progress else True)
        for sample in map(samples.read, numbers):
            scene = SampleScene(setup, sample.pose, sample.betas, sample.style)
            questions.ask(scene, torch.from_numpy(sample.vertices))
            bodies.setdefault(sample.betas.tobytes(), sample)
        for name, (found, truth) in questions.answers().items():
            table.add(garment, name, sdf_errors(found, truth))
            table.add(garment, name + _CLOSE, _close_errors(found, truth))
        for title in FOLDED_POSES:
            pose = posture(title)
            for sample in list(bodies.values())[:_FOLDED_SHAPES]:
                scene = SampleScene(setup, pose, sample.betas, sample.style)
                unposed = setup.template.rest(scene.betas, setup.template.own(scene.style))
                questions.ask(scene, setup.template.pose(unposed, scene.transforms)[0])
            for name, answers in questions.answers().items():
                table.add(garment, f"{name}, {title}", _close_errors(*answers))
    return table


class _Questions:
    """Asks several distances about a garment on bodies, and keeps their answers."""

    def __init__(self, setup: GarmentSetup, sdfs: Mapping[str, BodySdf]) -> None:
        self._setup, self._sdfs, self._rest_faces = setup, sdfs, RestFaces(setup.body)
        self._random = np.random.default_rng(0)
        self._asked: dict[str, list[NDArray[np.float32]]] = {name: [] for name in sdfs}

    def ask(self, scene: SampleScene, vertices: Tensor) -> None:
        """Asks about a garment's vertices [m], shape (N, 3), half of which it disturbs first."""
        disturbance = self._random.normal(scale=DISTURBANCE, size=vertices.shape)
        disturbance[self._random.random(len(disturbance)) < 0.5] = 0
        points = vertices + torch.from_numpy(disturbance.astype(np.float32))
        template = self._setup.template
        unposed = template.unpose(points[None], scene.transforms)
        near = self._rest_faces.under(unposed, scene.betas, template.shapedirs)[0]
        exact, _ = scene.sdf("accurate")
        truth = exact.query(points).distance
        for name, sdf in self._sdfs.items():
            sdf.update(scene.vertices, pose=scene.pose[0], betas=scene.betas[0])
            rows = slice(None, None, 1 if name == "approx" else _POINTS_ASKED)
            distance = sdf.query(points[rows], near=near[rows]).distance.detach()
            self._asked[name].append(torch.stack((distance, truth[rows])).numpy())

    def answers(self) -> dict[str, NDArray[np.float32]]:
        """Approximate and accurate distances [m], shape (2, P), since the last call, by name of the approximation."""
        found = {name: np.concatenate(asked, axis=1) for name, asked in self._asked.items()}
        self._asked = {name: [] for name in self._sdfs}
        return found


def _close_errors(found: NDArray[np.float32], truth: NDArray[np.float32]) -> dict[str, float | None]:
    close = np.abs(truth) < NEAR_SKIN
    return sdf_errors(found[close], truth[close])
