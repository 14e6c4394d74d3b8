"""Translations that may bring a mesh to where it is worn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from refu_core.fitting._posed import PosedBody

F64 = NDArray[np.float64]

LIFTS = (-0.06, 0.06, -0.12, 0.12)
"""How far a mesh is lifted when a search for its height begins [m]: between the origins of SMPL and SMPL-X, and between
the shoulders of people 1.60 and 1.75 m tall, are 12 cm."""
HIGHEST = 0.15
"""How far it is lifted at most [m]; what would have to go farther was modelled otherwise, and is searched for."""


def shifts(body: PosedBody, *, is_placed: bool) -> list[tuple[str, F64]]:
    """Where a mesh may stand by convention: with the body's origin, or on a floor below its feet."""
    found = [("", np.zeros(3)), ("floor", np.array([0.0, body.floor, 0.0]))]
    return found[:1] if is_placed else found


def heights(vertices: F64, body: PosedBody) -> list[F64]:
    """Shifts that put a mesh (V, 3) [m] round the body's middle, at all heights."""
    skin = body.vertices.double().numpy()
    low, high = vertices.min(0), vertices.max(0)
    middle = (low + high) / 2
    found = []
    for height in np.arange(skin[:, 1].min() - low[1], skin[:, 1].max() - high[1] + 0.02, 0.08):
        near = np.abs(skin[:, 1] - (middle[1] + height)) < max(0.05, (high[1] - low[1]) / 4)
        front, back = (skin[near, 2].max(), skin[near, 2].min()) if near.any() else (0.0, 0.0)
        found.append(np.array([-middle[0], height, (front + back) / 2 - middle[2]]))
    return found
