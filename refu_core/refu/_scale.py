"""The learned moving offset: networks h, k and g that predict how far each pushed vertex goes (paper, Eq. 5, 6)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
import warp as wp
from torch import Tensor, nn
from torch.nn import functional

from refu_core._warp import Repeated, is_plain
from refu_core.body import require_batch, rotvec_to_rotmat, up_in
from refu_core.frames import N_BETAS, N_JOINTS, N_STYLES
from refu_core.refu._scale_kernels import scale_inputs_kernel

ScaleKind = Literal["vertex", "shared", "distance"]
VertexScale = Callable[[Tensor, Tensor], Tensor]
"""α of some vertices of one body, (R,), from their indices (R,) and their signed distances [m] (R,)."""

N_INPUTS = N_BETAS + 3 * (N_JOINTS - 1) + 3 + N_STYLES
"""Inputs of h: β, the pose without the root, the up direction in the root's frame, γ."""
_DISTANCE_UNIT = 0.01
"""g reads distances in cm, so that they are about as large as the latent vector that it reads with them."""
_SHARPNESS = 20.0
"""Of the softplus that keeps α in its range. α starts at 1.03 (least 1) or 1.00 (least 0), with a steep derivative."""
_MAX_SCALE = 100.0  # greatest α


@dataclass(frozen=True)
class ScaleSettings:
    """Sizes of the networks; the presets `PAPER` and `REALTIME` are the two that are meant to be used."""

    kind: ScaleKind = "vertex"
    """`vertex` is α = g(k(z)_i, f), the paper's choice; `shared` g(k'(z), f) with as many weights ("Alt. 1" of the
    supplement's Sec. E); `distance` g'(f) ("Alt. 2")."""
    feature_size: int = 64
    """M, size of the garment's global feature z."""
    hidden_size: int = 128
    """Width of h's two hidden layers."""
    latent_size: int = 10
    """D, size of a vertex's latent vector, and the width of g's hidden layer."""
    is_compact: bool = True
    """Whether k is a product of an embedding of the vertex (N, D) and a projection of z (D), instead of one dense layer
    (M to N · D) of 10 million weights for a thousand vertices."""


PAPER = ScaleSettings(feature_size=1024, hidden_size=1024, latent_size=10, is_compact=False)
"""Exactly the paper's (Sec. 4.2): h of three layers of 1024, k of one of N × 10, g of two of 10; ReLU."""
REALTIME = ScaleSettings()
"""For a CPU in real time: about 115,000 weights for a T-shirt instead of 80 million."""
SCALE_PRESETS: dict[str, ScaleSettings] = {"paper": PAPER, "realtime": REALTIME}


class ScaleNet(nn.Module):
    """α_i = g(k(z)_i, f(x_i)) for z = h(β, θ, γ) (Eq. 5, 6).

    k and g are evaluated only for the vertices asked for: in a frame those are the pushed ones, a tenth of the garment.
    An untrained network gives α ≈ 1 everywhere, the paper's fixed scale.
    """

    def __init__(self, n_vertices: int, *, least: float, settings: ScaleSettings = REALTIME) -> None:
        """Networks for garments of `n_vertices` N.

        `least` is the lower end of α's range: 1 with an accurate distance, so that no pushed vertex stays inside; 0
        with an approximate one, which may have to be corrected downwards.
        """
        super().__init__()
        self.n_vertices, self.least, self.settings = n_vertices, least, settings
        m, d = settings.feature_size, settings.latent_size
        if settings.kind != "distance":
            sizes = (N_INPUTS, settings.hidden_size, settings.hidden_size, m)
            # Numbered as in files of weights, where ReLU counts as a layer.
            self.h = nn.ModuleDict({str(2 * i): nn.Linear(a, b) for i, (a, b) in enumerate(pairwise(sizes))})
        if settings.kind == "vertex":
            latent = d
            self.k: nn.Module = (
                _CompactLatent(m, n_vertices, d) if settings.is_compact else _DenseLatent(m, n_vertices, d)
            )
        elif settings.kind == "shared":  # so that k' and g have as many weights as k and g of the kind `vertex`
            k = n_vertices * d + (m + 1) * d if settings.is_compact else n_vertices * d * (m + 1)
            latent = max(1, round((k + d * d) / (m + 1 + d)))
            self.k = nn.Linear(m, latent)
        else:
            latent = 0
        last = nn.Linear(d, 1)
        # Zeros, so that training starts from the fixed scale and departs from it only as far as that helps.
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.g = nn.Sequential(nn.Linear(latent + 1, d), nn.ReLU(), last)

    def feature(self, betas: Tensor, pose: Tensor, style: Tensor | None) -> Tensor:
        """z, shape (B, M), of betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4), (1, 4) or None.

        Raises `FrameError` for anything but tensors of these shapes.
        """
        if self.settings.kind == "distance":
            return betas[:, :0]
        z = scale_inputs(betas, pose, style)
        for layer in self.h.values():
            z = functional.relu(layer(z))
        return z

    def forward(self, z: Tensor, body: Tensor, vertex: Tensor, distance: Tensor) -> Tensor:
        """α, shape (R,), of vertices number `vertex` (R,) of bodies number `body` (R,) with features z (B, M).

        `distance` is their signed distance f [m], shape (R,). Differentiable with respect to z, f and the weights.
        """
        f = distance[:, None] / _DISTANCE_UNIT
        if self.settings.kind == "vertex":
            inputs = torch.cat((self.k(z, body, vertex), f), dim=1)
        elif self.settings.kind == "shared":
            inputs = torch.cat((self.k(z)[body], f), dim=1)
        else:
            inputs = f
        return self._in_range(self.g(inputs)[:, 0])

    def _in_range(self, raw: Tensor) -> Tensor:
        """α from g's output `raw`, near 1 where that is near 0."""
        # A pose far beyond training may overflow the networks; α = 1 is right to first order.
        usual = 1 - self.least
        bounded = torch.nan_to_num(raw + usual, nan=usual, posinf=_MAX_SCALE, neginf=-_MAX_SCALE)
        return self.least + functional.softplus(bounded, beta=_SHARPNESS).clamp_max(_MAX_SCALE)

    def of_body(self, z: Tensor) -> VertexScale:
        """α as `Resolver` asks for it, for the one body whose feature is z, shape (M,) or (1, M)."""
        row = z.reshape(1, -1)
        k = self.k if self.settings.kind == "vertex" else None
        if not isinstance(k, _CompactLatent):
            return lambda vertex, distance: self(row, torch.zeros_like(vertex), vertex, distance)
        # Takes half the time: z's factor of a compact k is folded into g's first layer, once per body.
        first, _, last = self.g
        assert isinstance(first, nn.Linear)
        assert isinstance(last, nn.Linear)
        of_latent, of_distance = first.weight[:, :-1] * k.projection(row), first.weight[:, -1] / _DISTANCE_UNIT

        def scale(vertex: Tensor, distance: Tensor) -> Tensor:
            hidden = torch.addmm(first.bias, k.embedding.index_select(0, vertex), of_latent.T)
            hidden = torch.addr(hidden, distance, of_distance).relu_()
            return self._in_range(torch.addmv(last.bias, hidden, last.weight[0]))

        return scale


