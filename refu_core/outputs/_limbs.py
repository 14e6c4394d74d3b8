"""Where cloth is pressed between two parts of a body: an estimate from geometry, not a force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import Unpicklable, as_warp, ints, memory
from refu_core.body import DEFAULT_GAP, SEGMENTS, SmplBody, part_of_faces
from refu_core.errors import MeshError, require_pipeline
from refu_core.garments import GarmentTemplate
from refu_core.mesh import vertex_areas
from refu_core.outputs import _limbs_kernels as kernels
from refu_core.outputs._worn import require_outfit, require_worn
from refu_core.realtime import GarmentPipeline, PipelineOutput

PRESSED = DEFAULT_GAP + 0.003
"""Cloth is pressed if its distances to the skins on both sides add up to less than this [m]: the room that the collider
leaves between two parts, and some more since the two ways together are longer than the straight one."""
_OPPOSED = -0.5
"""Cosine of two skins' normals below which they face each other."""
_PARTS = tuple(SEGMENTS)


@dataclass(frozen=True, eq=False)
class LimbContact:
    """Cloth between two parts of the body that touch."""

    parts: tuple[str, str]
    """Their names, as in `refu_core.body.SEGMENTS`."""
    area: float
    """Area of the cloth between them, all garments together [m²]."""
    depth: float
    """Greatest depth to which the two would overlap, had neither given way [m]: what flesh and cloth have to take up.
    0 where they touch without pressing."""
    mean_depth: float
    """The same on average over the area [m]."""
    centre: NDArray[np.float64]
    """Middle of that cloth, in the axes of the garments' `local` vertices [m], shape (3,)."""


class LimbContacts(Unpicklable):
    """Finds the cloth that is pressed between parts of a body, by how far the collider had to give way.

    This is geometry alone: it doesn't know how stiff cloth or flesh is, so it can't give a force.
    """

    def __init__(self, body: SmplBody, garments: Mapping[str, GarmentTemplate]) -> None:
        """For garments on a body, on the CPU. Raises `MeshError` for anything else."""
        require_outfit(body, garments)
        self._faces = {name: garment.faces.cpu().numpy() for name, garment in garments.items()}
        self._points, self._shift = memory(2, body.n_vertices, 3)
        self._points.copy_(body.v_template.detach())
        part = part_of_faces(body.weights.cpu(), body.faces.cpu(), list(SEGMENTS.values())).numpy()
        faces = body.faces.cpu().numpy().astype(np.int32)
        own = [faces[part == k] for k in range(len(_PARTS))]
        points = as_warp(self._points, wp.vec3)
        self._meshes = [wp.Mesh(points, ints(one.ravel(), "cpu")) for one in own]
        parts = kernels.Parts()
        parts.mesh = wp.array([mesh.id for mesh in self._meshes], dtype=wp.uint64, device="cpu")
        parts.face_start = ints(np.cumsum([0, *map(len, own)]), "cpu")
        parts.face = ints(np.concatenate(own).ravel(), "cpu")
        parts.low, parts.high = (wp.zeros(len(_PARTS), dtype=wp.vec3, device="cpu") for _ in range(2))
        parts.points, parts.shift = points, as_warp(self._shift, wp.vec3)
        self._parts = parts

    @classmethod
    def of(cls, pipeline: GarmentPipeline) -> LimbContacts:
        """For the outputs of a pipeline. Raises `MeshError` for anything else."""
        require_pipeline(pipeline, "garments", "body", error=MeshError)
        return cls(pipeline.body, pipeline.garments)

    def __call__(self, output: PipelineOutput) -> tuple[LimbContact, ...]:
        """The contacts in an output of the pipeline, the one of the largest area first.

        Raises `MeshError` for anything but an output, and for an output with other garments.
        """
        require_worn(output, self._faces)
        body = output.body
        self._points.numpy()[:] = body
        self._shift.numpy()[:] = body - output.skin
        for mesh in self._meshes:
            mesh.refit()
        wp.launch(kernels.box_kernel, len(_PARTS), [self._parts], device="cpu")
        found = [self._pressed(garment.local, self._faces[name]) for name, garment in output.items()]
        pairs, rows = map(np.concatenate, zip(*found, strict=True))
        contacts = [_contact(int(pair), rows[pairs == pair]) for pair in np.unique(pairs)]
        return tuple(sorted(contacts, key=lambda contact: -contact.area))

    def _pressed(
        self, points: NDArray[np.float32], faces: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """For the vertices that are pressed: the pair of parts, (M,), and area, depth and place, (M, 5)."""
        n = len(points)
        pair, depth = np.empty(n, np.int32), np.empty(n, np.float32)
        kinds = ((points, wp.vec3), (pair, wp.int32), (depth, wp.float32))
        asked, *outputs = (wp.array(one, dtype=kind, device="cpu", copy=False) for one, kind in kinds)
        wp.launch(kernels.pressed_kernel, n, [asked, self._parts, PRESSED, _OPPOSED], outputs, device="cpu")
        rows = np.flatnonzero(pair >= 0)
        area = vertex_areas(points, faces[(pair[faces] >= 0).any(axis=1)])
        return pair[rows], np.column_stack((area[rows], depth[rows], points[rows]))


def _contact(pair: int, rows: NDArray[np.float64]) -> LimbContact:
    area, depth, places = rows[:, 0], rows[:, 1], rows[:, 2:]
    share = area / max(float(area.sum()), 1e-12)
    first, second = divmod(pair, len(_PARTS))
    return LimbContact(
        (_PARTS[first], _PARTS[second]), float(area.sum()), float(depth.max()), float(share @ depth), share @ places
    )
