"""A picture of a data set: random samples from the front and from behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refu_core.body import Collider, load_body
from refu_core.garments import load_garment
from refu_core.simulation import GarmentDataset, SimulationError, colliders
from refu_lab.render import Backdrop, Camera, RenderMesh, render

_CLOTH = ((0.36, 0.52, 0.66), (0.72, 0.42, 0.36), (0.42, 0.56, 0.42), (0.62, 0.54, 0.36))
_TILE = (128, 160)
"""Width and height of one view [pixels]."""


def contact_sheet(
    dataset: GarmentDataset,
    *,
    count: int = 24,
    columns: int = 6,
    seed: int = 0,
    body: str | Path | None = None,
    garments: Sequence[str | Path] | None = None,
) -> NDArray[np.uint8]:
    """Draws random samples of a set side by side, each from the front and from behind.

    Args:
        dataset: with one finished sample at least.
        count: samples in the picture, or all of a smaller set.
        columns: samples in a row.
        seed: of their choice.
        body: name or file of the body that the set was made for; None for the one that the garment was cut for.
        garments: names or files of the set's garments; None for those that have the names which the set says.

    Returns:
        sRGB, shape (height, width, 3).

    Raises:
        SimulationError: the set is empty, `count` or `columns` is below 1, or the set was made for another body.
    """
    if not len(dataset) or count < 1 or columns < 1:
        msg = f"wanted a sample, a count and columns of 1 at least, got {len(dataset)}, {count} and {columns}"
        raise SimulationError(msg)
    templates = {one.name: one for one in map(load_garment, dataset.parts if garments is None else garments)}
    model = load_body(next(iter(templates.values())).body if body is None else body)
    if model.fingerprint != dataset.card["body_fingerprint"]:
        msg = f"the set was made for the body {dataset.card['body']!r}, got {model.name!r}: name its file as `body`"
        raise SimulationError(msg)
    collider = Collider(model, gap=dataset.card["settings"]["drape"]["gap"])
    chosen = np.random.default_rng(seed).permutation(len(dataset))[:count]
    width, height = _TILE
    columns = min(columns, len(chosen))
    rows = -(-len(chosen) // columns)
    sheet = np.full((rows * height, columns * 2 * width, 3), 255, np.uint8)
    for k, index in enumerate(chosen):
        sample = dataset.sample(int(index))
        (posed,) = colliders(model, collider, sample.pose[None], sample.betas)
        meshes = [RenderMesh(posed, model.faces)] + [
            RenderMesh(sample.vertices[part], templates[name].faces, colour=_CLOTH[(sample.pair + n) % len(_CLOTH)])
            for n, (name, part) in enumerate(dataset.parts.items())
        ]
        top, left = k // columns * height, k % columns * 2 * width
        for side, yaw in enumerate((20.0, 200.0)):
            camera = Camera.framing(sample.vertices, size=_TILE, yaw=yaw, margin=1.45)
            start = left + side * width
            view = render(meshes, camera=camera, size=_TILE, samples=4, backdrop=Backdrop(show_ground=False))
            sheet[top : top + height, start : start + width] = view
    return sheet
