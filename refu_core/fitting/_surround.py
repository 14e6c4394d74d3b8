"""How well a mesh surrounds a body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from refu_core.body import SmplBody
from refu_core.fitting._clean import components, open_pieces
from refu_core.fitting._mesh_file import F64, Ints, SurfaceMesh
from refu_core.fitting._posed import PosedBody
from refu_core.mesh import face_normals

NEAR = 0.06
"""Cloth nearer than this on average lies on the skin, like a glove [m]; cloth that is worn farther off is wide."""
_WIDE = 0.2
"""Wide cloth encloses skin of at least this share of its own area: a crinoline .25, a cape .34, a gown .45. A shirt
that hangs on a hand has .19."""
_FACES, _WIDE_FACES, _PLAINLY_FACES = 0.85, 0.9, 0.93
"""Least share that faces outward: for a glove, between whose fingers much doesn't; for wide cloth, which may have 0.89
by chance; for cloth that leaves no doubt."""
_FOLDED, _MUCH = 0.8, 0.35
"""Cloth in deep folds faces outward by this share at least, and encloses this much skin, as a share of its own area: a
draped circle skirt .85 and .40."""
_RING_FACES = 0.99
"""Least share of a ring that faces outward: a band 8 cm high and 8 cm off the hips has 1.00."""
_N_SKIN = 600
"""About how many vertices of the skin are checked for being within cloth."""
_DOWN = np.array([0.3, 0.6, 0.9])
"""Where thighs and shins are checked for cloth between them, and shoulders for cloth above them, as shares of the way
from one joint to the next."""
_HEIGHT = 0.005
"""Heights at which cloth in front and behind are counted are this far apart [m]."""
_LOWER = 0.02
"""A neckline is lower on one side if it is so by more than this [m]: those of T-shirts are by 4 to 9 cm."""
_ACROSS = 0.5
"""Least cosine between the normal of cloth that lies along the skin and the way off the skin, or across some way."""


@dataclass(frozen=True, eq=False)
class Fit:
    """How well a mesh surrounds a body, lengths in metres."""

    inside: float
    """Share of the surface deeper than 1 cm in the body."""
    depth: float
    """Mean of how much it lacks to be 1 cm off the skin, at most 5 cm: worn cloth neither touches nor is far off."""
    distance: float
    """Mean distance outside, at most 60 cm."""
    facing: float
    """Share of it that faces away from the body; half of a mesh that stands beside the body does not."""
    surrounded: Callable[[], float]
    """Computes `around`, which takes longer than all else."""

    @cached_property
    def around(self) -> float:
        """Area of the skin that it surrounds, as a share of its own; zero if it stands beside the body."""
        return self.surrounded()

    @property
    def cost(self) -> float:
        """Smaller is better [m]: cloth is outside, near, and faces away from the body."""
        return 8 * self.depth + 0.3 * self.inside + self.distance + 0.1 * (1 - self.facing)

    @property
    def is_good(self) -> bool:
        """Whether it may be worn like that. Garments made for a body are 0.00–0.05 inside, < 0.08 off, > 0.93 facing.

        A gown or a poncho is far off, but has much of the body in it: a shirt that hangs on a hand has not.
        """
        least, faces = (0, _FACES) if self.distance < NEAR else (_WIDE, _WIDE_FACES)
        is_around = (self.facing > faces and self.around > least) or (self.facing > _FOLDED and self.around > _MUCH)
        return self.inside < 0.05 and is_around

    @property
    def is_near(self) -> bool:
        """Whether it has some of the body in it, or lies near it, and doesn't stand beside it."""
        return self.distance < 2 * NEAR or self.around > 0

    @property
    def is_ring(self) -> bool:
        """Whether it is around the body and clear of it, however little of the skin it encloses: a belt, a hoop."""
        return self.inside == 0 and self.facing > _RING_FACES and self.distance < 2 * NEAR

    @property
    def is_tight(self) -> bool:
        """Whether it lies on the skin, a little inside it: modelled close to it, or on somebody a little slimmer."""
        return self.facing > 0.95 and self.distance < 0.16 and self.depth < 0.025

    @property
    def is_plain(self) -> bool:
        """Whether nothing else need be tried."""
        return self.facing > _PLAINLY_FACES and self.is_good


