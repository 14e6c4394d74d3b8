"""How well a mesh surrounds a body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from refu_core.fitting._clean import components, face_normals, rim_of
from refu_core.fitting._mesh_file import SurfaceMesh
from refu_core.fitting._posed import PosedBody

F64 = NDArray[np.float64]

_WIDE = 0.1
"""What is worn far off the skin has this share of it within: a gown .45, a poncho .19, a cape .13, a sock .08."""
_N_SKIN = 150
"""Vertices of the skin that are asked for that."""
_ACROSS = 0.5
"""Cosine of an angle to the way off the skin from which on cloth lies across it."""


class Fit(NamedTuple):
    """How well a mesh surrounds a body, lengths in metres."""

    inside: float
    """Share of the surface deeper than 1 cm in the body."""
    depth: float
    """Mean of what it lacks of 1 cm off the skin, at most 5 cm: what is worn neither touches nor is far off."""
    distance: float
    """Mean distance outside, at most 60 cm."""
    facing: float
    """Share of it that faces away from the body; half of what stands beside it does not."""
    around: float
    """Share of the skin that it surrounds; none where it stands beside the body."""

    @property
    def cost(self) -> float:
        """Smaller is better [m]: cloth is outside, near, and faces away from the body."""
        return 8 * self.depth + 0.3 * self.inside + self.distance + 0.1 * (1 - self.facing)

    @property
    def is_good(self) -> bool:
        """Whether it may be worn like that. Garments that were made for a body have 0.00–0.05, < 0.08 and > 0.93.

        A gown or a poncho is far off, but has much of the body in it.
        """
        is_on = self.around > (0 if self.distance < 0.16 else _WIDE)
        return self.inside < 0.05 and is_on and self.facing > 0.85

    @property
    def is_tight(self) -> bool:
        """Whether it lies on the skin, a little inside it: modelled close to it, or on somebody a little slimmer."""
        return self.facing > 0.95 and self.distance < 0.16 and self.depth < 0.025

    @property
    def is_plain(self) -> bool:
        """Whether nothing else need be tried."""
        return self.is_good and self.facing > 0.93


class Samples(NamedTuple):
    """Points all over a mesh, as many a square metre."""

    points: F64
    """In the mesh's own unit and axes, shape (P, 3)."""
    normals: F64
    """Unit, shape (P, 3)."""
    is_open: NDArray[np.bool_]
    """Whether of a piece with a rim; a closed one is cloth with both its sides, shape (P,)."""
    piece: NDArray[np.int64]
    """Of which piece, shape (P,)."""
    area: F64
    """Of the surface that each stands for, shape (P,)."""


def sample(mesh: SurfaceMesh, count: int, seed: int = 0) -> Samples:
    """`count` points drawn by area."""
    rng = np.random.default_rng(seed)
    normals = face_normals(mesh.vertices, mesh.faces)
    area = np.linalg.norm(normals, axis=1)
    face = np.searchsorted(np.cumsum(area), (np.arange(count) + rng.random(count)) / count * area.sum())
    face = np.minimum(face, len(area) - 1)
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    _, label = components(mesh.faces, len(mesh.vertices))
    open_pieces = np.unique(label[rim_of(mesh.faces)])
    is_open = np.isin(label[mesh.faces[face, 0]], open_pieces)
    unit = normals[face] / np.maximum(area[face], 1e-300)[:, None]
    each = np.full(count, 0.5 * area.sum() / count)
    return Samples(points, unit, is_open, label[mesh.faces[face, 0]], each)


def fit_of(points: F64, samples: Samples, body: PosedBody) -> Fit:
    """How well samples that are at `points` [m] surround the body; `samples.normals` in the same axes."""
    distance, gradient = body(points)
    outward = (samples.normals * gradient).sum(1)
    # An open piece faces one way or the other: what is asked is whether all of it does. One side of a closed one faces
    # the body, the other one away from it, and little of it anything else.
    votes = np.zeros((2, samples.piece.max() + 1))
    np.add.at(votes[0], samples.piece[samples.is_open], outward[samples.is_open] > 0)
    np.add.at(votes[1], samples.piece[samples.is_open], outward[samples.is_open] <= 0)
    n_facing = votes.max(0).sum() + (np.abs(outward[~samples.is_open]) > _ACROSS).sum()
    facing = float(n_facing / len(points))
    depth = np.clip(0.01 - distance, 0, 0.05)
    around = _around(points, samples, outward > 0, body)
    return Fit(
        float((distance < -0.01).mean()), float(depth.mean()), float(np.clip(distance, 0, 0.6).mean()), facing, around
    )


def _around(points: F64, samples: Samples, is_outer: NDArray[np.bool_], body: PosedBody) -> float:
    """Share of the skin whose winding number about the samples is above 0.4, each of the latter a piece of surface.

    Of a piece with two sides the inner one isn't counted: the two would cancel.
    """
    counts = samples.is_open | is_outer
    places, normals = points[counts], samples.normals[counts]
    skin = body.vertices.double().numpy()[:: max(1, len(body.vertices) // _N_SKIN)]
    way = places[None] - skin[:, None]
    cubed = np.maximum(np.linalg.norm(way, axis=2), 1e-3) ** 3
    winding = (np.einsum("skc,kc->sk", way, normals) / cubed) @ samples.area[counts] / (4 * np.pi)
    return float((np.abs(winding) > 0.4).mean())
