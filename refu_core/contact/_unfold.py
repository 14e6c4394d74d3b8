"""Cloth that was predicted folded over itself, levelled before anything is worn over it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.body import PARENTS, JointWeights
from refu_core.contact import _layers_kernels as layers
from refu_core.contact import _unfold_kernels as kernels
from refu_core.contact._level_kernels import level_kernel
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.contact._sheet import cut_of
from refu_core.garments import GarmentTemplate


class Unfold:
    """Levels one garment where it has folded over.

    In a deep squat the shorts are predicted with a bulge at the crotch that overhangs, and in the crease of the hip
    both sides of the fold run through each other. Such a sheet has no outer side that another one could be brought to.

    Where cloth faces is known without its folds: its normal at rest, turned as skinning turns the vertex. The farther
    the normal has left that, the more a vertex gives way to its neighbours, and these less and less around it. All of
    it is continuous, and cloth that faces where it should isn't touched.
    """

    def __init__(
        self,
        garment: GarmentTemplate,
        others: Sequence[GarmentTemplate],
        *,
        settings: ContactSettings = DEFAULT_CONTACT,
    ) -> None:
        """For a garment that is worn with the `others`, on its device."""
        rest = garment.v_template.detach().float().contiguous()
        device, n = rest.device, garment.n_vertices
        self._settings, self._device = settings, device
        self._is_serial = device.type == "cpu"
        self._points, self._other, self._origin, normals = torch.zeros(4, n, 3, device=device)
        self._weight, self._wider = torch.zeros(2, n, device=device)
        self._rotation = torch.zeros(len(PARENTS), 3, 3, device=device)
        self._count = torch.zeros(1, dtype=torch.int32, device=device)
        points, other, origin, upward = (
            as_warp(one, wp.vec3) for one in (self._points, self._other, self._origin, normals)
        )
        weight, wider = as_warp(self._weight, wp.float32), as_warp(self._wider, wp.float32)
        share = _share(garment, others, settings.layer_meets).to(device)
        may = torch.nonzero(share)[:, 0].int()
        self._kept = upright, cut = kernels.Upright(), cut_of(garment.mesh, device)  # launches know addresses
        wp.launch(layers.normals_kernel, n, [as_warp(rest, wp.vec3), cut, upward], device=str(device))
        upright.normal, upright.share, upright.may = upward, as_warp(share, wp.float32), as_warp(may, wp.int32)
        start, joint, of_joint = JointWeights.of(garment.weights)
        upright.start, upright.joint = as_warp(start, wp.int32), as_warp(joint, wp.int32)
        upright.weight = as_warp(of_joint, wp.float32)
        rows, is_listed = (wp.zeros(n, dtype=wp.int32, device=str(device)) for _ in range(2))
        (flat, folded), fade, farthest = settings.unfold_cosines, settings.unfold_fade, settings.max_displacement
        n_strips, each = (1, len(may)) if self._is_serial else (len(may), 1)
        told = [points, as_warp(self._rotation, wp.mat33), cut, upright, flat, folded]
        listed = [rows, as_warp(self._count, wp.int32)]
        widening = [upright.share, cut, fade]
        self._commands: dict[str, Any] = {}
        for name, kernel, size, arguments in (
            ("fold", kernels.fold_kernel, n_strips, [each, *told, weight, *listed]),
            ("widen0", kernels.widen_kernel, n, [weight, *widening, wider]),
            ("widen1", kernels.widen_kernel, n, [wider, *widening, weight]),
            ("level0", level_kernel, n, [points, weight, cut.ring_start, cut.ring, other]),
            ("level1", level_kernel, n, [other, weight, cut.ring_start, cut.ring, points]),
            ("bound", kernels.bound_kernel, n, [origin, farthest, points]),
            (
                "unfold all",
                kernels.unfold_all_kernel,
                1,
                [
                    *(*widening, settings.around, settings.unfold_rounds, farthest),
                    *(*listed, is_listed, wider, origin, other, weight, points),
                ],
            ),
        ):
            self._commands[name] = wp.launch(kernel, size, arguments, device=str(device), record_cmd=True)

    @torch.no_grad()
    def __call__(self, points: Tensor, rotation: Tensor) -> Tensor:
        """The garment (V, 3) [m], unfolded, of a body posed by `rotation`, shape (24, 3, 3), in the same axes.

        Vertices go no farther than any may. Not differentiable; a GPU isn't waited for.
        """
        with torch_stream(self._device):
            self._points.copy_(points)
            self._rotation.copy_(rotation)
            self._count.zero_()
            self._commands["fold"].launch()
            if self._is_serial:
                if not int(self._count):
                    return points
                self._commands["unfold all"].launch()
            else:
                self._origin.copy_(points)
                for k in range(self._settings.around):
                    self._commands[f"widen{k % 2}"].launch()
                for k in range(self._settings.unfold_rounds):
                    self._commands[f"level{k % 2}"].launch()
                self._commands["bound"].launch()
        unfolded: Tensor = self._points.clone()
        return unfolded


def _share(garment: GarmentTemplate, others: Sequence[GarmentTemplate], near: float) -> Tensor:
    """How much each vertex may give way, shape (V,): up to `near` [m] from the `others` at rest 1, twice as far 0."""
    meets = np.concatenate([one.v_template.detach().cpu().double().numpy() for one in others])
    distance = cKDTree(meets).query(garment.v_template.detach().cpu().double().numpy())[0]
    return torch.from_numpy(np.clip(2 - distance / near, 0, 1)).float()
