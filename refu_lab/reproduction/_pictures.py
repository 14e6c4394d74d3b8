"""Pictures of test samples: the backbone alone beside ReFU and the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from refu_core.metrics import CollisionChecker
from refu_lab.render import Camera, RenderMesh, collision_mesh, render, save_png
from refu_lab.reproduction._load import Library
from refu_lab.reproduction._methods import METHODS
from refu_lab.reproduction._predict import GarmentSetup, Predictor, SampleScene
from refu_lab.reproduction._runs import Study
from refu_lab.reproduction._samples import SampleSet

_SIZE = (420, 560)


def picture_garments(
    study: Study, sets: Sequence[SampleSet], folder: Path, *, library: Library
) -> list[tuple[str, str]]:
    """`<garment>.png`: a sample with many collisions, the backbone alone beside ReFU and the truth.

    The sample is at the 90th percentile of vertices inside, as the backbone leaves them: hard, and not hand-picked.
    Returns (file, caption) of the garments whose networks there are; without networks, the skinned template is shown.
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
    setup, sample = GarmentSetup.of(samples.garment, collider=library.collider, fit=library.fit), samples.read(number)
    scene = SampleScene.of(setup, sample.pose, sample.betas, sample.style)
    shots = [Predictor(METHODS[name], setup, library)(scene).vertices.numpy() for name in methods]
    body, faces = RenderMesh(scene.vertices.numpy(), setup.body.faces.numpy()), setup.template.faces.numpy()
    checker = CollisionChecker(setup.body.faces)
    checker.update(scene.vertices)
    camera = Camera.framing(sample.vertices, size=_SIZE, yaw=25.0)
    images = []
    for vertices in (*shots, sample.vertices):
        found = checker.check(vertices, faces)
        garment = collision_mesh(vertices, faces, found, colour=setup.template.card.color)
        images.append(render([body, garment], camera=camera, size=_SIZE))
    save_png(np.concatenate(images, axis=1), path)
