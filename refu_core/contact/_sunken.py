"""Cloth that is predicted deep inside the body: it goes where the cloth around it is."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.contact._level_kernels import level_kernel
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.mesh import Connectivity


class Sunken:
    """Levels what of one garment is deep inside the body, before it is pushed out.

    A vertex that is centimetres inside has several ways out, and which of them is shortest changes from frame to frame
    and from neighbour to neighbour: in a squat a hem is torn between belly and thigh. What is that deep says little of
    where cloth is. So it goes to the middle of the cloth around it, the more the deeper it is, again and again: what is
    not deep keeps its place, and the rest hangs between.
    """

    def __init__(self, faces: Tensor, n_vertices: int, *, settings: ContactSettings = DEFAULT_CONTACT) -> None:
        """For garments of these `faces`, shape (G, 3), and `n_vertices` N, on the device of the faces."""
        self._settings, self._device = settings, faces.device
        self._is_serial = faces.device.type == "cpu"
        device = str(faces.device)
        ring_start, ring = (
            wp.array(items.astype(np.int32), dtype=wp.int32, device=device)
            for items in Connectivity.of(faces.cpu(), n_vertices).ring
        )
        self._points = torch.zeros(n_vertices, 3, device=faces.device)
        self._other = torch.zeros_like(self._points)
        self._weight = torch.zeros(n_vertices, device=faces.device)
        points, other = as_warp(self._points, wp.vec3), as_warp(self._other, wp.vec3)
        weight = as_warp(self._weight, wp.float32)
        self._rounds = [
            wp.launch(level_kernel, n_vertices, [source, weight, ring_start, ring, end], device=device, record_cmd=True)
            for source, end in ((points, other), (other, points))
        ]

    @torch.no_grad()
    def __call__(self, points: Tensor, distance: Tensor) -> Tensor:
        """Vertices (N, 3) [m] levelled, whose signed `distance` to the body is (N,) [m]; not differentiable.

        On a CPU they are the same tensor where none is deep.
        """
        begin, end = self._settings.sunken
        weight = ((-begin - distance) / (end - begin)).clamp(0, 1)
        if self._is_serial and not bool(weight.any()):
            return points
        with torch_stream(self._device):
            self._weight.copy_(weight)
            self._points.copy_(points)
            for k in range(self._settings.sunken_rounds):
                self._rounds[k % 2].launch()
        return self._points.clone()
