"""Strain limiting: cloth that was torn apart is drawn together."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Recorded, Unpicklable, as_warp, memory, torch_stream
from refu_core.contact import _strain_kernels as kernels
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.contact._sheet import cut_of
from refu_core.mesh import Connectivity


class StrainLimit(Unpicklable):
    """Draws together the ends of edges that contact has made longer than a multiple of their rest length.

    Jacobi sweeps of position-based dynamics (Müller et al. 2007): edges pull by half of their excess length, and a
    vertex moves by the mean over its edges. The result is continuous in the vertices, and edges within the limit don't
    pull.
    """

    def __init__(
        self, mesh: Connectivity, device: torch.device, *, settings: ContactSettings = DEFAULT_CONTACT
    ) -> None:
        """For garments of this mesh."""
        self._settings, self._device = settings, device
        self._is_serial = device.type == "cpu"
        n = mesh.n_vertices
        self._rest, self._before, self._points, self._other = memory(4, n, 3, device=device)
        self._count = memory(1, dtype=torch.int32, device=device)
        net = kernels.Net()
        net.cut = cut_of(mesh, device)
        net.rest, net.before, net.points, net.other = (
            as_warp(one, wp.vec3) for one in (self._rest, self._before, self._points, self._other)
        )
        net.limit, net.count = settings.strain_limit, as_warp(self._count, wp.int32)
        net.rows, net.is_listed = (wp.zeros(n, dtype=wp.int32, device=str(device)) for _ in range(2))
        self._limit = Recorded(kernels.limit_kernel, 1, [net, settings.sweeps], device)
        self._sweeps = [
            Recorded(kernels.sweep_kernel, n, [net, *places], device)
            for places in ((net.points, net.other), (net.other, net.points))
        ]

    @torch.no_grad()
    def __call__(self, points: Tensor, before: Tensor, rest: Tensor) -> Tensor:
        """The garment (N, 3) [m] with no tear in it; on a CPU `points` itself if there was none.

        `before` (N, 3) [m] are its vertices before contact, `rest` (N, 3) [m] those of the wearer's garment at rest.
        """
        self._points.copy_(points)
        self._before.copy_(before)
        self._rest.copy_(rest)
        with torch_stream(self._device):
            if self._is_serial:
                self._count.zero_()
                self._limit.launch()
                if not int(self._count):
                    return points
            else:
                for sweep in range(self._settings.sweeps):
                    self._sweeps[sweep % 2].launch()
        limited: Tensor = self._points.clone()
        return limited
