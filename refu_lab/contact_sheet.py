"""A picture of a data set: random samples from the front and from behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refu_core.body import Collider, ColliderSettings, load_body
from refu_core.garments import load_garment
from refu_core.simulation import GarmentDataset, SimulationError, colliders
from refu_lab.render import Backdrop, RenderMesh, Viewpoint, render

_CLOTH = ((0.36, 0.52, 0.66), (0.72, 0.42, 0.36), (0.42, 0.56, 0.42), (0.62, 0.54, 0.36))
_TILE = (128, 160)
"""Width and height of one view [pixels]."""
_COLUMNS = 6


def contact_sheet(
    dataset: GarmentDataset,
    *,
    count: int = 24,
    seed: int = 0,
    body: str | Path | None = None,
    garments: Sequence[str | Path] | None = None,
) -> NDArray[np.uint8]:
    """Draws `count` random samples of a set (or all, if it has fewer), each from the front and from behind.

    `body` is the one that the set was made for, by name or file, and `garments` are its garments; None takes those that
    the card names. Returns sRGB, shape (height, width, 3). Raises `SimulationError` if the set is for another body.
    """
    templates = {one.name: one for one in map(load_garment, dataset.parts if garments is None else garments)}
    model = load_body(next(iter(templates.values())).body if body is None else body)
    if model.fingerprint != dataset.card["body_fingerprint"]:
        msg = f"the set was made for the body {dataset.card['body']!r}, got {model.name!r}: name its file as `body`"
        raise SimulationError(msg)
    collider = Collider(model, settings=ColliderSettings(gap=dataset.card["settings"]["drape"]["gap"]))
    tiles = []
    for index in np.random.default_rng(seed).permutation(len(dataset))[:count]:
        sample = dataset.sample(int(index))
        (posed,) = colliders(model, collider, sample.pose[None], sample.betas)
        meshes = [RenderMesh(posed, model.faces)] + [
            RenderMesh(sample.vertices[part], templates[name].faces, colour=_CLOTH[(sample.pair + n) % len(_CLOTH)])
            for n, (name, part) in enumerate(dataset.parts.items())
        ]
        for yaw in (20.0, 200.0):
            camera = Viewpoint.framing(sample.vertices, size=_TILE, yaw=yaw, margin=1.45)
            backdrop = Backdrop(show_ground=False)
            tiles.append(render(meshes, camera=camera, size=_TILE, samples=4, backdrop=backdrop))
    columns = min(2 * _COLUMNS, len(tiles))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
    return np.concatenate(rows)
