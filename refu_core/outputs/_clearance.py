"""How far cloth is from the body after it was moved off it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.body import SmplBody
from refu_core.errors import MeshError, require_pipeline
from refu_core.garments import GarmentTemplate
from refu_core.mesh import as_points
from refu_core.outputs._worn import require_known, require_outfit, require_worn
from refu_core.realtime import GarmentPipeline, PipelineOutput
from refu_core.sdf import BandSdf

REACH = 0.02
"""Clearance is exact up to this [m]: a hand's thickness, and beyond it cloth hangs free."""


class Clearance:
    """Signed distances of garments to the collider, exact where they matter.

    A pipeline's own distances are from before its pushes, and approximate in its default mode. So they are computed
    anew here, but only where they matter, as in the accurate mode (`BandSdf`): a garment's edges tell that the rest of
    it is outside.
    """

    reach = REACH

    def __init__(self, body: SmplBody, garments: Mapping[str, GarmentTemplate]) -> None:
        """For garments on a body, on the CPU, as a pipeline's outputs are. Raises `MeshError` for anything else."""
        require_outfit(body, garments)
        self._sdf = BandSdf(body.faces.cpu(), band=self.reach, rest=body.v_template.detach().cpu())
        self._rings = {name: garment.mesh.ring for name, garment in garments.items()}

    @classmethod
    def of(cls, pipeline: GarmentPipeline) -> Clearance:
        """For the outputs of a pipeline. Raises `MeshError` for anything else."""
        require_pipeline(pipeline, "garments", "body", error=MeshError)
        return cls(pipeline.body, pipeline.garments)

    def __call__(self, output: PipelineOutput) -> dict[str, NDArray[np.float32]]:
        """The distances of each garment in a pipeline's output, by name, as from `of_garment`."""
        require_worn(output, self._rings)
        self.update(output.body)
        return {name: self.of_garment(name, garment.local) for name, garment in output.items()}

    def update(self, body: Any) -> None:
        """Takes over a posed collider's vertices (V, 3) [m]. Raises `MeshError` for anything else."""
        self._sdf.update(torch.from_numpy(as_points("the body's vertices", body, dtype=np.float32)))

    def of_garment(self, name: str, vertices: Any) -> NDArray[np.float32]:
        """Distance of a garment's vertices (V, 3) [m] to the collider, negative inside [m], shape (V,).

        Exact inside and up to `reach`; a vertex farther out gets `reach`. Raises `MeshError` for an unknown garment,
        for an array that can't be its vertices, and if `update` was given no body yet.
        """
        require_known(name, self._rings)
        ring = self._rings[name]
        points = as_points("the garment's vertices", vertices, len(ring.start) - 1, dtype=np.float32)
        return self._sdf.clipped(torch.from_numpy(points), ring).distance.numpy()
