"""One garment that follows measured points: the fields that may displace it, and what is believed of them."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, eigh
from scipy.linalg.lapack import dpotri
from scipy.sparse import csc_array, csr_array, diags_array, eye_array

from refu_core._cache import keep, recall
from refu_core._warp import as_warp, ints, memory
from refu_core.garments import GarmentTemplate
from refu_core.mesh import symmetric_solver, vertex_normals
from refu_core.observation._match_kernels import match_kernel
from refu_core.outputs import SigmaMap

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ObservationSettings:
    """How far points may move a garment, and how long that is remembered.

    Tuned on half of the style-shape pairs of the evaluation bags; `benchmarks/outputs.py` measures on the other half.
    """

    modes: int = 192
    """Most smooth fields that make up the displacement along the normal."""
    finest: float = 55.0
    """Their largest wave number [rad/m]: waves of 11 cm. A small garment has fewer fields."""
    amplitude: float = 2.4
    """Standard deviation of that displacement, in mean σ of the garment (`refu_core.outputs.Sigma`): a network's errors
    along the normal, which are less where a network is better."""
    unmeasured: float = 0.0055
    """Mean σ of a garment whose network hasn't been measured [m]: that of a T-shirt."""
    wave: float = 30.0
    """Wave number up to which fields are about as large as the widest [rad/m]: waves of 20 cm. Beyond, their size falls
    with its square."""
    bound: float = 3.0
    """Each number stays within this many of its standard deviations, whatever is measured."""
    noise: float = 0.003
    """Least standard deviation of a cell's point along the normal, and of what the fields can't follow [m]. How cells
    differ from their neighbours shows when points are noisier: with 20 mm of noise shorts were off by 6.4 mm instead of
    3.3, which they are without points."""
    enough: float = 2.0
    """A cell of space with this many points counts half as much as one with very many: what the fields can't follow is
    alike in neighbouring points, so more of them don't average it out."""
    cell: float = 0.035
    """Edge of a cell, whose points are replaced by their mean [m]."""
    reach: float = 0.04
    """Points farther from the cloth than this aren't matched to it [m]."""
    slack: float = 0.01
    """A point may be this much nearer to the skin than to the cloth and still be the cloth's [m]."""
    robust: float = 0.015
    """Height off the cloth above which a point counts less and less [m] (Cauchy)."""
    first_rounds: int = 2
    """How often the first points are matched; later ones once, since the last ones brought the cloth near."""
    most_points: int = 6000
    """More points than this are thinned out evenly."""
    remembered: float = 0.5
    """Time after which a displacement has faded to a third [s]: folds change with the pose."""
    step: float = 1 / 30
    """Time between frames that have no stamps [s]."""


DEFAULT_OBSERVATION = ObservationSettings()


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
    solve = symmetric_solver(laplacian + _LOWEST * eye_array(n))
    block = np.random.default_rng(0).normal(size=(n, min(count + _SPARE, n)))
    for _ in range(_ITERATIONS):
        block, _ = np.linalg.qr(solve(solve(block)))
    value, turn = eigh(block.T @ (laplacian @ block))
    return np.sqrt(n) * (block @ turn)[:, :count], value[:count]


_AT_ONCE = 1e-9
"""Time counts only once at least this share of the prior's variance comes back in it."""


