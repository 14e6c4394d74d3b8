"""Bodies of mean shape in the poses that garments are modelled in."""

from __future__ import annotations

import numpy as np
import torch

from refu_core.body import JOINT_NAMES, SmplBody
from refu_core.fitting._mesh_file import F64, Ints
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.mesh import vertex_areas
from refu_core.sdf import ExactSdf

LEFT_SHOULDER, RIGHT_SHOULDER = (JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right"))
LEFT_ELBOW, RIGHT_ELBOW = (JOINT_NAMES.index(f"{side}_elbow") for side in ("left", "right"))
LEFT_HIP, RIGHT_HIP = (JOINT_NAMES.index(f"{side}_hip") for side in ("left", "right"))


class PosedBody:
    """A body of mean shape in some pose, and how far from it things are."""

    def __init__(self, body: SmplBody, pose: F64) -> None:
        self.body = body
        self._mean = body.shape(body.v_template.new_zeros(1, N_BETAS))
        self._sdf = ExactSdf(body.faces)
        self.skin = vertex_areas(body.arrays.v_template, body.arrays.faces)
        """Area of each vertex at rest [m²], shape (V,)."""
        self.move(pose)

    def move(self, pose: F64) -> None:
        """Takes another pose."""
        self.pose = pose
        posed = self.body.posed(torch.as_tensor(pose, dtype=torch.float32)[None], self._mean)
        self.vertices, self.transforms = posed.vertices[0], posed.transforms
        self._sdf.update(self.vertices)
        height = self.vertices[:, 1]
        self.floor, self.top = float(height.min()), float(height.max())

    def __call__(self, points: F64) -> tuple[F64, F64]:
        """Signed distance [m], shape (P,), and its unit gradient, (P, 3)."""
        found = self._sdf.query(torch.as_tensor(points, dtype=torch.float32))
        return found.distance.double().numpy(), found.gradient.double().numpy()

    def closest(self, points: F64) -> tuple[Ints, F64]:
        """The closest face of each point (P, 3), and where in it that is, as barycentric coordinates (P, 3)."""
        found = self._sdf.closest(torch.as_tensor(points, dtype=torch.float32))
        return found.face.long().numpy(), found.barycentrics.double().numpy()


def standing_pose(arms: float, legs: float = 0.0, elbows: float = 0.0, forward: float = 0.0) -> F64:
    """The T-pose with arms lowered, legs spread, elbows bent and arms brought forward by some angles [rad], (24, 3)."""
    pose = np.zeros((N_JOINTS, 3))
    pose[LEFT_SHOULDER, 1:], pose[RIGHT_SHOULDER, 1:] = (-forward, -arms), (forward, arms)
    pose[LEFT_ELBOW, 1], pose[RIGHT_ELBOW, 1] = -elbows, elbows
    pose[LEFT_HIP, 2], pose[RIGHT_HIP, 2] = legs, -legs
    return pose
