"""What the networks of one garment predict, on another that lies near it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core.backbones import load_backbone
from refu_core.body import SmplBody, load_fit
from refu_core.garments import GarmentTemplate, worn_on
from refu_core.modes import SdfMode
from refu_core.training._data import in_chunks

if TYPE_CHECKING:
    from refu_core.training._carry import CarrySettings

_CHUNK = 32
_CORNERS = range(3)


class Carried:
    """What the networks of one garment predict, on another.

    Cloth is moved and posed as what it lies near, with the skinning weights that this has there: a displacement is
    worth what its garment's weights make of it. With a garment's own weights a hem that hangs 100 mm off a person who
    bends would be elsewhere, in the reach of the hands.
    """

    def __init__(
        self, related: GarmentTemplate, garment: GarmentTemplate, body: SmplBody, settings: CarrySettings
    ) -> None:
        """For `garment` on its `body`, near which `related` lies once it is worn on the same body.

        Raises `WeightsError` when no networks of `related` ship.
        """
        self.network = load_backbone("tailornet", related, mode=SdfMode.HYBRID)
        fit = None if garment.body == related.body else load_fit(garment.body)
        self._betas = None if fit is None else fit.difference(related.body).betas
        worn = worn_on(related, fit)
        faces, vertices = worn.faces.numpy(), worn.v_template.double().numpy()
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        place, distance, face = trimesh.proximity.closest_point(mesh, garment.v_template.double().numpy())
        share = _smooth((settings.reach + settings.fade - distance) / settings.fade)
        # Trousers go on where shorts end: a hem that swings there would be a step in them.
        own = _from_rim(garment, garment.v_template.double().numpy(), garment.v_template.double().numpy())
        ends = _from_rim(worn, vertices, place)
        goes_on = _smooth((own - ends) / settings.hem)
        share *= 1 - goes_on * _smooth(1 - ends / settings.hem)
        weights = trimesh.triangles.points_to_barycentric(vertices[faces[face]], place)
        self._corners = torch.as_tensor(faces[face])
        self._weights = torch.as_tensor(weights * share[:, None], dtype=torch.float32)
        self._garment, self._body = garment, body
        kept = torch.as_tensor(1 - share, dtype=torch.float32)[:, None]
        self._posed_as = replace(garment, weights=self._mixed(worn.weights[None])[0] + kept * garment.weights)

    @torch.no_grad()
    def __call__(self, betas: Tensor, pose: Tensor) -> Tensor:
        """Displacements of the other garment [m], (B, V, 3), for its betas (B, 10) and poses (B, 24, 3) [rad]."""

        def one(betas: Tensor, pose: Tensor) -> Tensor:
            known = betas if self._betas is None else self._betas(betas).float()
            there = self.network(known, pose, None).displacement
            assert there is not None  # a network was asked for
            rest, transforms = self._garment.rest(betas), self._body(pose, betas).transforms
            posed = self._posed_as.pose(rest + self._mixed(there), transforms)
            return self._garment.unpose(posed, transforms) - rest

        return in_chunks(one, betas, pose, size=_CHUNK)

    def _mixed(self, values: Tensor) -> Tensor:
        """Of values at the related garment's vertices (B, V', K) those at the other one's, shape (B, V, K)."""
        corners = (self._weights[:, k, None] * values[:, self._corners[:, k]] for k in _CORNERS)
        return sum(corners, start=torch.zeros(()))


def _smooth(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """From 0 to 1, level at both ends, for shares cut off there."""
    cut: NDArray[np.float64] = np.clip(share, 0, 1)
    return cut * cut * (3 - 2 * cut)


def _from_rim(
    garment: GarmentTemplate, vertices: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far `points` (P, 3) are from the nearest hem of a garment with its vertices at `vertices` (V, 3) [m]."""
    return np.asarray(cKDTree(vertices[np.unique(garment.mesh.boundary)]).query(points)[0])
