"""Cloth that is predicted deep inside the body: it goes where the cloth around it is."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.contact._level_kernels import level_kernel, level_rows_kernel
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
        self._rows = torch.zeros(n_vertices, dtype=torch.int32, device=faces.device)
        points, other = as_warp(self._points, wp.vec3), as_warp(self._other, wp.vec3)
        weight = as_warp(self._weight, wp.float32)
        self._rounds = [
            wp.launch(level_kernel, n_vertices, [source, weight, ring_start, ring, end], device=device, record_cmd=True)
            for source, end in ((points, other), (other, points))
        ]

        rows = as_warp(self._rows, wp.int32)
        inputs = [settings.sunken_rounds, 0, rows, points, weight, ring_start, ring, other]
        self._serial = wp.launch(level_rows_kernel, 1, inputs, device=device, record_cmd=True)

    @torch.no_grad()
    def __call__(self, points: Tensor, distance: Tensor) -> tuple[Tensor, Tensor | None]:
        """Vertices (N, 3) [m] levelled, whose signed `distance` to the body is (N,) [m]; not differentiable.

        And which were, (K,), where that is known: a GPU isn't waited for. Where none is, they are the same tensor.
        """
        begin, end = self._settings.sunken
        weight = ((-begin - distance) / (end - begin)).clamp(0, 1)
        self._weight.copy_(weight)
        self._points.copy_(points)
        if self._is_serial:
            rows = torch.nonzero(weight)[:, 0]
            if not len(rows):
                return points, rows
            self._other.copy_(points)
            self._rows[: len(rows)] = rows
            self._serial.set_param_at_index(_N_ROWS, len(rows))
            self._serial.launch()
            return self._points.clone(), rows
        with torch_stream(self._device):
            for k in range(self._settings.sunken_rounds):
                self._rounds[k % 2].launch()
        return self._points.clone(), None


_N_ROWS = 1
"""Which of the kernel's inputs says how many they are."""
