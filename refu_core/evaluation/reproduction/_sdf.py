"""Supplement, Tab. "sdf": errors of the approximations of the body's signed distance."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from refu_core.body import SmplBody, load_body
from refu_core.errors import WeightsError
from refu_core.evaluation.reproduction._load import Library
from refu_core.evaluation.reproduction._predict import Scene, Wardrobe
from refu_core.evaluation.reproduction._samples import Samples
from refu_core.evaluation.reproduction._tables import Missing, Row, Table
from refu_core.evaluation.sdf_errors import SdfErrors
from refu_core.garments import load_garment
from refu_core.sdf import SDF_PRESETS, BodySdf, NeuralSdf, SdfNetwork

DISTURBANCE = 0.01
"""Standard deviation of the Gaussian disturbance of every other point, each axis [m]."""
NEAR_SKIN = 0.02
"""Within this of the skin [m] the distance decides what ReFU does."""
LABELS: Mapping[str, str] = {
    "approx": "walk over the posed mesh (real time)",
    "approx, within 2 cm": "the same, points within 2 cm of the skin",
    "neural": "the paper's network",
    "neural, within 2 cm": "the same, points within 2 cm of the skin",
    "neural-small": "a network of its kind that a CPU can train",
    "neural-small, within 2 cm": "the same, points within 2 cm of the skin",
}
PRESETS: Mapping[str, str] = {"neural": "paper", "neural-small": "small"}
"""The distance networks of the table, and the presets that they are trained with."""
_POINTS_ASKED = 8
"""Networks are asked for every so-many-th vertex: a second a thousand points, the paper's on one core."""
_METRICS = ("mean_absolute_mm", "mean_relative_percent", "p99_mm", "missed_percent")


def sdf_table(
    sets: Sequence[Samples],
    *,
    library: Library,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Errors of each approximation at the garments' vertices over the test samples, half of them disturbed."""
    table = Table(
        "sdf",
        "Errors of the approximate signed distance",
        f"At the vertices of the simulated garments, half of them disturbed by {1e3 * DISTURBANCE:g} mm (Gaussian, "
        "each axis): the second of the paper's three kinds of samples, and the points that ReFU asks for. The paper's "
        "figures are over all three kinds, of its network. The relative error leaves out points within 0.1 mm of the "
        "skin.",
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
        found: dict[str, list[tuple[Tensor, Tensor]]] = {name: [] for name in sdfs}
        rng = np.random.default_rng(0)
        for sample in map(samples.read, range(len(samples))):
            scene = Scene.of(wardrobe, sample.pose, sample.betas, sample.style)
            disturbance = rng.normal(scale=DISTURBANCE, size=sample.vertices.shape)
            disturbance[rng.random(len(disturbance)) < 0.5] = 0
            points = torch.from_numpy(sample.vertices + disturbance.astype(np.float32))
            near = wardrobe.near(template.unpose(points[None], scene.transforms)[0], scene.betas)
            exact, _ = scene.sdf("accurate")
            truth = exact.query(points).distance
            for name, sdf in sdfs.items():
                sdf.update(scene.vertices, pose=scene.pose[0], betas=scene.betas[0])
                asked = slice(None, None, 1 if name == "approx" else _POINTS_ASKED)
                distance = sdf.query(points[asked], near=near[asked]).distance.detach()
                found[name].append((distance, truth[asked]))
            done += 1
            if progress is not None:
                progress(done, total)
        for name in ("approx", *PRESETS):
            table.rows += _rows(garment, name, found.get(name, []))
    return table


def _network(name: str, garment: str, body: SmplBody, library: Library) -> BodySdf | Missing:
    """The network of a row, or why there is none."""
    try:
        return library.load_neural_sdf(PRESETS[name], garment, body)
    except WeightsError as error:
        command = f"refu train {garment} --data DIR --network sdf --preset {PRESETS[name]}"
        return Missing(garment, name, str(error), command)


def _rows(garment: str, name: str, pairs: Sequence[tuple[Tensor, Tensor]]) -> list[Row]:
    f, s = (torch.cat([pair[k] for pair in pairs]).numpy() if pairs else np.zeros(0) for k in (0, 1))
    near = np.abs(s) < NEAR_SKIN
    everywhere, close = SdfErrors.between(f, s), SdfErrors.between(f[near], s[near])
    return [Row.of("sdf", garment, name, metric, getattr(everywhere, metric)) for metric in _METRICS] + [
        Row.of("sdf", garment, f"{name}, within 2 cm", metric, getattr(close, metric)) for metric in _METRICS
    ]


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
