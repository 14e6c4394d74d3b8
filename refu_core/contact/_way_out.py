"""Vertices that the winding number finds inside the body leave it."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Recorded, Repeated, Unpicklable, as_warp, memory, torch_stream
from refu_core.contact import _way_out_kernels as kernels
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.contact._sheet import Sheet
from refu_core.sdf import Winding


class WayOut(Unpicklable):
    """Takes vertices that are inside a posed body, by winding number, to the closest skin that is outside of it.

    Faces with an interior above them are covered by another part of the body, and don't count. As a face may be covered
    in part, a vertex that is still inside then goes to a vertex or face middle of the body that is known to be open.
    In most frames no vertex is inside, and the winding numbers are the only cost.
    """

    def __init__(self, skin: Sheet, *, settings: ContactSettings = DEFAULT_CONTACT) -> None:
        """For poses of this `skin`, on its device. Raises `MeshError` unless it is closed and consistently oriented."""
        self._skin, self._settings, self.device = skin, settings, skin.vertices.device
        self._is_serial = self.device.type == "cpu"
        self._winding = Winding(torch.as_tensor(skin.mesh.faces, device=self.device), skin.vertices)
        n_places = len(skin.vertices) + len(skin.mesh.faces)
        self._above = memory(n_places, 3, device=self.device)
        above, known = as_warp(self._above, wp.vec3), skin.data
        inputs = [settings.tolerance, known.points, known.cut, above]
        self._lift = Recorded(kernels.above_kernel, n_places, inputs, self.device)
        fixed = [known.tree, settings.max_displacement, known.points, known.cut.faces, above]
        kinds = (wp.int32, wp.vec3, wp.int32, wp.vec3, wp.vec3)
        self._nearest = [Repeated(kernels.nearest_kernel, kinds, [*fixed, of_samples]) for of_samples in (False, True)]

    @torch.no_grad()
    def __call__(self, points: Tensor, around: Tensor, margin: float) -> tuple[Tensor, Tensor]:
        """The points (N, 3) [m], those inside taken out where there is a way, and how many are still inside, shape ().

        A point that is taken out ends `margin` [m] off the skin, or less where that is inside again, and at most
        `max_displacement` away from `around` (N, 3) [m]. A GPU isn't waited for. Not differentiable.
        """
        winding = self._winding(points)
        n_inside = torch.count_nonzero(winding)
        if self._is_serial and not int(n_inside):
            return points, n_inside
        wanted = n_inside[None].int()
        above = self._winding_above(wanted)
        farthest, least = self._settings.max_displacement, self._settings.tolerance
        is_inside = winding != 0
        for of_samples in (False, True):
            foot, normal = self._nearest_skin(points, is_inside, above, of_samples=of_samples)
            has_skin = (normal != 0).any(1)
            for share in _SHARES:
                at = foot + max(share * margin, least) * normal
                at = around + torch.renorm(at - around, 2, 0, farthest)
                tried = torch.where((is_inside & has_skin)[:, None], at, points)
                is_in = self._winding(tried, wanted) != 0
                points = torch.where((is_inside & ~is_in)[:, None], tried, points)
                is_inside = is_inside & is_in
        return points, torch.count_nonzero(is_inside)

    @torch.no_grad()
    def open_skin(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The closest places on open skin (N, 3) [m] to those points (N, 3) [m] that are inside, and which points are.

        Points with none within `max_displacement` aren't among them.
        """
        is_inside = self._winding(points) != 0
        foot, normal = self._nearest_skin(points, is_inside, self._winding_above(), of_samples=False)
        return foot, is_inside & (normal != 0).any(1)

    def _winding_above(self, wanted: Tensor | None = None) -> Tensor:
        """The winding numbers above the samples of the skin: its vertices, and the middles of its faces."""
        self._skin.fit()
        with torch_stream(self.device):
            self._lift.launch()
        return self._winding(self._above, wanted)

    def _nearest_skin(
        self, points: Tensor, is_inside: Tensor, above: Tensor, *, of_samples: bool
    ) -> tuple[Tensor, Tensor]:
        """For the points that are inside, the closest place on open skin (N, 3) [m], and the normal there (N, 3).

        `above` is what `_winding_above` says of the samples; with `of_samples` only the samples themselves are taken.
        """
        foot, normal = points.new_zeros(2, len(points), 3)
        self._nearest[of_samples]((len(points),), above, points.contiguous(), is_inside.int(), foot, normal)
        return foot, normal


_SHARES = (1.0, 0.0)
"""Shares of the margin, tried one after another: in a crease there is less room."""
