"""A garment as planners take obstacles: few triangles, closed, and of a given thickness."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from itertools import product
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array, diags_array, eye_array

from refu_core._cache import keep, recall
from refu_core.body import Surface
from refu_core.errors import MeshError, require_pipeline
from refu_core.frames import SmplFrame
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity, as_points, rim_of, symmetric_solver, vertex_areas
from refu_core.outputs._simplify import CoarseSheet
from refu_core.outputs._worn import require_garment
from refu_core.realtime import GarmentPipeline
from refu_core.skeleton import posed

Points = NDArray[np.float64]
_LEAST_WEIGHT = 0.01
"""A vertex with a smaller weight than this in a coarse one is left out."""
_OWN = 0.5
"""Share of the garment's own kept vertex in a coarse vertex before fitting. The rest comes from the fit of the rest
pose, which overshoots where cloth folds."""
_FIRM = 1e-3
"""How firmly that fit is held to the kept vertices where hardly any cloth determines it."""
_ROUNDS = 2
"""How often the shapes are fitted, and after them the weights to all shapes."""
_STEPS = 3
_TETHER = 0.1
"""How firmly each step keeps a shape's fit where it was, and in one piece."""
_RIDGE = 1e-3
"""How firmly weights are kept as they were [m²]: there are more of them than the shapes determine."""
_PER_EDGE = 3
"""Parts of an edge: each triangle of the sheet is sampled at the corners of nine smaller ones."""
_TOUCHING = 5e-4
"""Distances below this count as this [m]."""


def fitted_means(shapes: Points, mesh: Connectivity, kept: NDArray[np.intp], sheet: NDArray[np.int32]) -> csr_array:
    """The weights (K, V), whose rows sum to one, that take a garment to the sheet near it.

    In each of the shapes (P, V, 3) [m], the first of which is the rest pose, the sheet is drawn to the cloth by ICP in
    both directions, in which places that are farther off count more. Ridge regression then finds the weights that best
    do this for all shapes, within each coarse vertex's own neighbourhood.
    """
    if len(kept) == shapes.shape[1]:
        return csr_array(eye_array(len(kept)))
    take = _means(shapes[0], mesh, kept, sheet)
    for _ in range(_ROUNDS):
        goals = np.stack([_drawn(take @ shape, sheet, shape, mesh.faces) for shape in shapes])
        _regress(take, shapes, goals)
    return take


def _means(rest: Points, mesh: Connectivity, kept: NDArray[np.intp], sheet: NDArray[np.int32]) -> csr_array:
    """Weights half-way between those of the kept vertices and the least-squares fit of the rest pose."""
    own = csr_array((np.ones(len(kept)), (np.arange(len(kept)), kept)), shape=(len(kept), len(rest)))
    place = _placed(Surface(rest[kept], sheet), rest)
    weighed = (place.T * vertex_areas(rest, mesh.faces)).toarray()
    normal = np.asarray(weighed @ place)
    firm = _FIRM * float(np.trace(normal)) / len(kept)
    dense = cho_solve(cho_factor(normal + firm * np.eye(len(kept))), weighed + firm * own.toarray())
    dense[np.abs(dense) < _LEAST_WEIGHT] = 0
    dense /= dense.sum(1, keepdims=True)
    return csr_array((1 - _OWN) * dense + _OWN * own.toarray())


def _placed(surface: Surface, points: Points) -> csr_array:
    """The matrix that takes a surface's vertices to its places closest to points, shape (N, K)."""
    found = surface.closest(points)
    ends = 3 * np.arange(len(points) + 1)
    shape = len(points), len(surface.vertices)
    return csr_array((found.weight.ravel(), surface.faces[found.face].ravel(), ends), shape=shape)


