"""The supplement's plots: energy histograms, scale against distance ratio, collisions far from the training set.

Also pictures of test samples: the backbone alone beside ReFU and the truth.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from refu_core.metrics import CollisionChecker
from refu_lab.plots import COLOURS, new_axes, save_svg
from refu_lab.render import RenderMesh, Viewpoint, collision_mesh, render, save_png
from refu_lab.reproduction._build import ENERGY_ZOOM, unseen_groups
from refu_lab.reproduction._methods import METHODS, Library
from refu_lab.reproduction._predict import GarmentSetup, Predictor, SampleScene
from refu_lab.reproduction._runs import RATIO_EDGES, MethodRun, SampleSet, Study

_SIZE = (8.4, 3.6)


def plot_energy(study: Study, folder: Path) -> list[tuple[str, str]]:
    """Writes `energy.svg` and `energy_zoom.svg`: samples by penetration energy, all garments together.

    Like the other plots, it returns (file, caption) of each file that there was data for.
    """
    shown = _shown(study, ("tailornet", "refu-hybrid"))
    if len(shown) < 2:
        return []
    energies = [run.values("energy") for run in shown.values()]
    top = max(float(energy.max()) for energy in energies)
    plots = []
    for file, end in (("energy.svg", max(top, ENERGY_ZOOM)), ("energy_zoom.svg", ENERGY_ZOOM)):
        figure, (ax,) = new_axes(size=_SIZE)
        bins = np.linspace(0, end, 31).tolist()
        ax.hist([e[e <= end] for e in energies], bins=bins, label=list(shown), color=COLOURS[:2])
        ax.set(xlabel="penetration energy [m²]", ylabel="test samples", yscale="symlog")
        ax.legend(frameon=False)
        save_svg(figure, folder / file)
        plots.append((file, f"Test samples by penetration energy up to {end:.2g} m², all garments together"))
    return plots


def plot_scale(study: Study, folder: Path) -> list[tuple[str, str]]:
    """Writes `scale.svg`: mean α by the ratio of approximate to accurate distance."""
    shown = _shown(study, ("refu-approx", "refu-hybrid"))
    shown = {label: run for label, run in shown.items() if run.scales[0].any()}
    if not shown:
        return []
    figure, (ax,) = new_axes(size=_SIZE)
    places = np.arange(len(RATIO_EDGES) - 1)
    for k, (label, run) in enumerate(shown.items()):
        count, total = run.scales
        mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
        bars = ax.bar(places + 0.4 * k, mean, 0.38, color=COLOURS[k], label=label, align="edge")
        ax.bar_label(bars, [f"{n:,.0f}" if n else "" for n in count], fontsize=7, rotation=90, padding=3)
    names = [f"({low:g}, {high:g}]" for low, high in itertools.pairwise(RATIO_EDGES)]
    ax.set_xticks(places + 0.4, names, rotation=30, fontsize=8)
    ax.set(xlabel="approximate / accurate distance", ylabel="mean α")
    ax.margins(y=0.25)
    ax.legend(frameon=False)
    save_svg(figure, folder / "scale.svg")
    return [
        ("scale.svg", "Mean predicted scale of vertices inside the body, by how wrong their distance is; with counts")
    ]


def plot_unseen(study: Study, folder: Path) -> list[tuple[str, str]]:
    """Writes `unseen.svg`: collision error against the distance to the training set."""
    methods = ("tailornet", "collision-loss-accurate", "collision-loss-approx", "refu-approx", "refu-hybrid")
    figure, (ax,) = new_axes(size=_SIZE)
    for method, colour in zip(methods, COLOURS, strict=True):
        groups = unseen_groups(study.pooled(method))
        if groups:
            x, y = ([values.mean() for values in column] for column in zip(*groups, strict=True))
            ax.plot(x, y, "o-", color=colour, label=METHODS[method].label)
    if not ax.lines:
        return []
    ax.set(xlabel="distance to the nearest training sample", ylabel="mean collision error [mm]")
    ax.set_ylim(bottom=0)
    ax.legend(frameon=False)
    save_svg(figure, folder / "unseen.svg")
    return [("unseen.svg", "Mean collision error Σ max(0, -f) against the distance to the training set, all garments")]


PLOTS = {"energy": plot_energy, "alpha": plot_scale, "unseen": plot_unseen}


def _shown(study: Study, methods: tuple[str, ...]) -> dict[str, MethodRun]:
    return {METHODS[name].label: run for name in methods if (run := study.pooled(name)).samples}


_SHOT = (420, 560)


def picture_garments(
    study: Study, sets: Sequence[SampleSet], folder: Path, *, library: Library
) -> list[tuple[str, str]]:
    """Writes `<garment>.png`: a sample with many collisions, the backbone alone beside ReFU and the truth.

    The sample is at the 90th percentile of vertices inside after the backbone: hard, but not hand-picked. Returns
    (file, caption) of each picture. Without networks the skinned template is shown, where it was run.
    """
    pictures = []
    for samples in sets:
        garment = samples.garment
        pairs = (("tailornet", "refu-hybrid"), ("skinned", "node-skinned"))
        pair = next((pair for pair in pairs if all((garment, name) in study.runs for name in pair)), None)
        if pair is None:
            continue
        inside = study.runs[garment, pair[0]].values("n_inside")
        chosen = int(np.argsort(inside, kind="stable")[int(0.9 * (len(inside) - 1))])
        _draw(samples, chosen, pair, folder / f"{garment}.png", library)
        shown = "; ".join([*(METHODS[name].label for name in pair), "simulated"])
        caption = f"{garment}, test sample {chosen}: {shown}. Red: colliding triangles and vertices inside the body."
        pictures.append((f"{garment}.png", caption))
    return pictures


def _draw(samples: SampleSet, number: int, methods: Sequence[str], path: Path, library: Library) -> None:
    """What each method makes of a sample, and the truth, side by side."""
    setup, sample = GarmentSetup(samples.garment, library), samples.read(number)
    scene = SampleScene(setup, sample.pose, sample.betas, sample.style)
    shots = [Predictor(METHODS[name], setup, library)(scene).vertices.numpy() for name in methods]
    body, faces = RenderMesh(scene.vertices.numpy(), setup.body.faces.numpy()), setup.template.faces.numpy()
    checker = CollisionChecker(setup.body.faces)
    checker.update(scene.vertices)
    camera = Viewpoint.framing(sample.vertices, size=_SHOT, yaw=25.0)
    images = []
    for vertices in (*shots, sample.vertices):
        found = checker.check(vertices, faces)
        garment = collision_mesh(vertices, faces, found, colour=setup.template.card.color)
        images.append(render([body, garment], camera=camera, size=_SHOT))
    save_png(np.concatenate(images, axis=1), path)
