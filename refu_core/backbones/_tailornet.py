"""TailorNet (Patel et al. 2020), the paper's main backbone: a coarse shape and a mixture of folds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.func import functional_call

from refu_core.backbones._decoder import Decoder
from refu_core.backbones._features import N_STYLE_SHAPE, PoseFeatures, style_shape
from refu_core.backbones._perceptron import Perceptron, StackedPerceptrons
from refu_core.backbones._protocol import Prediction
from refu_core.garments import GarmentTemplate


@dataclass(frozen=True)
class TailorNetConfig:
    """Sizes and habits of a TailorNet; the defaults are the preset `realtime`."""

    joints: tuple[int, ...]
    encoding: str = "matrix"
    low: tuple[int, ...] = (768, 768)
    """Hidden layers of the low-frequency net."""
    high: tuple[int, ...] = (64, 64)
    """Hidden layers of every high-frequency net."""
    style_shape: tuple[int, ...] = (64, 64)
    """Hidden layers of the style-shape net."""
    activation: str = "silu"
    dropout: float = 0.1
    high_dropout: float = 0.3
    """Of the high-frequency nets, each of which sees a small part of the samples."""
    sigma: float = 0.01
    """Width of the kernel of the mixture."""
    skipped: float = 1e-3
    """At run time, pivots are left out whose mixture weights together are at most this."""

    @classmethod
    def paper(cls, joints: tuple[int, ...]) -> TailorNetConfig:
        """The original's sizes: 31 million parameters a net with a shirt's dense head."""
        return cls(joints, "rotvec", (1024, 1024), (1024, 1024), (128, 128), "relu", 0.2, 0.2, skipped=0.0)


class TailorNet(nn.Module):
    """D = D_LF(θ, β, γ) + Σ_k Ψ_k(β, γ) D_HF,k(θ), added to the garment's template before it is posed.

    Ψ = softmax(-dist_k / σ) over K pivots, with dist_k = 1000 · mean_v |G(β, γ)_v - G(β_k, γ_k)_v|² [m²] between the
    mean drapes G of a style and shape, which the style-shape net predicts.
    """

    def __init__(self, config: TailorNetConfig, garment: GarmentTemplate, decoder: Decoder, pivots: Tensor) -> None:
        """`pivots` are the (β, γ) of the pivots, shape (K, 14)."""
        super().__init__()
        self.config = config
        self.decoder = decoder
        self.features = PoseFeatures(config.joints, config.encoding)
        activation = config.activation
        self.low = Perceptron(
            self.features.size + N_STYLE_SHAPE, config.low, decoder.size, activation=activation, dropout=config.dropout
        )
        self.high = StackedPerceptrons(
            len(pivots),
            self.features.size,
            config.high,
            decoder.size,
            activation=activation,
            dropout=config.high_dropout,
        )
        self.style_shape = Perceptron(N_STYLE_SHAPE, config.style_shape, decoder.size, activation=config.activation)
        self.register_buffer("pivots", pivots.clone())
        self.register_buffer("_directions", decoder.directions(garment), persistent=False)
        self.pivots: Tensor
        self._directions: Tensor
        self._cache: _Mixture | None = None
        self.skips_pivots = True
        """Whether pivots of negligible weight are left out (`TailorNetConfig.skipped`); the next mixture obeys."""

    def forward(
        self, betas: Tensor, pose: Tensor, style: Tensor | None, *, mixture: Tensor | None = None
    ) -> Prediction:
        """Predicts for betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4).

        Given the `mixture` as `run_time_mixture` says it, shape (B, K), all pivots are computed, and nothing is
        remembered or looked up: the same work for any input.
        """
        x, s = self.features(pose), style_shape(betas, style)
        high = self.high_code(x, s) if mixture is None else self.high(x, mixture)
        return Prediction(self.decoder(self.low_code(x, s) + high), None)

    def low_code(self, x: Tensor, s: Tensor) -> Tensor:
        """Code of D_LF, shape (B, C), of pose features (B, I) and (β, γ) (B, 14)."""
        code: Tensor = self.low(torch.cat((x, s), 1))
        return code

    def high_code(self, x: Tensor, s: Tensor) -> Tensor:
        """Code of Σ_k Ψ_k D_HF,k, shape (B, C), as `low_code`.

        While nothing is being trained, what depends on (β, γ) only is kept for the next call with the same, and pivots
        of negligible weight are left out. By the triangle inequality no vertex moves by more than `config.skipped`
        times the largest displacement that a left-out pivot predicts there.
        """
        if self.training or torch.is_grad_enabled():
            mixed: Tensor = self.high(x, self.mixture(s))
            return mixed
        state = self._state()
        if self._cache is None or not self._cache.holds_for(s, state):
            self._cache = self._mix(s, state)
        sparse: Tensor = self.high(x, self._cache.weights, self._cache.selected)
        return sparse

    @property
    def n_skipped(self) -> int:
        """How many pivots were left out of the last prediction."""
        return 0 if self._cache is None else len(self.pivots) - self._cache.weights.shape[1]

    def drapes(self, s: Tensor) -> Tensor:
        """Mean drapes G, shape (B, C'), of (β, γ) (B, 14), in coordinates isometric to the vertices [m].

        Computed in the type of `s`.
        """
        if s.dtype == self._directions.dtype:
            code = self.style_shape(s)
        else:
            tensors = {name: tensor.to(s.dtype) for name, tensor in self.style_shape.state_dict().items()}
            code = functional_call(self.style_shape, tensors, s)
        drape = s @ self._directions.to(s.dtype)
        drape[:, : code.shape[1]] += code
        return drape

    def distances(self, s: Tensor) -> Tensor:
        """dist_k to the pivots, shape (B, K), of (β, γ) (B, 14)."""
        gap = (self.drapes(s)[:, None] - self.drapes(self.pivots.to(s.dtype))).square().sum(-1)
        return 1000.0 / self.decoder.n_vertices * gap

    @torch.no_grad()
    def mixture(self, s: Tensor) -> Tensor:
        """Ψ, shape (B, K), of (β, γ) (B, 14); rows sum to one however far a style is from all pivots.

        Not differentiable: the kernel is so narrow that its gradient is nothing nearly everywhere and huge elsewhere.
        """
        return kernel_weights(self.distances(s), self.config.sigma)

    def run_time_mixture(self, s: Tensor) -> Tensor:
        """Ψ, shape (B, K), of (β, γ) (B, 14), with a weight of zero for pivots that are left out."""
        # Far from all pivots, which of two is nearer hangs on the last digits of distances of 1e5: float32 hasn't got
        # them, and a pivot's weight would be rounding.
        mixture = self.mixture(s.double()).to(s.dtype)
        return without_negligible(mixture, self.config.skipped if self.skips_pivots else 0.0)

    def _mix(self, s: Tensor, state: tuple[object, ...]) -> _Mixture:
        mixture = self.run_time_mixture(s)
        active = mixture.amax(0).nonzero()[:, 0]
        return _Mixture(s.clone(), state, mixture[:, active].contiguous(), self.high.select(active))

    def _state(self) -> tuple[object, ...]:
        """Changes whenever a tensor that the mixture depends on is written to, or moved."""
        tensors = (self.pivots, self._directions, *self.style_shape.parameters(), *self.high.parameters())
        return tuple((t._version, t.data_ptr(), t.dtype) for t in tensors)


@dataclass(frozen=True, eq=False)
class _Mixture:
    """What depends on (β, γ) only."""

    style_shape: Tensor
    state: tuple[object, ...]
    weights: Tensor
    """Ψ of the pivots that count, shape (B, A)."""
    selected: list[tuple[Tensor, Tensor]]

    def holds_for(self, s: Tensor, state: tuple[object, ...]) -> bool:
        return self.state == state and torch.equal(self.style_shape, s)


def kernel_weights(distances: Tensor, sigma: float) -> Tensor:
    """softmax(-dist / σ) over the last axis, safe where every exp(-dist / σ) is zero."""
    nearest = distances.amin(-1, keepdim=True)
    kernel = torch.exp((nearest - distances) / sigma)
    return kernel / kernel.sum(-1, keepdim=True)


def without_negligible(mixture: Tensor, skipped: float) -> Tensor:
    """The mixture (B, K) with a weight of zero for the pivots that a row leaves out.

    These are the lightest ones that weigh at most `skipped` together. A row leaves out the same, whoever else is in the
    batch: a person alone and in a crowd wear the same.
    """
    order = mixture.argsort(-1)
    is_light = mixture.gather(-1, order).cumsum(-1) <= skipped
    return mixture.masked_fill(torch.zeros_like(is_light).scatter(-1, order, is_light), 0.0)


def non_negligible(mixture: Tensor, skipped: float) -> Tensor:
    """Indices of the pivots that count in any row, shape (A,), for a mixture (B, K): see `without_negligible`."""
    return without_negligible(mixture, skipped).amax(0).nonzero()[:, 0]