def _samples(sheet: NDArray[np.int32], n: int) -> csr_array:
    """The matrix that takes the sheet's n vertices to places spread over its triangles."""
    steps = range(_PER_EDGE + 1)
    inner = [(i, j, _PER_EDGE - i - j) for i, j in product(steps, steps) if i + j <= _PER_EDGE]
    weights = np.tile(np.array(inner) / _PER_EDGE, (len(sheet), 1))
    corners = np.repeat(sheet, len(inner), axis=0)
    return csr_array((weights.ravel(), corners.ravel(), 3 * np.arange(len(weights) + 1)), shape=(len(weights), n))


def _drawn(sheet_points: Points, sheet: NDArray[np.int32], cloth: Points, faces: NDArray[np.int32]) -> Points:
    """The sheet's vertices (K, 3), drawn to a cloth (V, 3) [m]."""
    n, points = len(sheet_points), sheet_points
    samples, surface = _samples(sheet, n), Surface(cloth, faces)
    beside = Connectivity.of(sheet, n).adjacency_matrix()
    firm = 0.2 * (diags_array(beside.sum(axis=1)) - beside) + 0.1 * eye_array(n)
    for _ in range(_STEPS):
        place, asked = _placed(Surface(points, sheet), cloth), samples @ points
        goal = surface.at(surface.closest(asked))
        by_cloth = place.T * (_distance(place @ points - cloth) / (2 * len(cloth)))
        by_sheet = samples.T * (_distance(asked - goal) / len(asked))
        normal = by_cloth @ place + by_sheet @ samples
        tether = (_TETHER * normal.diagonal().mean()) * firm
        points = symmetric_solver(normal + tether)(by_cloth @ cloth + by_sheet @ goal + tether @ points)
    return points


def _distance(way: Points) -> Points:
    """Lengths (N,) of vectors [m], at least `_TOUCHING`: the weights of differences."""
    length: Points = np.maximum(np.linalg.norm(way, axis=1), _TOUCHING)
    return length


def _regress(take: csr_array, shapes: Points, goals: Points) -> None:
    """Changes each coarse vertex's weights in its neighbourhood so that it comes close to its goals in all shapes."""
    for k in range(take.shape[0]):
        of = slice(take.indptr[k], take.indptr[k + 1])
        near = shapes[:, take.indices[of]]
        middle = near.mean(1)
        around = (near - middle[:, None]).transpose(0, 2, 1).reshape(-1, near.shape[1])
        missed = (goals[:, k] - middle).ravel() - around @ take.data[of]
        change = around.T @ np.linalg.solve(around @ around.T + _RIDGE * np.eye(len(around)), missed)
        take.data[of] += change - change.mean()


HALF_THICKNESS = 0.005
"""How far each side of the solid is from the middle of the cloth [m]. The coarse cloth may be about this far from the
garment, so the garment lies within the solid nearly everywhere."""
MAX_TRIANGLES = 2000
_LEAST_TRIANGLES = 100
_VERSION = 3
"""Version of what is cached; a result of any other version is computed anew."""
_POSES = {
    "T-pose": "",
    "stands": "both_shoulder 0 0 -1.15",
    "arms overhead": "both_shoulder 0 0 0.95, both_collar 0 0 0.3",
    "squats": "both_hip -1.3 0.2 0.4, both_knee 1.7 0 0, spine1 0.2 0 0, both_shoulder 0.2 0 -0.7",
    "walks": "left_hip -0.6 0 0.05, right_hip 0.35 0 0, left_knee 0.3 0 0, right_knee 0.6 0 0, spine2 0 0.15 0, "
    "left_shoulder 0.3 0.1 -1.1, right_shoulder -0.3 0.3 1.1, left_elbow 0 -0.4 0, right_elbow 0 0.5 0",
    "reaches forward": "left_shoulder 0 -0.9 -0.3, right_shoulder 0.2 0 1.2, left_elbow 0 -0.5 0, spine1 0.15 0.1 0, "
    "spine3 0 0.2 0",
    "one arm overhead, the other bent": "left_shoulder 0 0 1.0, left_collar 0 0 0.3, spine2 0 0 -0.15, "
    "right_shoulder 0 0.3 1.15, right_elbow 0 1.3 0",
    "a knee up, an arm across": "left_shoulder 0.3 -1.1 -0.9, right_shoulder 0 0.2 1.0, left_elbow 0 -1.5 0, "
    "right_elbow 0 0.8 0, left_hip -1.2 0.1 0.1, left_knee 1.3 0 0",
    "bends over": "spine1 0.35 0.1 0, spine2 0.25 0.1 0, spine3 0.15 0 0, left_hip -0.7 0 0.1, right_hip -0.6 0 -0.1, "
    "left_knee 0.5 0 0, right_knee 0.4 0 0, left_shoulder 0 -0.6 -1.0, right_shoulder 0 0.8 0.9",
    "sits": "left_hip -1.5 0 0.15, right_hip -1.5 0 -0.1, left_knee 1.5 0 0, right_knee 1.4 0 0, "
    "left_shoulder 0.2 -0.2 -1.2, right_shoulder 0.2 0.4 1.1, right_elbow 0 1.2 0",
}
"""Poses in which a planner's mesh has to fit, as `refu_core.skeleton.posed` reads them [rad]."""


