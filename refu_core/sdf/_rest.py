"""Which face of the body a garment's vertex is near before it is posed: where `ApproxSdf` begins its walk."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp
from scipy.ndimage import binary_dilation, distance_transform_edt
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._walk_kernels import grid_lookup_kernel

if TYPE_CHECKING:
    from refu_core.body import SmplBody

_CELL = 0.015
"""Edge of the grid's cells [m]: less than the body's longer edges, so a look-up is mostly no face off, or one."""
_BAND = 2
"""Cells around the skin whose closest face is asked for; those farther out take that of the nearest such cell."""
_BLOCK = 4
"""Cells of a block's edge, as `grid_lookup_kernel` has it."""
_ROOM = 0.1
"""How far the grid reaches beyond the body [m]; places outside of it are looked up at its border."""


class RestFaces:
    """A grid over the rest pose that names a near body face, built once a body in three tenths of a second.

    The face need not be the closest, so one grid of the mean shape does for all shapes. Of a garment vertex t(β, γ) +
    D it wants the place on the mean shape, without what `GarmentTemplate.rest` adds for β:

        near = rest_faces.under(unposed, betas, garment.shapedirs)
        sample = approx_sdf.query(posed, near=near)
    """

    def __init__(self, body: SmplBody) -> None:
        """Asks for the closest faces around the mean shape of `body`, on its device."""
        exact = ExactSdf(body.faces, device=body.device)
        exact.update(body.v_template.float())
        low = body.v_template.float().amin(0).cpu() - _ROOM
        high = body.v_template.float().amax(0).cpu() + _ROOM
        blocks = ((high - low) / (_BLOCK * _CELL)).ceil().int()
        shape = _BLOCK * blocks
        middles = body.v_template.float()[body.faces].mean(1).cpu()
        on_skin = np.zeros(shape.tolist(), np.bool_)
        on_skin[tuple(((middles - low) / _CELL).long().numpy().T)] = True
        band = binary_dilation(on_skin, np.ones((3, 3, 3), np.bool_), iterations=_BAND)
        centres = low + (torch.from_numpy(np.argwhere(band)) + 0.5).float() * _CELL
        face = np.zeros(shape.tolist(), np.int32)
        face[band] = exact.closest(centres).face.cpu().numpy()
        nearest = distance_transform_edt(~band, return_distances=False, return_indices=True)
        self._device = torch.device(body.device)
        self._low = wp.vec3(*low.tolist())
        self._shape = wp.vec3i(*shape.tolist())
        by_block = face[tuple(nearest)].reshape([n for count in blocks.tolist() for n in (count, _BLOCK)])
        rows = by_block.transpose(0, 2, 4, 1, 3, 5).reshape(-1, _BLOCK**3)
        self._grid = wp.array(rows, dtype=wp.int32, device=str(self._device))
        self._dim = 0
        self._make_room(1024)

    def under(self, unposed: Tensor, betas: Tensor, shapedirs: Tensor) -> Tensor:
        """Near body faces, int32 of shape (B, V), of unposed garments [m], shape (B, V, 3), on shapes (B, 10).

        `shapedirs` (V * 3, 10) is how the garment follows β, so what takes it back to the mean shape.
        """
        return self(unposed - (betas @ shapedirs.T).view_as(unposed))

    def __call__(self, unposed: Tensor) -> Tensor:
        """Near body faces, int32 of shape (...,), of places on the mean shape in the rest pose [m], shape (..., 3)."""
        places = unposed.detach().to(device=self._device, dtype=torch.float32).reshape(-1, 3)
        n = len(places)
        # On a GPU always anew: a CUDA graph may go on using the last room.
        if n > len(self._places) or self._device.type != "cpu":
            self._make_room(n)
        self._places[:n] = places
        if n:
            if n != self._dim:
                self._look_up.set_dim(n)
                self._dim = n
            with torch_stream(self._device):
                self._look_up.launch()
        return self._near[:n].clone().view(unposed.shape[:-1])

    def _make_room(self, n: int) -> None:
        """For n places. The launch is recorded: making it in Python takes longer than the look-ups."""
        self._dim = n
        self._places = torch.empty(n, 3, device=self._device)
        self._near = torch.empty(n, dtype=torch.int32, device=self._device)
        self._look_up = wp.launch(
            grid_lookup_kernel,
            dim=n,
            inputs=[as_warp(self._places, wp.vec3), self._low, _CELL, self._shape, self._grid],
            outputs=[as_warp(self._near, wp.int32)],
            device=str(self._device),
            record_cmd=True,
        )
