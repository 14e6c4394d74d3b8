"""One garment that follows measured points."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import as_warp
from refu_core.mesh import vertex_normals
from refu_core.observation._estimate import Estimate
from refu_core.observation._match_kernels import match_kernel
from refu_core.observation._modes import smooth_modes

if TYPE_CHECKING:
    from refu_core.garments import GarmentTemplate
    from refu_core.observation._settings import ObservationSettings

F32 = NDArray[np.float32]


class Matches(NamedTuple):
    """M points and their places on the cloth."""

    points: NDArray[np.intp]
    """Which of the points, shape (M,)."""
    face: NDArray[np.int32]
    weight: F32
    """Of the face's corners, shape (M, 3)."""
    normal: F32
    height: F32
    """Off the cloth along the normal [m], shape (M,)."""


class ObservedCloth:
    """The numbers of one garment that points may change, and what they do to it before it is posed."""

    def __init__(self, garment: GarmentTemplate, settings: ObservationSettings) -> None:
        self._settings = settings
        self._faces = garment.mesh.faces
        n = garment.n_vertices
        modes = smooth_modes(garment, min(settings.modes, n // 8))
        rest = garment.v_template.detach().cpu().double().numpy()
        self._out = vertex_normals(rest, self._faces).astype(np.float32)
        self._fields = modes.fields
        directions = [garment.shapedirs] if garment.styledirs is None else [garment.styledirs, garment.shapedirs]
        self._cut = np.concatenate([d.detach().cpu().numpy().reshape(n, 3, -1) for d in directions], 2)
        self._cut = self._cut.astype(np.float32)
        """Of style and shape: how vertices move with each number, shape (V, 3, C)."""
        falls = 1 / (1 + (modes.wave / settings.wave) ** 2)
        std = settings.amplitude * falls / np.sqrt((falls**2).sum())
        n_style = 0 if garment.styledirs is None else garment.styledirs.shape[1]
        n_shape = garment.shapedirs.shape[1]
        every = np.concatenate((np.full(n_style, settings.style), np.full(n_shape, settings.shape), std))
        times = np.full(len(every), settings.remembered)
        times[: n_style + n_shape] = settings.style_remembered
        self.estimate = Estimate(every, times, settings.bound)
        on_rim = garment.mesh.n_faces_of_edge[garment.mesh.edge_of_corner] == 1
        # Bit k says that the edge across from weight k is on the boundary, in the kernel's order of weights.
        bits = (on_rim[:, [1, 2, 0]] * np.array([2, 4, 1])).sum(1).astype(np.int32)
        self._rim = wp.array(bits, dtype=wp.int32, device="cpu")
        self._points = garment.v_template.detach().cpu().float().clone()
        self._mesh = wp.Mesh(
            as_warp(self._points, wp.vec3), wp.array(self._faces.ravel(), dtype=wp.int32, device="cpu")
        )

    def offset(self, numbers: NDArray[np.float64]) -> F32:
        """What the numbers (D,) add to the garment before it is posed [m], shape (V, 3)."""
        n = self._cut.shape[2]
        some = numbers.astype(np.float32)
        cut = self._cut.reshape(-1, n) @ some[:n]  # one product: a stack of small ones takes ten times as long
        found: F32 = cut.reshape(-1, 3) + (self._fields @ some[n:])[:, None] * self._out
        return found

    def place(self, vertices: Tensor) -> None:
        """Takes over where it is [m], shape (V, 3)."""
        self._points.copy_(vertices)
        self._mesh.refit()

    def match(self, points: F32, skin: wp.Mesh, eye: NDArray[np.float64] | None) -> Matches:
        """Which of the points (N, 3) [m] are the cloth's, and where."""
        n = len(points)
        face, height = np.empty(n, np.int32), np.empty(n, np.float32)
        weight, normal = np.empty((2, n, 3), np.float32)
        how = self._settings
        seen = wp.vec3() if eye is None else wp.vec3(*eye.tolist())
        wp.launch(
            match_kernel,
            n,
            [
                wp.array(points, dtype=wp.vec3, device="cpu", copy=False),
                *(self._mesh.id, skin.id, self._rim, how.reach, how.slack, eye is not None, seen),
            ],
            [
                wp.array(face, dtype=wp.int32, device="cpu", copy=False),
                wp.array(weight, dtype=wp.vec3, device="cpu", copy=False),
                wp.array(normal, dtype=wp.vec3, device="cpu", copy=False),
                wp.array(height, dtype=wp.float32, device="cpu", copy=False),
            ],
            device="cpu",
        )
        rows = np.flatnonzero(face >= 0)
        return Matches(rows, face[rows], weight[rows], normal[rows], height[rows])

    def slopes(self, found: Matches, blend: F32) -> F32:
        """How the cloth rises along each match's normal with each number, shape (M, D).

        `blend` (V, 3, 3) is what poses a displacement.
        """
        corner = self._faces[found.face]
        along = np.einsum("mi,mkij->mkj", found.normal, blend[corner], optimize=True) * found.weight[:, :, None]
        cut = np.einsum("mkj,mkjc->mc", along, self._cut[corner], optimize=True)
        lift = (along * self._out[corner]).sum(2)
        fields = np.zeros((len(corner), self._fields.shape[1]), np.float32)
        for k in range(3):  # all three at once would be larger than a processor's cache
            fields += lift[:, k, None] * self._fields[corner[:, k]]
        return np.concatenate((cut, fields), axis=1)


def thinned(points: F32, most: int) -> F32:
    """Every so-many-th of the points (N, 3), `most` at most: a picture's are in rows, so that is even."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(np.intp)]


def skin_mesh(vertices: Tensor, faces: Tensor) -> tuple[Tensor, wp.Mesh]:
    """A mesh over memory that poses are copied to, and that memory (V, 3)."""
    points = torch.zeros_like(vertices, dtype=torch.float32).copy_(vertices)
    indices = wp.array(faces.numpy().astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
    return points, wp.Mesh(as_warp(points, wp.vec3), indices)
