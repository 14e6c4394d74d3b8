"""A garment as planners take obstacles: few triangles, closed, and as thick as is said."""

from __future__ import annotations

import hashlib
import math
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from refu_core._cache import keep, recall
from refu_core.errors import MeshError
from refu_core.outputs._check import as_points
from refu_core.outputs._planner_fit import fitted_means
from refu_core.outputs._practice import practised
from refu_core.outputs._simplify import simplify

if TYPE_CHECKING:
    from collections.abc import Callable

    from refu_core.garments import GarmentTemplate
    from refu_core.realtime import GarmentPipeline

HALF_THICKNESS = 0.005
"""How far either side of the solid is from the middle of the cloth [m]: about as far as the coarse cloth may be from
the garment, which so lies within the solid nearly everywhere."""
MAX_TRIANGLES = 2000
_LEAST_TRIANGLES = 100
_VERSION = 3
"""Of what is recalled: another one is computed anew."""
Worn = NDArray[np.float64]


class PlannerMesh:
    """A coarse, closed copy of one garment, decimated once; a frame of it is one sparse product.

    The cloth becomes a sheet of about half the triangles. Which ones, and of which vertices of the garment its vertices
    are means, is found on a number of poses, so that it is near the cloth in all of them. Its two sides lie
    `half_thickness` off the sheet, with a wall along every rim.

    A solid around the cloth reaches into the body that wears it: planners are to allow these two to touch.
    """

    def __init__(
        self,
        garment: GarmentTemplate,
        max_triangles: int = MAX_TRIANGLES,
        *,
        half_thickness: float = HALF_THICKNESS,
        worn: Callable[[], Worn] | None = None,
    ) -> None:
        """Prepares for a garment, in some seconds the first time; then what was found is recalled (`REFU_CACHE`).

        Args:
            garment: what is decimated.
            max_triangles: the most that the solid has, 100 at least.
            half_thickness: from the middle of the cloth to either side [m].
            worn: gives the garment as it is worn in several poses [m], shape (P, V, 3); asked only where nothing is
                recalled. Without, the rest pose has to do. `of` makes them.

        Raises:
            MeshError: fewer triangles or no thickness are asked for, or the garment can't be drawn so coarse.
        """
        if max_triangles < _LEAST_TRIANGLES or not 0 < half_thickness < math.inf:
            msg = (
                f"wanted {_LEAST_TRIANGLES} triangles or more and a positive half thickness, got {max_triangles} "
                f"and {half_thickness}"
            )
            raise MeshError(msg)
        self.half_thickness = float(half_thickness)
        """[m]"""
        rest = garment.v_template.detach().cpu().double().numpy()
        self._n_vertices = len(rest)
        kept, self._sheet, self._take = _prepared(garment, rest, max_triangles, worn)
        self.faces: NDArray[np.int32] = _solid(self._sheet, len(kept))
        """Counter-clockwise from outside, shape (T, 3); the same in every frame."""
        if len(self.faces) > max_triangles:
            msg = f"{garment.name} can't be drawn with {max_triangles} triangles, {len(self.faces)} are its least"
            raise MeshError(msg)
        corners = np.repeat(np.arange(len(self._sheet)), 3)
        self._around = csr_array(
            (np.ones(3 * len(self._sheet)), (self._sheet.ravel(), corners)), shape=(len(kept), len(self._sheet))
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
        """For a pipeline's garment of this name, which it dresses in ten poses the first time.

        Raises:
            MeshError: as the constructor does, or the pipeline has no such garment.
        """
        template = pipeline.garments.get(garment)
        if template is None:
            msg = f"the pipeline has no garment {garment!r}: wanted one of {', '.join(pipeline.garments)}"
            raise MeshError(msg)
        return cls(template, max_triangles, half_thickness=half_thickness, worn=lambda: practised(pipeline, garment))

    @property
    def sheet(self) -> NDArray[np.int32]:
        """Faces of the sheet in the middle of the solid, counter-clockwise from outside, shape (S, 3)."""
        return self._sheet

    @cached_property
    def n_vertices(self) -> int:
        """Vertices of the solid."""
        return 2 * self._take.shape[0]

    def middle(self, vertices: Any) -> NDArray[np.float64]:
        """The sheet in the middle of the solid [m], shape (n_vertices / 2, 3), as `solid`."""
        points = as_points("the garment's vertices", vertices, self._n_vertices)
        sheet: NDArray[np.float64] = self._take @ points
        return sheet

    def solid(self, vertices: Any) -> NDArray[np.float64]:
        """The solid of a garment as it is worn.

        Args:
            vertices: Of the garment [m], shape (V, 3), in any right-handed axes.

        Returns:
            Vertices for `faces` in the same axes [m], shape (n_vertices, 3).

        Raises:
            MeshError: not finite numbers of that shape.
        """
        middle = self.middle(vertices)
        a, b, c = middle[self._sheet].transpose(1, 0, 2)
        u, v = b - a, c - a
        normal = np.empty_like(u)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            normal[:, i] = u[:, j] * v[:, k] - u[:, k] * v[:, j]
        out = self._around @ normal
        out *= self.half_thickness / np.maximum(np.sqrt(np.einsum("ij,ij->i", out, out)), 1e-12)[:, None]
        return np.concatenate((middle + out, middle - out))


def _prepared(
    garment: GarmentTemplate, rest: NDArray[np.float64], max_triangles: int, worn: Callable[[], Worn] | None
) -> tuple[NDArray[np.intp], NDArray[np.int32], csr_array]:
    """The vertices that are kept, the sheet's faces and its weights; computed once for a garment, and then recalled."""
    digest = hashlib.sha256(rest.astype(np.float32).tobytes() + garment.mesh.faces.tobytes()).hexdigest()[:16]
    name = f"planner-{_VERSION}-{digest}-{max_triangles}{'-worn' if worn else ''}"
    keys = ("kept", "sheet", "weight", "column", "start")
    known = recall(name, keys=keys)
    if known is None:
        shapes = rest[None] if worn is None else np.concatenate((rest[None], worn()))
        kept, sheet = simplify(shapes, garment.mesh.faces, max_triangles)
        take = fitted_means(shapes, garment.mesh, kept, sheet)
        known = dict(zip(keys, (kept, sheet, take.data, take.indices, take.indptr), strict=True))
        keep(name, known)
    shape = (len(known["kept"]), len(rest))
    return known["kept"], known["sheet"], csr_array((known["weight"], known["column"], known["start"]), shape=shape)


def _solid(sheet: NDArray[np.int32], n: int) -> NDArray[np.int32]:
    """Both sides of a sheet of n vertices, and walls along its rims."""
    start, end = sheet.ravel().astype(np.int64), np.roll(sheet, -1, axis=1).ravel().astype(np.int64)
    rim = ~np.isin(start * n + end, end * n + start)
    a, b = start[rim], end[rim]
    walls = np.concatenate((np.stack((b, a, a + n), 1), np.stack((b, a + n, b + n), 1)))
    return np.concatenate((sheet, sheet[:, ::-1] + n, walls)).astype(np.int32)
