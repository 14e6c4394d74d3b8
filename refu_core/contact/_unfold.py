"""Levels cloth that was predicted folded over itself, before anything is worn over it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core._warp import Recorded, Unpicklable, as_warp, memory, readable, torch_stream
from refu_core.body import PARENTS, JointWeights
from refu_core.contact import _layers_kernels as layers
from refu_core.contact import _unfold_kernels as kernels
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.contact._sheet import cut_of
from refu_core.garments import GarmentTemplate


class Unfold(Unpicklable):
    """Levels one garment where it has folded over: such a sheet has no outer side to bring another one to.

    Which way cloth faces without its folds is known: its normal at rest, turned as skinning turns the vertex. The
    farther the normal is from that, the more a vertex gives way to its neighbours, and vertices around it less and
    less. All of this is continuous, and cloth that faces the way it should isn't touched.
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
        self._points, self._other, self._origin, normals = memory(4, n, 3, device=device)
        self._rotation = memory(len(PARENTS), 3, 3, device=device)
        self._count = memory(1, dtype=torch.int32, device=device)
        self._read_count = readable(self._count)
        fold = kernels.Fold()
        fold.points, fold.leveller, fold.origin, fold.normal = (
            as_warp(one, wp.vec3) for one in (self._points, self._other, self._origin, normals)
        )
        fold.rotation, fold.count = as_warp(self._rotation, wp.mat33), as_warp(self._count, wp.int32)
        fold.cut = cut = cut_of(garment.mesh, device)
        wp.launch(layers.normals_kernel, n, [as_warp(rest, wp.vec3), cut, fold.normal], device=str(device))
        share = _share(garment, others, settings.max_displacement).to(device)
        may = torch.nonzero(share)[:, 0].int()
        fold.share, fold.may = as_warp(share, wp.float32), as_warp(may, wp.int32)
        start, joint, of_joint = JointWeights.of(garment.weights)
        fold.start, fold.joint = as_warp(start, wp.int32), as_warp(joint, wp.int32)
        fold.weight_of_joint = as_warp(of_joint, wp.float32)
        fold.rows, fold.is_listed = (wp.zeros(n, dtype=wp.int32, device=str(device)) for _ in range(2))
        fold.weight, fold.wider = (wp.zeros(n, dtype=wp.float32, device=str(device)) for _ in range(2))
        fade, rounds, farthest = settings.fade, settings.levellings, settings.max_displacement
        n_strips, each = (1, len(may)) if self._is_serial else (len(may), 1)
        launches: dict[str, tuple[Any, int, list[Any]]] = {
            "fold": (kernels.fold_kernel, n_strips, [each, fold, settings.alike]),
            "widen0": (kernels.widen_kernel, n, [fold.weight, fold.share, cut, fade, fold.wider]),
            "widen1": (kernels.widen_kernel, n, [fold.wider, fold.share, cut, fade, fold.weight]),
            "level0": (kernels.level_kernel, n, [fold.points, fold.weight, cut, fold.leveller]),
            "level1": (kernels.level_kernel, n, [fold.leveller, fold.weight, cut, fold.points]),
            "bound": (kernels.bound_kernel, n, [fold, farthest]),
            "unfold all": (kernels.unfold_all_kernel, 1, [fold, fade, settings.around, rounds, farthest]),
        }
        self._commands = {name: Recorded(*launch, device) for name, launch in launches.items()}

    @torch.no_grad()
    def __call__(self, points: Tensor, rotation: Tensor) -> Tensor:
        """The garment (V, 3) [m], unfolded, of a body posed by `rotation`, shape (24, 3, 3), in the same axes."""
        with torch_stream(self._device):
            self._points.copy_(points)
            self._rotation.copy_(rotation)
            self._count.zero_()
            self._commands["fold"].launch()
            if self._is_serial:
                if not self._read_count[0]:
                    return points
                self._commands["unfold all"].launch()
            else:
                self._origin.copy_(points)
                for k in range(self._settings.around):
                    self._commands[f"widen{k % 2}"].launch()
                for k in range(self._settings.levellings):
                    self._commands[f"level{k % 2}"].launch()
                self._commands["bound"].launch()
        unfolded: Tensor = self._points.clone()
        return unfolded


def _share(garment: GarmentTemplate, others: Sequence[GarmentTemplate], near: float) -> Tensor:
    """How much each vertex may give way, shape (V,): 1 within `near` [m] of the `others` at rest, 0 twice as far."""
    meets = np.concatenate([one.v_template.detach().cpu().double().numpy() for one in others])
    distance = cKDTree(meets).query(garment.v_template.detach().cpu().double().numpy())[0]
    return torch.from_numpy(np.clip(2 - distance / near, 0, 1)).float()
