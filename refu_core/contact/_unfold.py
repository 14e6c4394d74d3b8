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
        self._settings, self._device = settings, rest.device
        self._is_serial = rest.device.type == "cpu"
        cut, n = cut_of(garment.mesh, rest.device), garment.n_vertices
        self._points, self._other, self._turned, normals = torch.zeros(4, n, 3, device=rest.device)
        self._weight, self._wider, self._share = torch.zeros(3, n, device=rest.device)
        self._share.copy_(_share(garment, others, *settings.unfold_near))
        self._count = torch.zeros(1, dtype=torch.int32, device=rest.device)
        rows = wp.zeros(n, dtype=wp.int32, device=str(rest.device))
        points, other, turned = (as_warp(one, wp.vec3) for one in (self._points, self._other, self._turned))
        weight, wider, may = (as_warp(one, wp.float32) for one in (self._weight, self._wider, self._share))
        wp.launch(
            layers.normals_kernel, n, [as_warp(rest, wp.vec3), cut, as_warp(normals, wp.vec3)], device=str(rest.device)
        )
        # What a rotation of joint j adds to the normal of vertex v, for all j and axes: (V, 24 * 3).
        self._by_joint = (garment.weights.float()[:, :, None] * normals[:, None]).flatten(1)
        (flat, folded), fade = settings.unfold_cosines, settings.unfold_fade
        reach, rounds = settings.unfold_reach, settings.unfold_rounds
        count = as_warp(self._count, wp.int32)
        self._commands: dict[str, Any] = {}
        for name, kernel, size, arguments in (
            ("fold", kernels.fold_kernel, n, [points, turned, cut, flat, folded, may, weight, count]),
            ("widen0", kernels.widen_kernel, n, [weight, may, cut, fade, wider]),
            ("widen1", kernels.widen_kernel, n, [wider, may, cut, fade, weight]),
            ("level0", level_kernel, n, [points, weight, cut.ring_start, cut.ring, other]),
            ("level1", level_kernel, n, [other, weight, cut.ring_start, cut.ring, points]),
            (
                "unfold all",
                kernels.unfold_all_kernel,
                1,
                [may, cut, fade, reach, rounds, wider, rows, other, weight, points],
            ),
        ):
            self._commands[name] = wp.launch(kernel, size, arguments, device=str(rest.device), record_cmd=True)

    @torch.no_grad()
    def __call__(self, points: Tensor, rotation: Tensor) -> Tensor:
        """The garment (V, 3) [m], unfolded, of a body posed by `rotation`, shape (24, 3, 3), in the same axes.

        Vertices go no farther than any may. Not differentiable; a GPU isn't waited for.
        """
        with torch_stream(self._device):
            self._points.copy_(points)
            torch.mm(self._by_joint, rotation.float().transpose(1, 2).reshape(-1, 3), out=self._turned)
            self._count.zero_()
            self._commands["fold"].launch()
            if self._is_serial:
                if not int(self._count):
                    return points
                self._commands["unfold all"].launch()
            else:
                for k in range(self._settings.unfold_reach):
                    self._commands[f"widen{k % 2}"].launch()
                for k in range(self._settings.unfold_rounds):
                    self._commands[f"level{k % 2}"].launch()
        return points + torch.renorm(self._points - points, 2, 0, self._settings.max_displacement)


def _share(garment: GarmentTemplate, others: Sequence[GarmentTemplate], near: float, far: float) -> Tensor:
    """How much each vertex may give way, 0 to 1, shape (V,): by its distance from the `others` at rest."""
    meets = np.concatenate([one.v_template.detach().cpu().double().numpy() for one in others])
    distance = cKDTree(meets).query(garment.v_template.detach().cpu().double().numpy())[0]
    return torch.from_numpy(np.clip((far - distance) / (far - near), 0, 1)).float()
