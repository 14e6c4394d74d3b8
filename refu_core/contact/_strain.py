"""Strain limiting: cloth that was torn apart is drawn together."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Repeated, Unpicklable, as_warp, memory, readable
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
        self._settings, self._n_vertices = settings, mesh.n_vertices
        self._is_serial = device.type == "cpu"
        self._count = memory(1, dtype=torch.int32, device=device)
        self._read_count = readable(self._count)
        net = kernels.Net()
        net.cut = cut_of(mesh, device)
        net.other = wp.zeros(mesh.n_vertices, dtype=wp.vec3, device=str(device))
        net.limit, net.count = settings.strain_limit, as_warp(self._count, wp.int32)
        net.rows, net.is_listed = (wp.zeros(mesh.n_vertices, dtype=wp.int32, device=str(device)) for _ in range(2))
        self._limit = Repeated(kernels.limit_kernel, [wp.vec3] * 4, [net, settings.sweeps])
        self._sweep = Repeated(kernels.sweep_kernel, [wp.vec3] * 4, [net])

    @torch.no_grad()
    def __call__(self, points: Tensor, before: Tensor, rest: Tensor) -> Tensor:
        """The garment (N, 3) [m] with no tear in it; on a CPU `points` itself if there was none.

        `before` (N, 3) [m] are its vertices before contact, `rest` (N, 3) [m] those of the wearer's garment at rest.
        """
        given, before, rest = (one.contiguous() for one in (points, before, rest))
        if self._is_serial:
            limited = torch.empty_like(given)
            self._limit((1,), given, before, rest, limited)
            return limited if self._read_count[0] else points
        for _ in range(self._settings.sweeps):
            limited = torch.empty_like(given)
            self._sweep((self._n_vertices,), given, before, rest, limited)
            given = limited
        return given