class Samples(NamedTuple):
    """Points spread evenly over a mesh, by area."""

    points: F64
    """In the mesh's own unit and axes, shape (P, 3)."""
    normals: F64
    """Unit, shape (P, 3)."""
    is_open: NDArray[np.bool_]
    """Whether it is on a piece with a rim; a closed piece is cloth with both its sides, shape (P,)."""
    piece: Ints
    """The piece that it is on, shape (P,)."""
    area: F64
    """Area of the surface that each point stands for, shape (P,)."""


def sample(mesh: SurfaceMesh, count: int) -> Samples:
    """`count` points drawn by area, the same ones each time."""
    rng = np.random.default_rng(0)
    normals = face_normals(mesh.vertices, mesh.faces)
    area = np.linalg.norm(normals, axis=1)
    face = np.searchsorted(np.cumsum(area), (np.arange(count) + rng.random(count)) / count * area.sum())
    face = np.minimum(face, len(area) - 1)
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    _, label = components(mesh.faces, len(mesh.vertices))
    is_open = open_pieces(mesh.vertices, mesh.faces, label)[label[mesh.faces[face, 0]]]
    unit = normals[face] / np.maximum(area[face], 1e-300)[:, None]
    each = np.full(count, 0.5 * area.sum() / count)
    return Samples(points, unit, is_open, label[mesh.faces[face, 0]], each)


def fits_of(points: F64, normals: F64, area: F64, samples: Samples, body: PosedBody) -> list[Fit]:
    """How well samples at N places at once surround the body: asked together, they take less than half the time.

    `points` (N, P, 3) [m] and `normals` (N, P, 3) are in the body's axes, `area` (N, P) in m².
    """
    n_places, n_points = points.shape[:2]
    distance, gradient = body(points.reshape(-1, 3))
    distance = distance.reshape(n_places, n_points)
    outward = (normals * gradient.reshape(points.shape)).sum(2)
    is_outer = outward > 0
    # An open piece may face either way, but all of it should face the same way. A closed one has one side that faces
    # the body and one that faces away from it, and little that faces anything else.
    pieces, n_pieces = samples.piece[samples.is_open], int(samples.piece.max()) + 1
    at_each = pieces + n_pieces * np.arange(n_places)[:, None]
    outer = np.bincount(at_each.ravel(), is_outer[:, samples.is_open].ravel(), n_places * n_pieces)
    votes, all_votes = outer.reshape(n_places, n_pieces), np.bincount(pieces, minlength=n_pieces)
    n_facing = np.maximum(votes, all_votes - votes).sum(1) + (np.abs(outward[:, ~samples.is_open]) > _ACROSS).sum(1)
    figures = zip(
        (distance < -0.01).mean(1).tolist(),
        np.clip(0.01 - distance, 0, 0.05).mean(1).tolist(),
        np.clip(distance, 0, 0.6).mean(1).tolist(),
        (n_facing / n_points).tolist(),
        strict=True,
    )
    skin = body.vertices.numpy(), body.skin
    return [
        Fit(*those, partial(_around, points[k], normals[k], area[k], samples.is_open | is_outer[k], *skin))
        for k, those in enumerate(figures)
    ]


