"""Which face of the body a garment's vertex is near before it is posed: where `ApproxSdf` begins its walk."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt
from torch import Tensor

from refu_core._warp import Repeated, ints
from refu_core.body import SmplBody
from refu_core.sdf._exact import ExactSdf
from refu_core.sdf._walk_kernels import grid_lookup_kernel

_CELL = 0.015
"""Edge of the grid's cells [m]: less than the body's longer edges, so a look-up is mostly off by one face at most."""
_BAND = 2
"""Cells around the skin whose closest face is computed; those farther out take that of the nearest such cell."""
_ROOM = 0.1
"""How far the grid reaches beyond the body [m]; places outside of it are looked up at its border."""


class RestFaces:
    """A grid over the rest pose that names a near body face; built in two tenths of a second, and remembered.

    The face need not be the closest, so one grid of the mean shape does for all shapes. For a garment vertex
    t(β, γ) + D it needs the place on the mean shape, without what `GarmentTemplate.rest` adds for β:

        near = rest_faces.under(unposed, betas, garment.shapedirs)
        sample = approx_sdf.query(posed, near=near)
    """

    def __init__(self, body: SmplBody) -> None:
        """Around the mean shape of `body`, on its device."""
        low, face = _grid_of(body)
        self._device = torch.device(body.device)
        fixed = [wp.vec3(*low), _CELL, ints(face, self._device)]
        self._look_up = Repeated(grid_lookup_kernel, (wp.vec3, wp.int32), fixed)

    def under(self, unposed: Tensor, betas: Tensor, shapedirs: Tensor) -> Tensor:
        """Near body faces, int32 of shape (B, V), of unposed garments [m], shape (B, V, 3), on shapes (B, 10).

        `shapedirs` (V * 3, 10) is how the garment follows β, so it also takes the garment back to the mean shape.
        """
        return self(unposed - (betas @ shapedirs.T).view_as(unposed))

    def __call__(self, unposed: Tensor) -> Tensor:
        """Near body faces, int32 of shape (...,), of places on the mean shape in the rest pose [m], shape (..., 3)."""
        places = unposed.detach().to(device=self._device, dtype=torch.float32).reshape(-1, 3).contiguous()
        near = torch.empty(len(places), dtype=torch.int32, device=self._device)
        self._look_up((len(places),), places, near)
        return near.view(unposed.shape[:-1])


@lru_cache(maxsize=3)  # every pipeline of one body asks for the same
def _grid_of(body: SmplBody) -> tuple[list[float], NDArray[np.int32]]:
    """Least corner [m], and a near face of each cell by y, x and z: successive vertices are mostly about as high."""
    exact = ExactSdf(body.faces, device=body.device)
    exact.update(body.v_template.float())
    rest, faces = body.v_template.float().cpu(), body.faces.cpu()
    low, high = rest.amin(0) - _ROOM, rest.amax(0) + _ROOM
    shape = ((high - low) / _CELL).ceil().int().tolist()
    middles = rest[faces].mean(1)
    on_skin = np.zeros(shape, np.bool_)
    on_skin[tuple(((middles - low) / _CELL).long().numpy().T)] = True
    band = binary_dilation(on_skin, np.ones((3, 3, 3), np.bool_), iterations=_BAND)
    centres = low + (torch.from_numpy(np.argwhere(band)) + 0.5).float() * _CELL
    face = np.zeros(shape, np.int32)
    face[band] = exact.closest(centres).face.cpu().numpy()
    nearest = distance_transform_edt(~band, return_distances=False, return_indices=True)
    return low.tolist(), np.ascontiguousarray(face[tuple(nearest)].swapaxes(0, 1))
