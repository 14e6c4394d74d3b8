"""Pictures of test samples: every garment before and after, and the pump-out of a fixed scale close by."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from refu_core.body import load_body
from refu_core.evaluation.collisions import CollisionChecker
from refu_core.evaluation.render import GARMENT_COLOURS, Camera, RenderMesh, render, save_png
from refu_core.evaluation.reproduction._load import Library
from refu_core.evaluation.reproduction._methods import METHODS
from refu_core.evaluation.reproduction._predict import Predictor, Scene, Wardrobe
from refu_core.evaluation.reproduction._runs import Study
from refu_core.evaluation.reproduction._samples import Samples
from refu_core.garments import load_garment

_SIZE = (420, 560)
_MARK = np.array([0.90, 0.10, 0.10])
"""Colour of colliding garment triangles and of vertices inside the body, sRGB."""
_CLOSE_UP = 0.16
"""Half the height of a close-up [m]."""


class _Shot(NamedTuple):
    title: str
    vertices: NDArray[np.float32]


def picture_garments(study: Study, sets: Sequence[Samples], folder: Path, *, library: Library) -> list[tuple[str, str]]:
    """`<garment>.png`: a sample with many collisions, the backbone alone beside ReFU and the truth (Fig. "visual").

    The sample is at the 90th percentile of vertices inside, as the backbone leaves them: hard, and not hand-picked.
    Returns (file, caption) of the garments whose networks there are.
    """
    pictures = []
    for samples in sets:
        garment = samples.garment
        first, second = _trained_pair(study, garment)
        run = study.runs.get((garment, first))
        if run is None or not run.samples or (garment, second) not in study.runs:
            continue
        inside = np.array([sample.n_inside for sample in run.samples])
        chosen = int(np.argsort(inside, kind="stable")[int(0.9 * (len(inside) - 1))])
        wardrobe = _wardrobe(garment)
        scene, truth = _scene(wardrobe, samples, chosen)
        shots = [_shot(METHODS[name].label, name, wardrobe, scene, library) for name in (first, second)]
        _draw(wardrobe, scene, [*shots, _Shot("simulated", truth)], folder / f"{garment}.png", focus=None)
        pictures.append(
            (
                f"{garment}.png",
                f"{garment}, test sample {chosen}: {_plain(first)}; {_plain(second)}; simulated. Red: colliding "
                "triangles and vertices inside the body.",
            )
        )
    return pictures


def picture_pump_out(study: Study, sets: Sequence[Samples], folder: Path, *, library: Library) -> list[tuple[str, str]]:
    """`pump_out.png`: where a fixed scale pushes furthest beyond what a predicted one does (Fig. "pump")."""
    for samples in sets:
        garment = samples.garment
        if any((garment, name) not in study.runs for name in ("fixed-approx", "refu-approx")):
            continue
        wardrobe = _wardrobe(garment)
        worse = np.array([sample.mpve_mm or 0.0 for sample in study.runs[garment, "fixed-approx"].samples])
        worse -= np.array([sample.mpve_mm or 0.0 for sample in study.runs[garment, "refu-approx"].samples])
        chosen = int(worse.argmax())
        scene, truth = _scene(wardrobe, samples, chosen)
        shots = [_shot(METHODS[m].label, m, wardrobe, scene, library) for m in ("fixed-approx", "refu-approx")]
        error = [np.linalg.norm(shot.vertices - truth, axis=1) for shot in shots]
        focus = truth[int((error[0] - error[1]).argmax())]
        _draw(wardrobe, scene, [*shots, _Shot("simulated", truth)], folder / "pump_out.png", focus=focus)
        caption = f"{garment}, test sample {chosen}: fixed scale; predicted scale; simulated"
        return [("pump_out.png", caption)]
    return []


def _trained_pair(study: Study, garment: str) -> tuple[str, str]:
    """What is shown before and after: the paper's, or what there is without networks."""
    pair = ("tailornet", "refu-hybrid")
    return pair if all((garment, name) in study.runs for name in pair) else ("skinned", "node-skinned")


def _wardrobe(garment: str) -> Wardrobe:
    template = load_garment(garment)
    return Wardrobe.of(template, load_body(template.body))


def _scene(wardrobe: Wardrobe, samples: Samples, number: int) -> tuple[Scene, NDArray[np.float32]]:
    sample = samples.read(number)
    return Scene.of(wardrobe, sample.pose, sample.betas, sample.style), sample.vertices


def _shot(title: str, name: str, wardrobe: Wardrobe, scene: Scene, library: Library) -> _Shot:
    return _Shot(title, Predictor(METHODS[name], wardrobe, library)(scene).vertices.numpy())


def _draw(
    wardrobe: Wardrobe, scene: Scene, shots: Sequence[_Shot], path: Path, *, focus: NDArray[np.float32] | None
) -> None:
    body, faces = scene.vertices.numpy(), wardrobe.template.faces.numpy()
    body_faces = wardrobe.body.faces.numpy()
    checker = CollisionChecker(body_faces)
    checker.update(body)
    camera = _camera(scene, shots[-1].vertices, focus)
    images = []
    for shot in shots:
        found = checker.check(shot.vertices, faces)
        colours = np.tile(np.array(GARMENT_COLOURS[wardrobe.template.name]), (len(shot.vertices), 1))
        colours[faces[np.unique(found.pairs[:, 0])].reshape(-1)] = _MARK
        colours[found.inside] = _MARK
        meshes = [RenderMesh(body, body_faces), RenderMesh(shot.vertices, faces, colours)]
        images.append(render(meshes, camera=camera, size=_SIZE))
    save_png(np.concatenate(images, axis=1), path)


def _camera(scene: Scene, garment: NDArray[np.float32], focus: NDArray[np.float32] | None) -> Camera:
    if focus is None:
        return Camera.framing(garment, size=_SIZE, yaw=25.0)
    exact, _ = scene.sdf("accurate")
    outward = exact.query(scene.vertices.new_tensor(focus)[None]).gradient[0].numpy()
    yaw = float(np.degrees(np.arctan2(outward[0], outward[2])))
    pitch = float(np.degrees(np.arcsin(np.clip(outward[1], -0.8, 0.8))))
    return Camera.looking_at(focus, distance=_CLOSE_UP / np.tan(np.radians(13.0)), yaw=yaw, pitch=pitch)


def _plain(method: str) -> str:
    return METHODS[method].label.replace("*", "")


PICTURES = {"comparison": picture_garments, "ablation": picture_pump_out}
"""What draws the pictures of a table."""