class Estimate:
    """A mean and a precision of D numbers that return to zero by themselves (an Ornstein–Uhlenbeck process).

    Numbers are in standard deviations of the prior, whose precision is therefore the identity. Between frames each
    number fades towards zero, and its variance grows towards the prior's. So information is forgotten, yet nothing can
    drift: without measurements the prediction is left as it was, and with them every number stays within its bound.
    """

    def __init__(self, times: F64, bound: float) -> None:
        """For the times in which numbers fade to a third [s], (D,), and the bound of all numbers."""
        self._times, self._limit = times, bound
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self.mean = np.zeros_like(self._times)
        self.precision = np.eye(len(self._times))
        """The inverse of the covariance, shape (D, D)."""
        self.is_informed = False
        """Whether anything was measured since the last reset."""

    def wait(self, seconds: float) -> None:
        """Lets time pass."""
        keeps = np.exp(-seconds / self._times)
        comes = 1 - keeps**2
        if not self.is_informed or comes.min() < _AT_ONCE:
            return
        self.mean = keeps * self.mean
        # The covariance becomes K C K + Q. Its inverse is Q⁻¹ - Q⁻¹ K (C⁻¹ + K Q⁻¹ K)⁻¹ K Q⁻¹ (Woodbury).
        rows = np.arange(len(keeps))
        between = self.precision.copy()
        between[rows, rows] += keeps**2 / comes
        ratio = keeps / comes
        self.precision = _inverse(between) * -ratio[:, None] * ratio
        self.precision[rows, rows] += 1 / comes

    def updated(self, information: F64, pull: F64) -> tuple[F64, F64]:
        """Mean (D,) and precision (D, D) after measurements of `information` JᵀWJ and `pull` JᵀW(r + J c)."""
        total = self.precision + information
        mean = cho_solve(cho_factor(total, check_finite=False), self.precision @ self.mean + pull, check_finite=False)
        return np.clip(mean, -self._limit, self._limit), total

    def take(self, mean: F64, precision: F64) -> None:
        """Takes over a mean (D,) and a precision (D, D)."""
        self.mean, self.precision, self.is_informed = mean, precision, True


def _inverse(matrix: F64) -> F64:
    """Symmetric inverse of a symmetric positive definite matrix (D, D), by half the work of `inv`; overwrites it."""
    factor, _ = cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)
    found, failed = dpotri(factor, lower=True, overwrite_c=True)
    if failed:
        raise LinAlgError(f"row {failed} of the factor is zero")
    half = np.tril(found)
    half += np.tril(half, -1).T
    return np.asarray(half)


_OFF_CENTRE = 0.37
"""Offset of the grid [cells]: if the body's plane of symmetry were a border, the last bit would choose the cell."""


class Measured(NamedTuple):
    """N points in the axes of the person's root."""

    points: F32
    """[m], shape (N, 3)."""
    say: F32
    """How much each point counts, at most one, shape (N,)."""


class Matches(NamedTuple):
    """M points and their places on the cloth."""

    say: F32
    """How much each point counts, shape (M,)."""
    face: NDArray[np.int32]
    weight: F32
    """Weights of the face's corners, shape (M, 3)."""
    normal: F32
    height: F32
    """Height off the cloth along the normal [m], shape (M,)."""


