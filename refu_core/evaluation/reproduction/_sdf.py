"""Supplement, Tab. "sdf": errors of the approximations of the body's signed distance."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from refu_core.body import SmplBody, load_body
from refu_core.errors import WeightsError
from refu_core.evaluation.reproduction._load import Library
from refu_core.evaluation.reproduction._predict import Scene, Wardrobe
from refu_core.evaluation.reproduction._samples import Sample, Samples
from refu_core.evaluation.reproduction._tables import Missing, Row, Table
from refu_core.evaluation.sdf_errors import SdfErrors
from refu_core.evaluation.self_contact import SelfContactDetector
from refu_core.garments import load_garment
from refu_core.sdf import SDF_PRESETS, BodySdf, NeuralSdf, SdfNetwork

DISTURBANCE = 0.01
"""Standard deviation of the Gaussian disturbance of every other point, each axis [m]."""
NEAR_SKIN = 0.02
"""Within this of the skin [m] the distance decides what ReFU does."""
FOLDED_POSES: Mapping[str, Mapping[int, tuple[float, float, float]]] = {
    "squat": {1: (-1.5, 0, 0.2), 2: (-1.5, 0, -0.2), 4: (1.8, 0, 0), 5: (1.8, 0, 0)},
    "crossed arms": {16: (0, -0.6, -1.1), 17: (0, 0.6, 1.1), 18: (0, -2.0, 0), 19: (0, 2.0, 0)},
    "hands on hips": {16: (0.3, 0.5, -0.9), 17: (0.3, -0.5, 0.9), 18: (0, -1.7, 0), 19: (0, 1.7, 0)},
}
"""Poses in which the body touches itself: rotation vectors of joints [rad], zero for those that aren't named."""
_FOLDED_SHAPES = 8
"""Body shapes that each of them is taken with."""
PRESETS: Mapping[str, str] = {"neural": "paper", "neural-small": "small"}
"""The distance networks of the table, and the presets that they are trained with."""
_NAMES: Mapping[str, str] = {
    "approx": "walk over the posed mesh (real time)",
    "neural": "the paper's network",
    "neural-small": "a network of its kind that a CPU can train",
}
_CLOSE = ", within 2 cm"
_AWAY = ", within 2 cm, away from self-contact"
LABELS: Mapping[str, str] = {
    label: text
    for name, title in _NAMES.items()
    for label, text in (
        (name, title),
        (name + _CLOSE, "the same, points within 2 cm of the skin"),
        (name + _AWAY, "the same, away from where the body touches itself, too"),
        *((f"{name}, {pose}", f"the same, {pose}, points within 2 cm of the skin") for pose in FOLDED_POSES),
    )
}
"""The rows' names for people."""
_POINTS_ASKED = 8
"""Networks are asked for every so-many-th vertex: a second a thousand points, the paper's on one core."""
_METRICS = ("mean_absolute_mm", "mean_relative_percent", "p99_mm", "missed_percent", "hidden_percent")


class _Asked(NamedTuple):
    """Distances at the same points [m], each of the shape (P,)."""

    approximate: Tensor
    accurate: Tensor
    is_away: Tensor
    """Whether the point is away from where the body touches itself."""


