"""From a network's output, a code, to displacements of all vertices: densely as in the paper, or through a basis."""

from __future__ import annotations

from collections.abc import Mapping

import torch
import warp as wp
from torch import Tensor, nn
from torch.nn import functional

from refu_core._warp import argument, is_plain
from refu_core.backbones._decode_kernels import ROWS, WIDTH, Strip, decode_kernel
from refu_core.errors import WeightsError
from refu_core.garments import GarmentTemplate

_A_FEW = 16
"""From more codes on, a product of matrices is the faster way."""


class DenseDecoder(nn.Module):
    """The code is the displacements themselves (preset `paper`)."""

    def __init__(self, n_vertices: int) -> None:
        super().__init__()
        self.n_vertices = n_vertices
        self.size = 3 * n_vertices
        """Width of a code."""

    def forward(self, code: Tensor) -> Tensor:
        """Displacements [m], shape (B, V, 3), of codes (B, 3 V)."""
        return code.view(len(code), -1, 3)

    def encode(self, displacement: Tensor) -> Tensor:
        """Codes, shape (B, 3 V), of displacements (B, V, 3) [m]."""
        return displacement.flatten(1)

    def directions(self, garment: GarmentTemplate) -> Tensor:
        """What a unit of each of (β, γ) does to the template, in codes [m], shape (14, 3 V)."""
        return _template_directions(garment)


class BasisDecoder(nn.Module):
    """The code is in an orthonormal basis of displacements (preset `realtime`): a head of R columns, not of 3 V.

    All networks of a garment share the basis, so it is stored once, in half precision, and the product with it, most
    of what a frame costs, is made once for the sum of all networks. Distances between codes are distances between
    garments: |code - code'|² = Σ_v |D_v - D'_v|², up to rounding.
    """

    def __init__(self, mean: Tensor, components: Tensor) -> None:
        """`mean` [m], shape (V, 3), and orthonormal rows `components`, shape (R, 3 V)."""
        super().__init__()
        if components.ndim != 2 or components.shape[1] != mean.numel():
            msg = f"wanted a basis of (R, {mean.numel()}), got {tuple(components.shape)}: get them again"
            raise WeightsError(msg)
        self.n_vertices = len(mean)
        self.size = len(components)
        """Width R of a code."""
        # What is computed with is what is stored, or codes wouldn't mean the same before and after.
        self.register_buffer("mean", mean.half().float().flatten())
        self.register_buffer("components", components.half().float().contiguous())
        self.mean: Tensor
        self.components: Tensor
        self._strips: _Strips | None = None

    def forward(self, code: Tensor) -> Tensor:
        """Displacements [m], shape (B, V, 3), of codes (B, R)."""
        if 1 < len(code) <= _A_FEW and code.device.type == "cpu" and is_plain(code, self.components):
            if self._strips is None or not self._strips.is_of(self.components):
                self._strips = _Strips(self.mean, self.components)
            return self._strips(code)
        return torch.addmm(self.mean, code, self.components).view(len(code), -1, 3)

    def encode(self, displacement: Tensor) -> Tensor:
        """Codes, shape (B, R), of the displacements nearest to `displacement` (B, V, 3) [m]."""
        return (displacement.flatten(1) - self.mean) @ self.components.T

    def directions(self, garment: GarmentTemplate) -> Tensor:
        """What a unit of each of (β, γ) does to the template, isometrically to the vertices [m], shape (14, R + 14).

        The first R columns are in the basis, the others in an orthonormal basis of what lies outside of it.
        """
        whole = _template_directions(garment)
        inside = whole @ self.components.T
        outside = torch.linalg.qr((whole - inside @ self.components).T).R.T
        return torch.cat((inside, outside), 1)

    def tensors(self) -> Mapping[str, Tensor]:
        """What a basis file holds."""
        return {"mean": self.mean.view(-1, 3).half(), "components": self.components.half()}


class _Strips:
    """A basis in strips of some columns, each in one piece of memory: for the codes of a few persons, on a CPU.

    The basis is then read once for all of them, and the product takes hardly longer than that of one.
    """

    def __init__(self, mean: Tensor, components: Tensor) -> None:
        self._of, self._version = components, components._version
        self._n = components.shape[1]
        room = (0, -self._n % WIDTH)
        strips = functional.pad(components, room).view(len(components), -1, WIDTH).transpose(0, 1).contiguous()
        # Warp's arrays keep the tensors that they are made of.
        self._basis = wp.from_torch(strips, dtype=Strip)
        self._mean = wp.from_torch(functional.pad(mean, room).view(-1, WIDTH), dtype=Strip)

    def __call__(self, code: Tensor) -> Tensor:
        """Displacements, shape (B, V, 3), of codes (B, R)."""
        padded = functional.pad(code, (0, 0, 0, -len(code) % int(ROWS))).contiguous()
        decoded = torch.empty(len(padded), len(self._mean), WIDTH)
        wp.launch(
            decode_kernel,
            len(self._mean),
            [argument(padded, wp.float32), self._basis, self._mean],
            [argument(decoded, Strip)],
            device="cpu",
        )
        return decoded.flatten(1)[: len(code), : self._n].view(len(code), -1, 3)

    def is_of(self, components: Tensor) -> bool:
        """Whether these are the strips of `components`, as they are now."""
        return self._of is components and self._version == components._version


Decoder = DenseDecoder | BasisDecoder


def _template_directions(garment: GarmentTemplate) -> Tensor:
    styledirs = garment.styledirs
    if styledirs is None:
        styledirs = garment.shapedirs.new_zeros(len(garment.shapedirs), 4)
    return torch.cat((garment.shapedirs, styledirs), 1).T.contiguous()