class ObservedCloth:
    """The numbers of one garment that points may change, and how they displace it before it is posed."""

    def __init__(self, garment: GarmentTemplate, sigma: SigmaMap, settings: ObservationSettings) -> None:
        self._settings = settings
        self._faces = garment.mesh.faces
        n = garment.n_vertices
        fields, wave = smooth_modes(garment, min(settings.modes, n // 8))
        kept = wave <= settings.finest
        rest = garment.v_template.detach().cpu().double().numpy()
        self._out = vertex_normals(rest, self._faces).astype(np.float32)
        falls = 1 / (1 + (wave[kept] / settings.wave) ** 2)
        typical = float(sigma.sigma.mean()) if sigma.is_measured else settings.unmeasured
        self.amplitude = settings.amplitude * typical
        """Standard deviation of the displacement [m]."""
        std = self.amplitude * falls / np.sqrt((falls**2).sum())
        self._fields = np.ascontiguousarray(fields[:, kept]) * std.astype(np.float32)
        """How far vertices move along the normal with each number [m], shape (V, K)."""
        self.estimate = Estimate(np.full(len(std), settings.remembered), settings.bound)
        self.reset()
        on_rim = garment.mesh.n_faces_of_edge[garment.mesh.edge_of_corner] == 1
        # Bit k says that the edge from corner k to the next is on the boundary.
        bits = (on_rim * np.array([1, 2, 4])).sum(1)
        self._rim = ints(bits, "cpu")
        self._points = memory(n, 3).copy_(garment.v_template.detach())
        self._mesh = wp.Mesh(as_warp(self._points, wp.vec3), ints(self._faces.ravel(), "cpu"))

    def reset(self) -> None:
        """Forgets what was measured."""
        self.estimate.reset()
        self._lift = np.zeros(len(self._out), np.float32)

    def wait(self, seconds: float) -> None:
        """Lets time pass. The displacement fades as the numbers do."""
        self.estimate.wait(seconds)
        self._lift = self._lift * np.float32(math.exp(-seconds / self._settings.remembered))

    def draw(self, numbers: NDArray[np.float64]) -> None:
        """Sets the displacement to that of numbers (D,), in standard deviations."""
        self._lift = self._fields @ numbers.astype(np.float32)

    @property
    def offset(self) -> F32:
        """The displacement that is added to the garment before it is posed [m], shape (V, 3)."""
        return self._lift[:, None] * self._out

    def place(self, vertices: F32) -> None:
        """Takes over where the garment's vertices are [m], shape (V, 3)."""
        self._points.copy_(torch.from_numpy(vertices))
        self._mesh.refit()

    def match(
        self, measured: Measured, skin: wp.Mesh, others: Sequence[ObservedCloth], eye: NDArray[np.float64] | None
    ) -> Matches:
        """Which of the points are the cloth's, not those of `others`, and where on it."""
        how = self._settings
        own = self._points.numpy()
        rows = np.flatnonzero(within(measured.points, own.min(0) - how.reach, own.max(0) + how.reach))
        points = wp.array(measured.points[rows], dtype=wp.vec3, device="cpu")
        seen = wp.vec3() if eye is None else wp.vec3(*eye.tolist())
        trees = wp.array(np.array([other._mesh.id for other in others], np.uint64), dtype=wp.uint64, device="cpu")
        inputs = [points, self._mesh.id, skin.id, trees, self._rim, how.reach, how.slack, eye is not None, seen]
        outputs = [wp.empty(len(rows), dtype=kind, device="cpu") for kind in (wp.int32, wp.vec3, wp.vec3, wp.float32)]
        wp.launch(match_kernel, len(rows), inputs, outputs, device="cpu")
        face, weight, normal, height = (one.numpy() for one in outputs)
        on = np.flatnonzero(face >= 0)
        return Matches(measured.say[rows[on]], face[on], weight[on], normal[on], height[on])

    def slopes(self, found: Matches, blend: F32) -> F32:
        """How far each number moves the cloth along each match's normal, shape (M, D).

        `blend` (V, 3, 3) poses a displacement.
        """
        m = len(found.face)
        corner = self._faces[found.face].astype(np.int32)
        along = np.matmul(found.normal[:, None, None], blend[corner])[:, :, 0] * found.weight[:, :, None]
        lift = (along * self._out[corner]).sum(2)
        # A sparse product needs no copy of the rows that it gathers, which are as large as a processor's cache.
        ends = 3 * np.arange(m + 1, dtype=np.int32)
        slopes: F32 = csr_array((lift.ravel(), corner.ravel(), ends), shape=(m, len(blend))) @ self._fields
        return slopes


def within(points: NDArray[np.floating], low: NDArray[np.floating], high: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which of the points (N, 3) are in a box."""
    inside = np.ones(len(points), np.bool_)
    for values, least, most in zip(points.T, low, high, strict=True):
        inside &= (values > least) & (values < most)
    return inside


def averaged(points: F32, settings: ObservationSettings) -> Measured:
    """Means of the points (N, 3) [m] in cells of space: a mean has less noise than its points, and is matched once."""
    if len(points) > settings.most_points:  # a picture's points are in rows, so this is even
        points = points[np.linspace(0, len(points) - 1, settings.most_points).astype(np.intp)]
    cell = np.floor(points / settings.cell + _OFF_CENTRE).astype(np.int64)
    cell -= cell.min(0)
    _, high, deep = cell.max(0) + 1
    key = (cell[:, 0] * high + cell[:, 1]) * deep + cell[:, 2]
    _, of_point, count = np.unique(key, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(of_point, values) for values in points.T], 1) / count[:, None]
    return Measured(means.astype(np.float32), (count / (count + settings.enough)).astype(np.float32))