def sdf_table(
    sets: Sequence[Samples],
    *,
    library: Library,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Errors of each approximation at the garments' vertices, half of them disturbed: over the test samples, and where
    the body is folded."""
    table = Table(
        "sdf",
        "Errors of the approximate signed distance",
        f"At the vertices of the simulated garments, half of them disturbed by {1e3 * DISTURBANCE:g} mm (Gaussian, "
        "each axis): the second of the paper's three kinds of samples, and the points that ReFU asks for. The paper's "
        "figures are over all three kinds, of its network. The relative error leaves out points within 0.1 mm of the "
        f"skin. Squat, crossed arms and hands on hips are those poses of {_FOLDED_SHAPES} of the bodies, with the "
        "garment as it follows the skin: there the body runs into itself, and a limb's inside is another's outside.",
    )
    total = sum(map(len, sets))
    done = 0
    for samples in sets:
        garment = samples.garment
        template = load_garment(garment)
        wardrobe = Wardrobe.of(template, load_body(template.body))
        sdfs: dict[str, BodySdf] = {"approx": wardrobe.approx}
        for name in PRESETS:
            network = _network(name, garment, wardrobe.body, library)
            if isinstance(network, Missing):
                table.missing.append(network)
            else:
                sdfs[name] = network
        asking = _Asking(wardrobe, sdfs)
        found: dict[str, list[_Asked]] = {name: [] for name in sdfs}
        bodies: dict[bytes, Sample] = {}
        for sample in map(samples.read, range(len(samples))):
            scene = Scene.of(wardrobe, sample.pose, sample.betas, sample.style)
            for name, asked in asking(scene, torch.from_numpy(sample.vertices)).items():
                found[name].append(asked)
            bodies.setdefault(sample.betas.tobytes(), sample)
            done += 1
            if progress is not None:
                progress(done, total)
        for name in ("approx", *PRESETS):
            table.rows += _rows(garment, name, found.get(name, []))
        for title, folded in FOLDED_POSES.items():
            pose = np.zeros((24, 3), np.float32)
            for joint, rotation in folded.items():
                pose[joint] = rotation
            found = {name: [] for name in sdfs}
            for sample in list(bodies.values())[:_FOLDED_SHAPES]:
                scene = Scene.of(wardrobe, pose, sample.betas, sample.style)
                skinned = template.pose(template.rest(scene.betas, scene.style), scene.transforms)[0]
                for name, asked in asking(scene, skinned).items():
                    found[name].append(asked)
            for name, pairs in found.items():
                table.rows += _rows_of(garment, f"{name}, {title}", _joined(pairs), is_close=True)
    return table


class _Asking:
    """Asks several distances about a garment on a body."""

    def __init__(self, wardrobe: Wardrobe, sdfs: Mapping[str, BodySdf]) -> None:
        self._wardrobe, self._sdfs = wardrobe, sdfs
        self._random = np.random.default_rng(0)
        self._detectors: dict[bytes, SelfContactDetector] = {}

    def __call__(self, scene: Scene, vertices: Tensor) -> dict[str, _Asked]:
        """What each distance says at a garment's vertices [m], shape (N, 3), half of them disturbed."""
        disturbance = self._random.normal(scale=DISTURBANCE, size=vertices.shape)
        disturbance[self._random.random(len(disturbance)) < 0.5] = 0
        points = vertices + torch.from_numpy(disturbance.astype(np.float32))
        unposed = self._wardrobe.template.unpose(points[None], scene.transforms)[0]
        near = self._wardrobe.near(unposed, scene.betas)
        exact, _ = scene.sdf("accurate")
        truth = exact.query(points).distance
        contact = self._detector(scene.betas).detect(scene.vertices)
        is_away = torch.from_numpy(~contact.near(points))
        said = {}
        for name, sdf in self._sdfs.items():
            sdf.update(scene.vertices, pose=scene.pose[0], betas=scene.betas[0])
            rows = slice(None, None, 1 if name == "approx" else _POINTS_ASKED)
            distance = sdf.query(points[rows], near=near[rows]).distance.detach()
            said[name] = _Asked(distance, truth[rows], is_away[rows])
        return said

    def _detector(self, betas: Tensor) -> SelfContactDetector:
        """That of a body shape, (1, 10): which faces overlap at rest already depends on it."""
        key = betas.numpy().tobytes()
        if key not in self._detectors:
            body = self._wardrobe.body
            self._detectors[key] = SelfContactDetector(body.faces, body.rest_vertices(betas)[0])
        return self._detectors[key]


def _network(name: str, garment: str, body: SmplBody, library: Library) -> BodySdf | Missing:
    """The network of a row, or why there is none."""
    try:
        return library.load_neural_sdf(PRESETS[name], garment, body)
    except WeightsError as error:
        command = f"refu train {garment} --data DIR --network sdf --preset {PRESETS[name]}"
        return Missing(garment, name, str(error), command)


def _joined(pairs: Sequence[_Asked]) -> _Asked:
    if not pairs:
        return _Asked(torch.zeros(0), torch.zeros(0), torch.zeros(0, dtype=torch.bool))
    return _Asked(*(torch.cat(columns) for columns in zip(*pairs, strict=True)))


def _rows(garment: str, name: str, pairs: Sequence[_Asked]) -> list[Row]:
    asked = _joined(pairs)
    away = _Asked(*(column[asked.is_away] for column in asked))
    return [
        *_rows_of(garment, name, asked),
        *_rows_of(garment, name + _CLOSE, asked, is_close=True),
        *_rows_of(garment, name + _AWAY, away, is_close=True),
    ]


def _rows_of(garment: str, method: str, asked: _Asked, *, is_close: bool = False) -> list[Row]:
    close = asked.accurate.abs() < (NEAR_SKIN if is_close else float("inf"))
    errors = SdfErrors.between(asked.approximate[close].numpy(), asked.accurate[close].numpy())
    return [Row.of("sdf", garment, method, metric, getattr(errors, metric)) for metric in _METRICS]


def neural_time_rows(sets: Sequence[Samples], *, repeats: int = 3) -> list[Row]:
    """What one frame costs with the paper's network on this machine; untrained, as the weights don't matter to that."""
    rows = []
    for samples in sets:
        template = load_garment(samples.garment)
        body = load_body(template.body)
        sdf = NeuralSdf(SdfNetwork(SDF_PRESETS["paper"]).eval().requires_grad_(False), body)
        sample = samples.read(0)
        pose, betas = torch.from_numpy(sample.pose), torch.from_numpy(sample.betas)
        sdf.update(body.v_template, pose=pose, betas=betas)
        ms = []
        for _ in range(repeats):
            start = time.perf_counter()
            sdf.query(torch.from_numpy(sample.vertices))
            ms.append(1e3 * (time.perf_counter() - start))
        rows.append(Row.of("time", samples.garment, "sdf-neural", "ms", float(np.median(ms))))
    return rows
