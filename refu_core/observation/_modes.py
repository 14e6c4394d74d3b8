"""Smooth fields on a garment, of which the displacement that a camera may ask for is made."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import csc_array, diags_array, eye_array
from scipy.sparse.linalg import splu

from refu_core._cache import keep, recall

if TYPE_CHECKING:
    from refu_core.garments import GarmentTemplate

_VERSION = 1
_SPARE = 24
"""Fields computed beyond those that are wanted: the last ones of a subspace are never accurate."""
_ITERATIONS = 2
_LOWEST = 1e-3
"""Added to the Laplacian, so that it can be inverted."""


def smooth_modes(garment: GarmentTemplate, count: int) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """The lowest modes of a garment's Laplacian, approximately: computed in seconds once, and then cached.

    Fields (V, K) are orthogonal, the smoothest first, and have a mean square of one over the vertices; their wave
    numbers [rad/m], (K,), come with them.
    """
    digest = hashlib.sha256(garment.mesh.faces.tobytes()).hexdigest()[:16]
    name = f"modes-{_VERSION}-{digest}-{garment.n_vertices}-{count}"
    known = recall(name, keys=("fields", "value"))
    if known is None:
        fields, value = _subspace(garment, count)
        known = {"fields": fields.astype(np.float32), "value": value}
        keep(name, known)
    rest = garment.v_template.detach().cpu().double().numpy()
    a, b = rest[garment.mesh.edges].transpose(1, 0, 2)
    square = float(np.median(((a - b) ** 2).sum(1)))
    # For a mesh of even triangles, six around a vertex, the graph's Laplacian is 3/2 edge² times the surface's.
    return known["fields"], np.sqrt(np.maximum(known["value"], 0) / (1.5 * square))


def _subspace(garment: GarmentTemplate, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Subspace iteration with the inverse: a random block is smoothed until smooth fields are left."""
    adjacent = garment.mesh.adjacency_matrix()
    n = garment.n_vertices
    laplacian = csc_array(diags_array(adjacent.sum(axis=1)) - adjacent)
    solve = splu((laplacian + _LOWEST * eye_array(n)).tocsc()).solve
    block = np.random.default_rng(0).normal(size=(n, min(count + _SPARE, n)))
    for _ in range(_ITERATIONS):
        block, _ = np.linalg.qr(solve(solve(block)))
    value, turn = eigh(block.T @ (laplacian @ block))
    return np.sqrt(n) * (block @ turn)[:, :count], value[:count]
