"""Garments on a body other than the one that they were cut for."""

from __future__ import annotations

from dataclasses import replace
from types import NoneType

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from refu_core.body import BodyFit, Surface, load_body
from refu_core.errors import GarmentError, require_type
from refu_core.frames import N_BETAS
from refu_core.garments._template import GarmentTemplate
from refu_core.mesh import symmetric_solver

Array = NDArray[np.float64]

_NEIGHBOURS = 16
"""Number of skin vertices that a garment vertex is carried by."""
_WIDTH = 0.02
"""How much farther than the nearest one these may be and still count much [m]."""
_STIFFNESS = 20.0
"""Weight of neighbours moving alike, relative to that of their moving as the skin does: cloth doesn't show a navel.
Half of what changes within 7 edges, 7 cm of a T-shirt, is levelled out."""
_HELD_WITHIN = 0.03
"""Cloth farther off the skin than this mostly follows its own neighbours [m]: between two legs it follows neither."""
_CLEARANCE = 0.006
"""How far off their body garments are cut [m]: no more is required on another body, whatever its size."""
_FROM_MIDDLE = 0.003
"""How far vertices stay from the plane between left and right, if they are cut that far from it [m]."""
_LIFTS = 6
"""Rounds of lifting: hardly anything is below its clearance after three."""
_SPREADS = 3
"""Rings around a lifted vertex that move along with it, less and less."""
_INFLUENCES = 6
"""Most joints per vertex, as in the garments that ship."""


def worn_on(garment: GarmentTemplate, fit: BodyFit | None) -> GarmentTemplate:
    """`garment` on the body of `fit`: it follows that body's betas and skin, and its styles stay as they were.

    Returns the garment itself for the body that it was cut for, which None stands for.

    The garment already follows whatever is in the shape space of the body that it was cut for. What else is different
    about the new body is carried over from the skin below the garment. So nothing changes on the garment's own body.
    A child's garment is carried over to the child at an adult's height, and then made as small as the child.

    Raises `GarmentError` for anything but a garment and a fit.
    """
    require_type(garment, GarmentTemplate, "a garment (load_garment)", error=GarmentError)
    require_type(fit, (BodyFit, NoneType), "a body's fit (refu_core.body.load_fit), or None", error=GarmentError)
    if fit is None or fit.body.fingerprint == load_body(garment.body).fingerprint:
        return garment
    differs = fit.difference(garment.body)
    exact = garment.to(device="cpu", dtype=torch.float64)
    source, betas, size = differs.source, differs.betas, fit.size
    with torch.no_grad():
        rest = exact.rest(betas.offset[None])[0].numpy()
        skin = source.rest_vertices(betas.offset[None])[0].numpy()
    carry = _Carrier(rest, garment, skin)
    own = exact.shapedirs.numpy() @ betas.matrix.numpy()
    n = garment.n_vertices
    directions = size * (own.reshape(n, 3, N_BETAS) + carry(differs.directions))
    vertices = size * (rest + carry(differs.template))
    clear = np.minimum(Surface(skin, source.arrays.faces.astype(np.int32)).heights(rest)[0], _CLEARANCE)
    own_side = exact.v_template[:, 0].numpy()
    middle = float((fit.body.joint_template - size * load_body(garment.body).joint_template)[:, 0].mean())
    vertices = _on_own_side(_lifted(_on_own_side(vertices, own_side, middle), clear, garment, fit), own_side, middle)
    weights = (exact.weights.numpy() + carry(differs.weights)).clip(0)
    few = np.sort(weights, axis=1)[:, -_INFLUENCES, None]
    weights = np.where(weights >= few, weights, 0)
    weights /= weights.sum(1, keepdims=True)
    return replace(
        garment,
        v_template=torch.as_tensor(vertices).to(garment.v_template),
        shapedirs=torch.as_tensor(directions.reshape(3 * n, N_BETAS)).to(garment.shapedirs),
        weights=torch.as_tensor(weights).to(garment.weights),
        styledirs=None if garment.styledirs is None else size * garment.styledirs,
    )


class _Carrier:
    """Carries what skin does over to the cloth on it."""

    def __init__(self, rest: Array, garment: GarmentTemplate, skin: Array) -> None:
        distance, vertex = map(np.asarray, cKDTree(skin).query(rest, _NEIGHBOURS))
        weight = np.exp((distance[:, :1] ** 2 - distance**2) / (2 * _WIDTH**2))
        weight /= weight.sum(1, keepdims=True)
        rows = np.repeat(np.arange(len(rest)), _NEIGHBOURS)
        self._attach = sparse.csr_array((weight.ravel(), (rows, vertex.ravel())), shape=(len(rest), len(skin)))
        self._hold = 1 / (1 + (distance[:, 0] / _HELD_WITHIN) ** 2) ** 2
        bending = garment.mesh.uniform_laplacian()
        self._solve = symmetric_solver(sparse.diags_array(self._hold) + _STIFFNESS * bending.T @ bending)

    def __call__(self, values: Array) -> Array:
        """`values` of the skin's vertices (V, …), carried over to the garment's (N, …)."""
        there = self._attach @ values.reshape(len(values), -1)
        return self._solve(self._hold[:, None] * there).reshape(-1, *values.shape[1:])


def _on_own_side(vertices: Array, own_side: Array, middle: float) -> Array:
    """Vertices, each brought to the side of the body's middle plane x = `middle` [m] that it is cut on.

    As cut, the vertices are `own_side` (N,) [m] from the middle. This keeps one trouser leg out of the other on a body
    whose legs are closer together.
    """
    side: Array = np.where(own_side > 0, 1.0, -1.0)
    kept: Array = vertices.copy()
    least = np.minimum(np.abs(own_side), _FROM_MIDDLE)
    kept[:, 0] = middle + side * np.maximum(side * (vertices[:, 0] - middle), least)
    return kept


def _lifted(vertices: Array, clear: Array, garment: GarmentTemplate, fit: BodyFit) -> Array:
    """Vertices, lifted so that they and the midpoints of edges are at least `clear` (N,) [m] off the body."""
    surface = Surface(fit.body.v_template.double().cpu().numpy(), fit.body.faces.cpu().numpy().astype(np.int32))
    edges = garment.mesh.edges
    mean = sparse.csr_array(sparse.eye_array(len(vertices)) - garment.mesh.uniform_laplacian())
    n = len(vertices)
    for _ in range(_LIFTS):
        points = np.concatenate((vertices, vertices[edges].mean(1)))
        height, direction = surface.heights(points)
        lacks = np.concatenate((clear, clear[edges].mean(1))) - height
        if lacks.max() <= 0:
            break
        # Of a vertex and its edges, the one that lacks most sets the push.
        lacks, owner = np.concatenate((lacks[:n], lacks[n:], lacks[n:])), np.concatenate((np.arange(n), *edges.T))
        which = np.concatenate((np.arange(len(points)), np.arange(n, len(points))))
        order = np.argsort(lacks)
        push = np.zeros_like(vertices)
        push[owner[order]] = lacks[order, None].clip(0) * direction[which[order]]
        for _ in range(_SPREADS):
            push = np.where(push.any(1, keepdims=True), push, mean @ push)
        vertices = vertices + push
    return vertices
