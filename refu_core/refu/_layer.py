"""The Repulsive Force Unit as a layer that is trained: scale networks, margin and push in one module."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor, nn

from refu_core.errors import MeshError, WeightsError, require_type
from refu_core.modes import DEFAULT_MARGIN
from refu_core.refu._scale import REALTIME, ScaleNet, ScaleSettings, VertexScale
from refu_core.refu._unit import pushed_rows, repulse, require_margin
from refu_core.sdf import SdfSample, require_tensor
from refu_core.weights import config_of_card


class Refu(nn.Module):
    """ReFU (paper, Eq. 2): pushes the vertices closer to the body than ε by a learned scale, batch by batch.

    x' = x + α (ε - f(x)) ∇f/|∇f| where f(x) < ε, x elsewhere, and α = g(k(z)_i, f(x)), z = h(β, θ, γ). Finite for any
    finite input; differentiable with respect to points, distances, gradients, z and all weights.
    """

    def __init__(
        self, n_vertices: int, *, least: float, scale: ScaleSettings | None = REALTIME, margin: float = DEFAULT_MARGIN
    ) -> None:
        """A layer for garments of `n_vertices`. Raises `MeshError` for none, a bad margin, or a bad `least`.

        Args:
            least: lower end of α's range: 1 with an accurate distance, 0 with an approximate one (paper, Sec. 3.1).
            scale: sizes of the networks that predict α; None fixes it at 1.
            margin: ε > 0 [m], or 0 for the paper's.
        """
        super().__init__()
        require_type(n_vertices, Integral, "a number of vertices", error=MeshError)
        if n_vertices < 1:
            raise MeshError(f"wanted a garment of at least one vertex, got {n_vertices}")
        require_margin(margin)
        require_type(least, Real, "a least scale of 0 to 1", error=MeshError)
        if not 0 <= least <= 1:
            got = f"{float(margin):g} m and {float(least):g}"
            raise MeshError(f"wanted a margin of 0 m or more and a least scale of 0 to 1, got {got}")
        self.config: dict[str, Any] = {
            "n_vertices": n_vertices,
            "least": least,
            "scale": None if scale is None else asdict(scale),
            "margin": margin,
        }
        """What the layer was made with, for the card of its weights; `from_config` takes it."""
        self.n_vertices, self.margin = n_vertices, margin
        self.scale = None if scale is None else ScaleNet(n_vertices, least=least, settings=scale)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Refu:
        """The layer that `config` describes, untrained. Raises `WeightsError` if that isn't such a description."""
        try:
            scale = config["scale"]
            return cls(
                int(config["n_vertices"]),
                least=float(config["least"]),
                scale=None if scale is None else config_of_card(ScaleSettings, scale),
                margin=float(config["margin"]),
            )
        except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
            msg = f"not the description of a ReFU layer ({error!r}): train it anew with this version"
            raise WeightsError(msg) from error

    def feature(self, betas: Tensor, pose: Tensor, style: Tensor | None) -> Tensor | None:
        """z of some bodies, shape (B, M), as `ScaleNet.feature`; None where α is fixed."""
        return None if self.scale is None else self.scale.feature(betas, pose, style)

    def of_body(self, z: Tensor | None) -> float | VertexScale:
        """α as `Resolver` takes it, for the one body with the feature z, shape (M,) or (1, M)."""
        return 1.0 if self.scale is None or z is None else self.scale.of_body(z)

    def forward(self, points: Tensor, sample: SdfSample, z: Tensor | None = None) -> Tensor:
        """Pushes garments [m], shape (B, N, 3), whose distances (B, N) and gradients (B, N, 3) `sample` holds.

        `z` are features of the bodies, shape (B, M), as `feature` gives them. Raises `MeshError` for another number of
        vertices than N, for shapes that don't belong together, and without z for scales that are learned.
        """
        require_tensor("points", points)
        require_type(sample, SdfSample, "an SdfSample, as the query of a signed distance gives", error=MeshError)
        batch = len(points)
        if points.shape != (batch, self.n_vertices, 3):
            raise MeshError(f"wanted garments of the shape (B, {self.n_vertices}, 3), got {tuple(points.shape)}")
        if self.scale is not None and (z is None or len(z) != batch):
            raise MeshError(f"wanted features z of {batch} bodies, got {None if z is None else tuple(z.shape)}")
        flat = SdfSample(sample.distance.reshape(-1), sample.gradient.reshape(-1, 3))
        alpha: float | Tensor = 1.0
        if self.scale is not None and z is not None:
            rows = pushed_rows(flat.distance, self.margin)
            pushed = self.scale(z, rows // self.n_vertices, rows % self.n_vertices, flat.distance[rows])
            alpha = torch.ones_like(flat.distance).index_copy(0, rows, pushed.to(flat.distance))
        return repulse(points.reshape(-1, 3), flat, scale=alpha, margin=self.margin).view_as(points)