class PlannerMesh:
    """A coarse, closed copy of one garment, decimated once; each frame then takes one sparse product.

    The cloth becomes a sheet of about half the triangles. Its vertices are weighted means of the garment's; both
    these and its triangles are found from several poses, so that it is near the cloth in all of them. The solid's two
    sides lie `half_thickness` off the sheet, with a wall along every rim.

    A solid around the cloth reaches into the body that wears it, so planners must allow these two to touch.
    """

    def __init__(
        self,
        garment: GarmentTemplate,
        max_triangles: int = MAX_TRIANGLES,
        *,
        half_thickness: float = HALF_THICKNESS,
        worn: Callable[[], Points] | None = None,
    ) -> None:
        """Prepares for a garment: some seconds the first time, after which the result is cached (`REFU_CACHE`).

        The solid has `max_triangles` at most, and its sides are `half_thickness` [m] from the middle of the cloth.
        `worn` returns the garment as it is worn in several poses [m], (P, V, 3); without it only the rest pose is used.
        What is cached is recalled for the same shapes alone. Raises `MeshError` for fewer than 100 triangles, for no
        thickness, and if a garment can't be made that coarse.
        """
        require_garment(garment)
        numbers: tuple[object, ...] = max_triangles, half_thickness
        are_numbers = all(isinstance(number, Real) and math.isfinite(number) for number in numbers)
        if not are_numbers or max_triangles < _LEAST_TRIANGLES or not 0 < half_thickness < math.inf:
            wanted = f"{_LEAST_TRIANGLES} triangles or more and a positive half thickness"
            raise MeshError(f"wanted {wanted}, got {max_triangles} and {half_thickness}")
        self.half_thickness = float(half_thickness)
        """[m]"""
        rest = garment.v_template.detach().cpu().double().numpy()
        self._n_vertices = len(rest)
        kept, self.sheet, self._take = _prepared(garment, rest, max_triangles, worn)
        """`sheet`: faces of the sheet in the middle of the solid, counter-clockwise from outside, shape (S, 3)."""
        self.faces: NDArray[np.int32] = _solid(self.sheet, len(kept))
        """Counter-clockwise from outside, shape (T, 3); the same in every frame."""
        if len(self.faces) > max_triangles:
            raise MeshError(f"{garment.name} can't be drawn with {max_triangles} triangles: {len(self.faces)} at least")
        corners = np.repeat(np.arange(len(self.sheet)), 3)
        self._around = csr_array(
            (np.ones(3 * len(self.sheet)), (self.sheet.ravel(), corners)), shape=(len(kept), len(self.sheet))
        )

    @classmethod
    def of(
        cls,
        pipeline: GarmentPipeline,
        garment: str,
        max_triangles: int = MAX_TRIANGLES,
        *,
        half_thickness: float = HALF_THICKNESS,
    ) -> PlannerMesh:
        """For a pipeline's garment of this name, which the pipeline drapes in ten poses.

        Raises `MeshError` as the constructor does, and where the pipeline has no such garment.
        """
        require_pipeline(pipeline, "garments", "body", "adjusted", error=MeshError)
        if not isinstance(garment, str) or garment not in pipeline.garments:
            raise MeshError(f"the pipeline has no garment {garment!r}: wanted one of {', '.join(pipeline.garments)}")
        template = pipeline.garments[garment]
        return cls(template, max_triangles, half_thickness=half_thickness, worn=lambda: _practised(pipeline, garment))

    def middle(self, vertices: Any) -> NDArray[np.float64]:
        """The sheet in the middle of the solid [m], shape (N / 2, 3), for `vertices` as `solid` takes them."""
        points = as_points("the garment's vertices", vertices, self._n_vertices)
        sheet: NDArray[np.float64] = self._take @ points
        return sheet

    def solid(self, vertices: Any) -> NDArray[np.float64]:
        """Vertices of the solid [m], shape (N, 3), to go with `faces`, for a garment's `vertices` (V, 3) [m].

        Any right-handed axes will do. Raises `MeshError` for anything but finite numbers of that shape.
        """
        middle = self.middle(vertices)
        a, b, c = middle[self.sheet].transpose(1, 0, 2)
        u, v = b - a, c - a
        out = self._around @ np.cross(u, v)
        out *= self.half_thickness / np.maximum(np.sqrt(np.einsum("ij,ij->i", out, out)), 1e-12)[:, None]
        return np.concatenate((middle + out, middle - out))


