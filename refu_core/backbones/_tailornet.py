"""TailorNet (Patel et al. 2020), the paper's main backbone: a coarse shape and a mixture of folds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.func import functional_call

from refu_core.backbones._decoder import Decoder
from refu_core.backbones._features import N_STYLE_SHAPE, PoseFeatures, style_shape
from refu_core.backbones._perceptron import Perceptron, StackedPerceptrons
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

    @classmethod
    def paper(cls, joints: tuple[int, ...]) -> TailorNetConfig:
        """The original's sizes: 31 million parameters a net with a shirt's dense head."""
        return cls(joints, "rotvec", (1024, 1024), (1024, 1024), (128, 128), "relu", 0.2, 0.2)


class TailorNet(nn.Module):
    """D = D_LF(θ, β, γ) + Σ_k Ψ_k(β, γ) D_HF,k(θ), added to the garment's template before it is posed.

    Ψ = softmax(-dist_k / σ) over K pivots, with dist_k = 1000 · mean_v |G(β, γ)_v - G(β_k, γ_k)_v|² [m²] between the
    mean drapes G of a style and shape, which the style-shape net predicts.
    """

    heeds_past = False

    def __init__(self, config: TailorNetConfig, garment: GarmentTemplate, decoder: Decoder, pivots: Tensor) -> None:
        """`pivots` are the (β, γ) of the pivots, shape (K, 14)."""
        super().__init__()
        self.config = config
        self.decoder = decoder
        self.features = PoseFeatures(config.joints, config.encoding)
        activation = config.activation
        n_pose, n_code = self.features.size, decoder.size
        self.low = Perceptron(n_pose + N_STYLE_SHAPE, config.low, n_code, activation=activation, dropout=config.dropout)
        self.high = StackedPerceptrons(
            len(pivots), n_pose, config.high, n_code, activation=activation, dropout=config.high_dropout
        )
        self.style_shape = Perceptron(N_STYLE_SHAPE, config.style_shape, n_code, activation=activation)
        self.register_buffer("pivots", pivots.clone())
        # They take 12 ms, and aren't needed where a card's sizes are tried out without memory (`build_for`).
        directions = None if torch.empty(0).is_meta else decoder.directions(garment)
        self.register_buffer("_directions", directions, persistent=False)
        self.pivots: Tensor
        self._directions: Tensor

    def wearer_code(self, betas: Tensor, style: Tensor | None) -> Tensor:
        """The mixture Ψ of betas (B, 10) and style (B, 4), shape (B, K)."""
        return self.mixture(style_shape(betas, style))

    def forward(
        self, betas: Tensor, pose: Tensor, style: Tensor | None, *, wearer_code: Tensor | None = None
    ) -> Tensor:
        """Predicts for betas (B, 10), pose (B, 24, 3) [rad], style (B, 4) and, where it is known, their code (B, K)."""
        return self.decoder(self.code(self.features(pose), style_shape(betas, style), wearer_code))

    def code(self, x: Tensor, s: Tensor, mixture: Tensor | None = None) -> Tensor:
        """Code, shape (B, C), of pose features (B, I), (β, γ) (B, 14) and, where it is known, their mixture (B, K)."""
        return self.low_code(x, s) + self.high(x, self.mixture(s) if mixture is None else mixture)

    def low_code(self, x: Tensor, s: Tensor) -> Tensor:
        """Code of D_LF, shape (B, C), of pose features (B, I) and (β, γ) (B, 14)."""
        return self.low(torch.cat((x, s), 1))

    def drapes(self, s: Tensor) -> Tensor:
        """Mean drapes G, shape (B, C'), of (β, γ) (B, 14), in coordinates isometric to the vertices [m].

        Computed in the type of `s`.
        """
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

        Not differentiable: the kernel is so narrow that its gradient is zero nearly everywhere and huge elsewhere.
        """
        # Far from all pivots, which of two is nearer depends on the last digits of distances of 1e5: float32
        # lacks these, and a pivot's weight would be rounding noise.
        return kernel_weights(self.distances(s.double()), self.config.sigma).to(s.dtype)


def kernel_weights(distances: Tensor, sigma: float) -> Tensor:
    """softmax(-dist / σ) over the last axis, safe where every exp(-dist / σ) is zero."""
    nearest = distances.amin(-1, keepdim=True)
    kernel = torch.exp((nearest - distances) / sigma)
    return kernel / kernel.sum(-1, keepdim=True)
