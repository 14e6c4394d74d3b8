"""Where cloth is pressed between two parts of a body: an estimate from geometry, not a force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core._warp import Unpicklable, as_warp, ints, memory
from refu_core.body import DEFAULT_GAP, SEGMENTS, SmplBody
from refu_core.contact import LimbMeshes
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
        self._limbs = LimbMeshes(body.to(device="cpu"), SEGMENTS.values())
        self._shift = memory(body.n_vertices, 3)
        self._parts = parts = kernels.Parts()
        parts.mesh, parts.shift = self._limbs.trees, as_warp(self._shift, wp.vec3)
        parts.low, parts.high = self._limbs.bundles.group_low, self._limbs.bundles.group_high
        corners = [mesh.indices.numpy() for mesh in self._limbs.meshes]
        parts.start = ints(np.cumsum([0, *map(len, corners)]), "cpu")
        parts.corner = ints(np.concatenate(corners), "cpu")

    @classmethod
    def of(cls, pipeline: GarmentPipeline) -> LimbContacts:
        """For the outputs of a pipeline. Raises `MeshError` for anything else."""
        require_pipeline(pipeline, "garments", "body", error=MeshError)
        return cls(pipeline.body, pipeline.garments)

    def __call__(self, output: PipelineOutput) -> tuple[LimbContact, ...]:
        """The contacts in an output, those of large area first. Raises `MeshError` for no output, or other garments."""
        require_worn(output, self._faces)
        body, skin = (torch.tensor(one, device="cpu") for one in (output.body, output.skin))
        self._shift.copy_(body - skin)
        self._limbs.update(body)
        self._limbs.pose(-1)
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
