"""Garments in a mirror: bodies and most garments are symmetric, so each sample is two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from refu_core.body import MIRRORED_JOINTS
from refu_core.garments import GarmentTemplate

MAX_ASYMMETRY = 5e-3
"""A template that is anywhere farther than this from its mirror image counts as asymmetric [m]."""


@dataclass(frozen=True, eq=False)
class SurfaceMixture:
    """Places on a garment: each lies in a triangle, and takes a weighted mean of the values at its three corners."""

    corners: Tensor
    """Vertices of the triangles, shape (P, 3), int64."""
    weights: Tensor
    """How much each corner counts, shape (P, 3)."""

    @staticmethod
    def nearest(
        garment: GarmentTemplate, points: NDArray[np.float64]
    ) -> tuple[SurfaceMixture, NDArray[np.float64], NDArray[np.float64]]:
        """The places nearest to points (P, 3) [m]; their positions [m], (P, 3), and distances [m], (P,)."""
        vertices, faces = garment.v_template.cpu().double().numpy(), garment.faces.cpu().numpy()
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        places, distance, triangle = trimesh.proximity.closest_point(mesh, points)
        barycentrics = trimesh.triangles.points_to_barycentric(vertices[faces[triangle]], places)
        return SurfaceMixture(torch.as_tensor(faces[triangle]), torch.as_tensor(barycentrics)), places, distance

    def __call__(self, values: Tensor) -> Tensor:
        """Values at the places, shape (B, P, K), from values at the garment's vertices (B, V, K)."""
        weights = self.weights.to(values.dtype)
        corners = (weights[:, k, None] * values[:, self.corners[:, k]] for k in range(3))
        return sum(corners, start=torch.zeros(()))


def mirror_pose(pose: Tensor) -> Tensor:
    """The same pose in a mirror at x = 0: rotation vectors [rad], shape (B, 24, 3)."""
    return pose[:, MIRRORED_JOINTS] * pose.new_tensor((1.0, -1.0, -1.0))


@dataclass(frozen=True, eq=False)
class Mirror:
    """Where each vertex of a garment lies in its mirror image.

    The garments' surfaces are symmetric, but their meshes aren't: a mirrored vertex lies in a triangle, and takes a
    weighted mean of its three corners. The body and the bases of shape and style are symmetric, so β and γ stay.
    """

    image: SurfaceMixture

    @staticmethod
    def of(garment: GarmentTemplate) -> Mirror | None:
        """The mirror image of a garment; None for one that isn't symmetric."""
        mirrored = garment.v_template.cpu().double().numpy() * np.array((-1.0, 1.0, 1.0))
        image, _, distance = SurfaceMixture.nearest(garment, mirrored)
        return Mirror(image) if distance.max() <= MAX_ASYMMETRY else None

    def displacement(self, displacement: Tensor) -> Tensor:
        """Displacements of the mirrored garment, from `displacement`; both (B, V, 3) [m]."""
        mixed = self.image(displacement)
        return mixed * mixed.new_tensor((-1.0, 1.0, 1.0))