def scale_inputs(betas: Tensor, pose: Tensor, style: Tensor | None) -> Tensor:
    """What h reads, shape (B, 86), from betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4) or (1, 4), or None.

    No style is the mean one. The root's rotation enters as the direction of gravity, which is all of it that a garment
    can feel. The other rotation vectors enter with angles up to π: callers may pass larger ones.

    Raises `FrameError` for anything but tensors of these shapes.
    """
    require_batch("betas", betas, (N_BETAS,))
    require_batch("pose", pose, (N_JOINTS, 3), sizes=(len(betas),))
    gamma = betas.new_zeros(1, N_STYLES) if style is None else style
    require_batch("style", gamma, (N_STYLES,), sizes=(1, len(betas)))
    if is_plain(betas, pose, gamma):
        inputs = pose.new_empty(len(pose), N_INPUTS)
        _read((len(pose),), *(one.contiguous() for one in (pose, betas, gamma)), inputs)
        return inputs
    angle = torch.linalg.vector_norm(pose, dim=-1, keepdim=True)
    wrapped = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    joints = pose * (wrapped / angle.clamp_min(1e-6))
    up = up_in(rotvec_to_rotmat(joints[:, 0]))
    return torch.cat((betas, joints[:, 1:].flatten(1), up, gamma.expand(len(betas), -1)), dim=1)


_read = Repeated(scale_inputs_kernel, (wp.vec3, wp.float32, wp.float32, wp.float32))


class _DenseLatent(nn.Module):
    """k(z)_i by one dense layer M to N · D, of which only the rows of the vertices asked for are multiplied."""

    def __init__(self, m: int, n: int, d: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(m)
        self.weight = nn.Parameter(torch.empty(n, d, m).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(n, d).uniform_(-bound, bound))

    def forward(self, z: Tensor, body: Tensor, vertex: Tensor) -> Tensor:
        if len(z) == 1:
            return functional.relu(self.weight[vertex] @ z[0] + self.bias[vertex])
        # For a batch, one product of all vertices that any of the bodies asks for: each row is read once.
        asked, where = torch.unique(vertex, return_inverse=True)
        latent = torch.einsum("bm,udm->bud", z, self.weight[asked]) + self.bias[asked]
        return functional.relu(latent[body, where])


class _CompactLatent(nn.Module):
    """k(z)_i as an embedding of the vertex times a small projection of z."""

    def __init__(self, m: int, n: int, d: int) -> None:
        super().__init__()
        self.embedding = nn.Parameter(torch.empty(n, d))
        self.projection = nn.Linear(m, d)
        if self.embedding.is_meta:  # only sizes are wanted here, and `normal_` makes torch import all of its compiler
            return
        nn.init.normal_(self.embedding)
        # Starts with latent vectors that are almost the same for all poses.
        nn.init.normal_(self.projection.weight, std=0.1 / math.sqrt(m))
        nn.init.ones_(self.projection.bias)

    def forward(self, z: Tensor, body: Tensor, vertex: Tensor) -> Tensor:
        latent: Tensor = self.embedding[vertex] * self.projection(z)[body]
        return latent
