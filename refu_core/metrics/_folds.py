"""How strong a garment's folds are, by their size: what levelling takes away, sweep by sweep."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from refu_core.mesh import Connectivity

SWEEPS = (1, 4, 16, 64)
"""Sweeps that each band is what they take away, finest first. Half a step to the mean of the neighbours each."""


class FoldBands:
    """Splits a garment into bands: folds of some edges' length, of some more, and the shape that is left.

    Networks that are trained for a small error predict the mean of what cloth may do, which is smoother than cloth. The
    mean error hardly says so. The energy of the bands does.
    """

    def __init__(self, mesh: Connectivity) -> None:
        half = 0.5 * mesh.uniform_laplacian()
        self._sweep = sparse.csr_array(sparse.eye_array(mesh.n_vertices) - half)

    def split(self, vertices: Any) -> NDArray[np.float64]:
        """The bands of arrays (V, ...) over the vertices, finest first, and what is left: (5, V, ...). They add up."""
        array = np.asarray(vertices, np.float64)
        rest = array.reshape(len(array), -1)
        bands = []
        for n_sweeps in SWEEPS:
            level = rest
            for _ in range(n_sweeps):
                level = self._sweep @ level
            bands.append(rest - level)
            rest = level
        return np.stack([*bands, rest]).reshape(len(SWEEPS) + 1, *array.shape)

    def energies(self, vertices: Any) -> NDArray[np.float64]:
        """Of vertices (V, ..., 3) [m] the energy of each band, finest first [m^2], shape (4, ...)."""
        energies: NDArray[np.float64] = (self.split(vertices)[:-1] ** 2).sum(axis=(1, -1))
        return energies