def _around(
    points: F64, normals: F64, area: F64, counts: NDArray[np.bool_], skin: NDArray[np.float32], skin_area: F64
) -> float:
    """Area of the skin where the winding number of the samples that count is above 0.4, as a share of their area.

    `skin` (V, 3) [m] are the body's vertices, `skin_area` (V,) [m²] what each stands for. The inner side of a piece
    with two sides doesn't count: the two would cancel.
    """
    # A share of skin in whole vertices doesn't depend on a seventh digit, and single precision takes half the time.
    places, facing, shares = (array[counts].astype(np.float32) for array in (points, normals, area))
    each = max(1, len(skin) // _N_SKIN)
    skin = skin[::each]
    # For each vertex and sample: the way from one to the other along the normal, and its length, squared.
    along = (places * facing).sum(1) - skin @ facing.T
    squared = np.maximum((places**2).sum(1) + (skin**2).sum(1)[:, None] - 2 * skin @ places.T, 1e-6)
    squared *= np.sqrt(squared)  # six times as fast as the power 1.5
    winding = (along / squared) @ shares / (4 * np.pi)
    return float(each * skin_area[::each][np.abs(winding) > 0.4].sum() / shares.sum())


def parts_legs(vertices: F64, faces: Ints, body: SmplBody) -> bool:
    """Whether cloth of vertices (V, 3) [m] passes between the legs of a body; a skirt says nothing about them."""
    joints = body.joint_template.double().numpy()
    left, right = (
        np.concatenate([joints[a] + _DOWN[:, None] * (joints[b] - joints[a]) for a, b in pairwise(leg)])
        for leg in ([1, 4, 7], [2, 5, 8])
    )
    return _crosses(vertices, faces, left, right - left)


def lies_over(vertices: F64, faces: Ints, body: SmplBody) -> bool:
    """Whether cloth of vertices (V, 3) [m] lies over the shoulders of a body, at any height: a skirt doesn't."""
    neck, *shoulders = body.joint_template[[12, 16, 17]].double().numpy()
    over = np.concatenate([neck + _DOWN[:, None] * (shoulder - neck) for shoulder in shoulders])
    low, high = vertices[:, 1].min() - 1, vertices[:, 1].max() + 1
    over[:, 1] = low
    return _crosses(vertices, faces, over, np.tile([0.0, high - low, 0.0], (len(over), 1)))


def opens_behind(vertices: F64, faces: Ints, body: SmplBody) -> bool:
    """Whether cloth of vertices (V, 3) [m] would be worn back to front: coats open, and necklines are lower, in front.

    In the body's plane of symmetry, cloth is then in front of the spine at more heights than it is behind it.
    """
    segments = trimesh.intersections.mesh_plane(
        trimesh.Trimesh(vertices, faces, process=False), np.eye(3)[0], np.zeros(3)
    )
    spine = body.joint_template[[0, 3, 6, 9, 12, 15]].double().numpy()
    ends = np.asarray(segments, np.float64)[:, :, 1:]
    is_front = ends[..., 1].mean(1) > np.interp(ends[..., 0].mean(1), spine[:, 1], spine[:, 2])
    heights = np.arange(spine[0, 1], vertices[:, 1].max(), _HEIGHT)[:, None]
    low, high = ends[..., 0].min(1), ends[..., 0].max(1)
    front, back = (((low[side] <= heights) & (heights <= high[side])).any(1).sum() for side in (is_front, ~is_front))
    return bool((front - back) * _HEIGHT > _LOWER)


def _crosses(vertices: F64, faces: Ints, starts: F64, ways: F64) -> bool:
    """Whether cloth lies across a line that begins at one of the starts (N, 3) and goes its way (N, 3)."""
    first, second, third = (vertices[faces[:, k]] for k in range(3))
    low, high = (most(most(first, second), third).T.copy() for most in (np.minimum, np.maximum))
    for start, way in zip(starts, ways, strict=True):
        ends = np.sort([start, start + way], axis=0)
        near = np.flatnonzero(np.logical_and.reduce([*(low <= ends[1, :, None]), *(high >= ends[0, :, None])]))
        corner = first[near]
        u, v = second[near] - corner, third[near] - corner
        normal = np.cross(u, v)
        # Möller and Trumbore 1997: where the way meets each triangle's plane, and if inside it.
        steep = -(normal @ way)
        steep = np.where(np.abs(steep) < 1e-15, np.inf, steep)
        off = start - corner
        along = np.cross(off, way)
        t, a, b = (off * normal).sum(1) / steep, (v * along).sum(1) / steep, -(u * along).sum(1) / steep
        is_across = np.abs(normal @ way) > _ACROSS * np.linalg.norm(normal, axis=1) * np.linalg.norm(way)
        if (is_across & (a >= 0) & (b >= 0) & (a + b <= 1) & (t >= 0) & (t <= 1)).any():
            return True
    return False
