"""Cloth that hangs behind the legs: it stays behind them."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import as_warp, ints, memory, recorded, strips, torch_stream
from refu_core.body import LEGS, SmplBody, weight_of_parts
from refu_core.contact import _tent_kernels as kernels
from refu_core.garments import GarmentTemplate
from refu_core.skeleton import JOINT_NAMES

_BACKWARDS = np.array([0.0, 0.0, -1.0])
"""The way backwards in the T-pose, in SMPL axes."""
_BONES = [[JOINT_NAMES.index(f"{side}_{joint}") for joint in ("knee", "ankle")] for side in ("left", "right")]


class Shins:
    """How the lower legs of one posed body stand, shared by all garments on it."""

    def __init__(self, body: SmplBody) -> None:
        """For poses of this body, on its device."""
        self._device = body.device
        self._vertices = memory(*body.v_template.shape, device=body.device).copy_(body.v_template)
        skin, self._joints = (one.detach().cpu().double().numpy() for one in (body.v_template, body.joint_template))
        owner = body.weights.argmax(1).cpu().numpy()
        of_legs, shares, radii = [], [], []
        for knee, ankle in _BONES:
            (own,) = np.nonzero(owner == knee)
            places = np.stack([self._joints[knee], self._joints[ankle], self._joints[knee] + _BACKWARDS])
            # An affine map that moves the skin moves these places by the same map.
            shares.append(np.linalg.pinv(np.c_[skin[own], np.ones(len(own))]).T @ np.c_[places, np.ones(3)].T)
            of_legs.append(own)
            bone = places[1] - places[0]
            off = np.linalg.norm(np.cross(skin[own] - places[0], bone), axis=1) / np.linalg.norm(bone)
            radii.append(off.mean() if len(own) else np.inf)  # without skin there is no tent
        self.radius = np.array(radii)
        """How far the skin of each lower leg is from its bone at rest, on average [m]."""
        name = str(self._device)
        self.data = data = kernels.ShinMeans()
        """The same as kernels read it."""
        data.start = ints(np.cumsum([0, *map(len, of_legs)]), name)
        data.vertex = ints(np.concatenate(of_legs), name)
        data.share = wp.array2d(np.concatenate(shares), dtype=wp.float32, device=name)
        data.radius = wp.array(self.radius, dtype=wp.float32, device=name)
        data.places = wp.zeros((kernels.N_LEGS, kernels.N_PLACES), dtype=wp.vec3, device=name)
        points = as_warp(self._vertices, wp.vec3)
        self._stand = recorded(kernels.stand_kernel, kernels.N_LEGS, [points, data], name)

    def update(self, body: Tensor) -> None:
        """Takes over a pose: vertices (V, 3) [m]."""
        self._vertices.copy_(body)
        with torch_stream(self._device):
            self._stand.launch()

    def behind(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """How far points (N, 3) [m] are behind each leg's bone at rest [m], shape (N, 2)."""
        far = []
        for knee, ankle in _BONES:
            start, bone = self._joints[knee], self._joints[ankle] - self._joints[knee]
            along = np.clip((points - start) @ bone / (bone @ bone), 0, 1)
            far.append((points - start - along[:, None] * bone) @ _BACKWARDS)
        return np.stack(far, 1)


class Tent:
    """Keeps cloth that hangs behind the legs at rest behind the shins in any pose (docs/architecture.md).

    The cloth moves backwards, out of a tent over each shin, by the shortest way out of both. It goes all the way where
    at rest it is farther behind the bone than the tent is wide; other cloth goes less far. In the rest pose none moves.
    """

    def __init__(self, garment: GarmentTemplate, shins: Shins) -> None:
        """For a garment on the body whose shins these are."""
        self._device = garment.v_template.device
        at_rest = shins.behind(garment.v_template.detach().cpu().double().numpy())
        # Cloth that hangs from both legs follows either in full.
        follows = np.minimum(2 * weight_of_parts(garment.weights, LEGS).cpu().numpy(), 1)
        weight = np.clip(at_rest / shins.radius, 0, 1) * follows
        (rows,) = np.nonzero(weight.max(1))
        name = str(self._device)
        hanging = kernels.Hanging()
        hanging.vertex = ints(rows, name)
        hanging.at_rest = wp.array2d(at_rest[rows], dtype=wp.float32, device=name)
        hanging.weight = wp.array2d(weight[rows], dtype=wp.float32, device=name)
        self._cloth = memory(*garment.v_template.shape, device=self._device)
        n_strips, each = strips(len(rows), self._device)
        inputs = [hanging, shins.data, int(each), as_warp(self._cloth, wp.vec3)]
        self._pitch = recorded(kernels.tent_kernel, n_strips, inputs, name)

    @torch.no_grad()
    def __call__(self, points: Tensor) -> Tensor:
        """The garment (N, 3) [m] brought out of the tents over the shins. Not differentiable."""
        self._cloth.copy_(points)
        with torch_stream(self._device):
            self._pitch.launch()
        moved: Tensor = self._cloth.clone()
        return moved
