"""One garment that follows measured points."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import csr_array

from refu_core._warp import as_warp, ints
from refu_core.mesh import vertex_normals
from refu_core.observation._estimate import Estimate
from refu_core.observation._match_kernels import match_kernel
from refu_core.observation._modes import smooth_modes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from refu_core.garments import GarmentTemplate
    from refu_core.observation._settings import ObservationSettings

F32 = NDArray[np.float32]
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

    def __init__(self, garment: GarmentTemplate, settings: ObservationSettings) -> None:
        self._settings = settings
        self._faces = garment.mesh.faces
        n = garment.n_vertices
        fields, wave = smooth_modes(garment, min(settings.modes, n // 8))
        kept = wave <= settings.finest
        rest = garment.v_template.detach().cpu().double().numpy()
        self._out = vertex_normals(rest, self._faces).astype(np.float32)
        falls = 1 / (1 + (wave[kept] / settings.wave) ** 2)
        std = settings.amplitude * falls / np.sqrt((falls**2).sum())
        self._fields = np.ascontiguousarray(fields[:, kept]) * std.astype(np.float32)
        """How far vertices move along the normal with each number [m], shape (V, K)."""
        self.estimate = Estimate(np.full(len(std), settings.remembered), settings.bound)
        self.reset()
        on_rim = garment.mesh.n_faces_of_edge[garment.mesh.edge_of_corner] == 1
        # Bit k says that the edge from corner k to the next is on the boundary.
        bits = (on_rim * np.array([1, 2, 4])).sum(1)
        self._rim = ints(bits, "cpu")
        self._points = garment.v_template.detach().cpu().float().clone()
        self._mesh = wp.Mesh(as_warp(self._points, wp.vec3), ints(self._faces.ravel(), "cpu"))

    def reset(self) -> None:
        """Forgets what was measured."""
        self.estimate.reset()
        self._lift = np.zeros(len(self._out), np.float32)

    def wait(self, seconds: float) -> None:
        """Lets time pass. The displacement fades as the numbers do."""
        self.estimate.wait(seconds)
        self._lift *= math.exp(-seconds / self._settings.remembered)

    def draw(self, numbers: NDArray[np.float64]) -> None:
        """Sets the displacement to that of numbers (D,), in standard deviations."""
        self._lift = self._fields @ numbers.astype(np.float32)

    @property
    def offset(self) -> F32:
        """The displacement that is added to the garment before it is posed [m], shape (V, 3)."""
        found: F32 = self._lift[:, None] * self._out
        return found

    def place(self, vertices: F32) -> None:
        """Takes over where the garment's vertices are [m], shape (V, 3)."""
        self._points.copy_(torch.from_numpy(vertices))
        self._mesh.refit()

    @property
    def tree(self) -> int:
        """Warp's handle of the mesh of the garment where it is."""
        return int(self._mesh.id)

    def match(
        self, measured: Measured, skin: wp.Mesh, others: Sequence[int], eye: NDArray[np.float64] | None
    ) -> Matches:
        """Which of the points are the cloth's, not those of other garments (trees `others`), and where on it."""
        how = self._settings
        own = self._points.numpy()
        rows = np.flatnonzero(within(measured.points, own.min(0) - how.reach, own.max(0) + how.reach))
        points = wp.array(measured.points[rows], dtype=wp.vec3, device="cpu")
        seen = wp.vec3() if eye is None else wp.vec3(*eye.tolist())
        trees = wp.array(np.array(others, np.uint64), dtype=wp.uint64, device="cpu")
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


def within(points: NDArray[np.floating], low: F32, high: F32) -> NDArray[np.bool_]:
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
