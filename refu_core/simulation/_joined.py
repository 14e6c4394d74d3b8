"""Garments simulated together: one cloth of unconnected parts, from the skin outwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np
import torch
from scipy.spatial import cKDTree

from refu_core.errors import SimulationError
from refu_core.frames import N_STYLES
from refu_core.garments import GarmentTemplate, inner_first
from refu_core.mesh import face_normals
from refu_core.sdf import ExactSdf
from refu_core.simulation._cloth import F32

_OVER = 0.006
"""How far above the garments below it a garment starts [m]: twice the cloth's thickness."""
_BESIDE = 0.025
"""Vertices of inner garments within this of a vertex count as below it [m]: two of a garment's edges."""


def slices_of(counts: Mapping[str, int]) -> dict[str, slice]:
    """The slice of vertices of each garment where garments follow one another, from their numbers of vertices."""
    ends = accumulate(counts.values())
    return {name: slice(end - count, end) for (name, count), end in zip(counts.items(), ends, strict=True)}


class JoinedGarments:
    """Garments worn together, joined into one that is simulated as one cloth: it lies on the skin and on itself.

    A single garment is left as it is.
    """

    def __init__(self, garments: Sequence[GarmentTemplate]) -> None:
        """Joins garments for one body, given in any order.

        Raises `SimulationError` for no garment, for the same one twice, and for garments of different bodies.
        """
        by_name = {garment.name: garment for garment in garments}
        if not garments or len(by_name) < len(garments) or len({garment.body for garment in garments}) > 1:
            named = ", ".join(f"{garment.name} for {garment.body}" for garment in garments) or "none"
            raise SimulationError(f"wanted different garments of one body, got {named}")
        self.garments = tuple(by_name[name] for name in inner_first(by_name))
        """From the skin outwards."""
        self.parts = slices_of({garment.name: garment.n_vertices for garment in self.garments})
        """Which of the joined garment's vertices are each garment's."""
        self.joined = _joined(self.garments, self.parts)
        """All garments as one template; its name contains all their names, its card is the outermost garment's."""

    def layered(self, positions: F32, body: F32, sdf: ExactSdf) -> F32:
        """`positions` (N, 3) [m] with each garment lifted off the skin until it is above the garments below it.

        `sdf` is that of the body's vertices `body` (V, 3). Where garments are far apart nothing moves.
        """
        out: F32 = positions.copy()
        for garment in self.garments[1:]:
            own = self.parts[garment.name]
            found = sdf.closest(torch.from_numpy(out[: own.stop]))
            height = (found.distance * found.sign).numpy()
            normals = face_normals(body, sdf.faces.numpy()[found.face[own].numpy()])
            outwards = normals / np.linalg.norm(normals, axis=1, keepdims=True)
            below, mine = out[: own.start], out[own]
            beside = cKDTree(below).query_ball_point(mine, _BESIDE)
            highest = np.array([height[near].max() + _OVER if near else -np.inf for near in beside], np.float32)
            lift = np.maximum(highest - height[own], 0)
            out[own] = mine + lift[:, None] * outwards
        return out


def _joined(garments: tuple[GarmentTemplate, ...], parts: Mapping[str, slice]) -> GarmentTemplate:
    if len(garments) == 1:
        return garments[0]
    styledirs = [
        torch.zeros_like(garment.shapedirs[:, :N_STYLES]) if garment.styledirs is None else garment.styledirs
        for garment in garments
    ]
    return replace(
        garments[-1],
        name="+".join(garment.name for garment in garments),
        faces=torch.cat([garment.faces + parts[garment.name].start for garment in garments]),
        weights=torch.cat([garment.weights for garment in garments]),
        v_template=torch.cat([garment.v_template for garment in garments]),
        shapedirs=torch.cat([garment.shapedirs for garment in garments]),
        styledirs=torch.cat(styledirs),
        uv=None,
    )
