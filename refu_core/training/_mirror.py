"""Left-right mirrored samples: twice the data from a body and garments that are symmetric."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from torch import Tensor

from refu_core.body import MIRRORED_JOINTS
from refu_core.errors import GarmentError
from refu_core.garments import GarmentTemplate

MAX_ASYMMETRY = 5e-3
"""A template that is farther from its own mirror image anywhere has none [m]."""


def mirror_pose(pose: Tensor) -> Tensor:
    """The same pose in a mirror at x = 0: rotation vectors [rad], shape (B, 24, 3)."""
    return pose[:, MIRRORED_JOINTS] * pose.new_tensor((1.0, -1.0, -1.0))


@dataclass(frozen=True, eq=False)
class Mirror:
    """Where each vertex of a garment lies in its mirror image.

    The garments' meshes aren't symmetric, their surfaces are: a mirrored vertex lies in a triangle, and takes a
    mixture of its three corners. The body and the bases of shape and style are symmetric, so β and γ stay.
    """

    corners: Tensor
    """Triangle of each mirrored vertex, shape (V, 3), int64."""
    barycentrics: Tensor
    """Its place there, shape (V, 3)."""
    asymmetry: float
    """Largest distance of a mirrored vertex to the surface [m]."""

    @staticmethod
    def of(garment: GarmentTemplate) -> Mirror:
        """The mirror image of a garment.

        Raises:
            GarmentError: the garment isn't symmetric.
        """
        vertices, faces = garment.v_template.cpu().double().numpy(), garment.faces.cpu().numpy()
        mirrored = vertices * np.array((-1.0, 1.0, 1.0))
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        nearest, distance, triangle = trimesh.proximity.closest_point(mesh, mirrored)
        asymmetry = float(distance.max())
        if asymmetry > MAX_ASYMMETRY:
            msg = f"{garment.name} is off its mirror image by {1e3 * asymmetry:.1f} mm; train it without mirroring"
            raise GarmentError(msg)
        barycentrics = trimesh.triangles.points_to_barycentric(vertices[faces[triangle]], nearest)
        return Mirror(
            corners=torch.as_tensor(faces[triangle]),
            barycentrics=torch.as_tensor(barycentrics, dtype=torch.float32),
            asymmetry=asymmetry,
        )

    def displacement(self, displacement: Tensor) -> Tensor:
        """Displacements of the mirrored garment, of `displacement`; both (B, V, 3) [m]."""
        mixed = sum(
            (self.barycentrics[:, k, None] * displacement[:, self.corners[:, k]] for k in range(3)),
            start=torch.zeros(()),
        )
        return mixed * mixed.new_tensor((-1.0, 1.0, 1.0))