def _prepared(
    garment: GarmentTemplate, rest: NDArray[np.float64], max_triangles: int, worn: Callable[[], Points] | None
) -> tuple[NDArray[np.intp], NDArray[np.int32], csr_array]:
    """The vertices that are kept, the sheet's faces and its weights; computed once for a garment, and then cached."""
    shapes = rest[None] if worn is None else np.concatenate((rest[None], worn()))
    # Of all shapes: other networks, another body or other garments beside it drape the same garment differently.
    digest = hashlib.sha256(shapes.astype(np.float32).tobytes() + garment.mesh.faces.tobytes()).hexdigest()[:16]
    name = f"planner-{_VERSION}-{digest}-{max_triangles}"
    keys = ("kept", "sheet", "weight", "column", "start")
    known = recall(name, keys=keys)
    if known is None:
        kept, sheet = CoarseSheet(shapes, garment.mesh.faces).collapsed(max_triangles)
        take = fitted_means(shapes, garment.mesh, kept, sheet)
        known = dict(zip(keys, (kept, sheet, take.data, take.indices, take.indptr), strict=True))
        keep(name, known)
    shape = (len(known["kept"]), len(rest))
    return known["kept"], known["sheet"], csr_array((known["weight"], known["column"], known["start"]), shape=shape)


def _solid(sheet: NDArray[np.int32], n: int) -> NDArray[np.int32]:
    """The faces of both sides of a sheet of n vertices, and of walls along its rims."""
    on_rim = rim_of(sheet)
    a, b = sheet[on_rim], np.roll(sheet, -1, axis=1)[on_rim]
    walls = np.concatenate((np.stack((b, a, a + n), 1), np.stack((b, a + n, b + n), 1)))
    return np.concatenate((sheet, sheet[:, ::-1] + n, walls)).astype(np.int32)


def _practised(pipeline: GarmentPipeline, garment: str) -> NDArray[np.float64]:
    """A pipeline's garment as it is worn in each of `_POSES` [m], shape (P, V, 3)."""
    frames = (SmplFrame(posed(turns).astype(np.float32)) for turns in _POSES.values())
    # Not by calling the pipeline: it keeps its last outputs for callers that ask for the same frames again.
    worn = [pipeline.adjusted(frame, lambda dressed: dressed)[garment].local for frame in frames]
    return np.stack(worn).astype(np.float64)
