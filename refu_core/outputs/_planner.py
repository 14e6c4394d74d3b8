"""A garment as planners take obstacles: few triangles, closed, and of a given thickness."""

from __future__ import annotations

import hashlib
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from refu_core._cache import keep, recall
from refu_core.errors import MeshError
from refu_core.frames import N_JOINTS, SmplFrame
from refu_core.mesh import as_points, rim_of
from refu_core.outputs._planner_fit import fitted_means
from refu_core.outputs._simplify import simplify
from refu_core.skeleton import JOINT_NAMES

if TYPE_CHECKING:
    from collections.abc import Callable

    from refu_core.garments import GarmentTemplate
    from refu_core.realtime import GarmentPipeline

HALF_THICKNESS = 0.005
"""How far each side of the solid is from the middle of the cloth [m]. The coarse cloth may be about this far from the
garment, so the garment lies within the solid nearly everywhere."""
MAX_TRIANGLES = 2000
_LEAST_TRIANGLES = 100
_VERSION = 3
"""Version of what is cached; a result of any other version is computed anew."""
_POSES = {
    "T-pose": "",
    "stands": "left_shoulder 0 0 -1.15, right_shoulder 0 0 1.15",
    "arms overhead": "left_shoulder 0 0 0.95, right_shoulder 0 0 -0.95, left_collar 0 0 0.3, right_collar 0 0 -0.3",
    "squats": "left_hip -1.3 0.2 0.4, right_hip -1.3 -0.2 -0.4, left_knee 1.7 0 0, right_knee 1.7 0 0, spine1 0.2 0 0, "
    "left_shoulder 0.2 0 -0.7, right_shoulder 0.2 0 0.7",
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
"""Poses in which a planner's mesh has to fit: joints and their rotation vectors [rad]."""
Worn = NDArray[np.float64]


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
        worn: Callable[[], Worn] | None = None,
    ) -> None:
        """Prepares for a garment: some seconds the first time, after which the result is cached (`REFU_CACHE`).

        The solid has `max_triangles` at most, and its sides are `half_thickness` [m] from the middle of the cloth.
        `worn` returns the garment as it is worn in several poses [m], (P, V, 3), and is called if nothing is cached;
        without it only the rest pose is used. Raises `MeshError` for fewer than 100 triangles, for no thickness, and if
        a garment can't be made that coarse.
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
        kept, self.sheet, self._take = _prepared(garment, rest, max_triangles, worn)
        """`sheet`: faces of the sheet in the middle of the solid, counter-clockwise from outside, shape (S, 3)."""
        self.faces: NDArray[np.int32] = _solid(self.sheet, len(kept))
        """Counter-clockwise from outside, shape (T, 3); the same in every frame."""
        if len(self.faces) > max_triangles:
            msg = f"{garment.name} can't be drawn with {max_triangles} triangles, {len(self.faces)} are its least"
            raise MeshError(msg)
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
        """For a pipeline's garment of this name, which the pipeline drapes in ten poses the first time.

        Raises `MeshError` as the constructor does, and where the pipeline has no such garment.
        """
        template = pipeline.garments.get(garment)
        if template is None:
            msg = f"the pipeline has no garment {garment!r}: wanted one of {', '.join(pipeline.garments)}"
            raise MeshError(msg)
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
        normal = np.empty_like(u)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            normal[:, i] = u[:, j] * v[:, k] - u[:, k] * v[:, j]
        out = self._around @ normal
        out *= self.half_thickness / np.maximum(np.sqrt(np.einsum("ij,ij->i", out, out)), 1e-12)[:, None]
        return np.concatenate((middle + out, middle - out))


def _prepared(
    garment: GarmentTemplate, rest: NDArray[np.float64], max_triangles: int, worn: Callable[[], Worn] | None
) -> tuple[NDArray[np.intp], NDArray[np.int32], csr_array]:
    """The vertices that are kept, the sheet's faces and its weights; computed once for a garment, and then cached."""
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
    """The faces of both sides of a sheet of n vertices, and of walls along its rims."""
    on_rim = rim_of(sheet)
    a, b = sheet[on_rim], np.roll(sheet, -1, axis=1)[on_rim]
    walls = np.concatenate((np.stack((b, a, a + n), 1), np.stack((b, a + n, b + n), 1)))
    return np.concatenate((sheet, sheet[:, ::-1] + n, walls)).astype(np.int32)


def _practised(pipeline: GarmentPipeline, garment: str) -> NDArray[np.float64]:
    """A pipeline's garment as it is worn in each of `_POSES` [m], shape (P, V, 3)."""
    worn = []
    for turns in _POSES.values():
        pose = np.zeros((N_JOINTS, 3))
        for joint, *turn in map(str.split, filter(None, turns.split(", "))):
            pose[JOINT_NAMES.index(joint)] = [float(number) for number in turn]
        # Not by calling the pipeline: it keeps its last outputs for callers that ask for the same frames again.
        worn.append(pipeline.adjusted(SmplFrame(pose=pose.astype(np.float32)), lambda dressed: dressed)[garment].local)
    return np.stack(worn).astype(np.float64)
