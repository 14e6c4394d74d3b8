"""Smooths cloth that has come to rest intersecting itself, in a crease narrower than its mesh can show."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse

from refu_core.mesh import Connectivity
from refu_core.metrics import SheetChecker
from refu_core.sdf import ExactSdf
from refu_core.simulation._cloth import F32

_ROUNDS = 8
"""Most rounds. Nearly all that can be resolved takes one to three, each over a wider part of the cloth."""
_RINGS = 2
"""Rings of neighbours around intersecting faces that a round smooths with them."""
_SWEEPS = (4, 5)
"""Per round: pushes off the skin, and smoothing sweeps before each push."""


class Untangle:
    """Smooths a settled garment where its own faces intersect, as in the crook of an elbow bent by 2 rad.

    There is no room there for two layers and their folds, and as only vertices are kept off faces, edges slip through
    each other. Vertices around move towards the mean of their neighbours and are then pushed off the skin, as in ReFU.
    """

    def __init__(self, mesh: Connectivity, sdf: ExactSdf, *, margin: float) -> None:
        """For a garment that is kept `margin` above the body behind `sdf` [m]."""
        self._faces, self._sdf, self._margin = np.asarray(mesh.faces), sdf, margin
        around = mesh.adjacency_matrix()
        share = around.multiply(1 / np.maximum(around.sum(1), 1)[:, None])
        self._mean = sparse.csr_array(share.astype(np.float32))
        self._sheet = SheetChecker(self._faces)

    def __call__(self, vertices: F32, body: F32) -> F32:
        """Smoothed vertices (N, 3) of the garment on a body (V, 3) [m]: the very same array if no faces intersect.

        Some faces may still intersect after the last round.
        """
        points, is_loose = vertices, np.zeros(len(vertices), np.bool_)
        for round_ in range(_ROUNDS):
            self._sheet.update(points)
            pairs = self._sheet.with_itself()
            if not len(pairs):
                break
            if not round_:
                points = vertices.copy()
                self._sdf.update(torch.from_numpy(np.ascontiguousarray(body)))
            is_loose[self._faces[pairs]] = True
            for _ in range(_RINGS):
                is_loose |= self._mean @ is_loose.astype(np.float32) > 0
            loose = np.flatnonzero(is_loose)
            self._level(points, loose)
        return points

    def _level(self, points: F32, loose: NDArray[np.intp]) -> None:
        mean = self._mean[loose]
        for _ in range(_SWEEPS[0]):
            for _ in range(_SWEEPS[1]):
                points[loose] = (points[loose] + mean @ points) / 2
            found = self._sdf.query(torch.from_numpy(points[loose]))
            lack = (self._margin - found.distance).clamp_min(0)
            points[loose] += (lack[:, None] * found.gradient).numpy()
