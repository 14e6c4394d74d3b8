"""The plain perceptron of the sequence experiment (paper, supplement, "Results on VTO Dataset")."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from refu_core.backbones._decoder import Decoder
from refu_core.backbones._features import N_STYLE_SHAPE, PoseFeatures, style_shape
from refu_core.backbones._perceptron import Perceptron
from refu_core.backbones._protocol import WithoutWearerCode


@dataclass(frozen=True)
class MlpConfig:
    """Sizes of the perceptron; the defaults are the preset `realtime`. Five linear layers in both presets."""

    joints: tuple[int, ...]
    encoding: str = "matrix"
    hidden: tuple[int, ...] = (512, 512, 512, 512)
    activation: str = "silu"
    dropout: float = 0.1

    @classmethod
    def paper(cls, joints: tuple[int, ...]) -> MlpConfig:
        """With a dense head. The paper doesn't give the width, so TailorNet's is used."""
        return cls(joints, "rotvec", (1024, 1024, 1024, 1024), "relu", 0.2)


class Mlp(WithoutWearerCode, nn.Module):
    """(θ, β, γ) to displacements by one perceptron of five layers."""

    def __init__(self, config: MlpConfig, decoder: Decoder) -> None:
        super().__init__()
        self.config = config
        self.decoder = decoder
        self.features = PoseFeatures(config.joints, config.encoding)
        n = self.features.size + N_STYLE_SHAPE
        self.net = Perceptron(n, config.hidden, decoder.size, activation=config.activation, dropout=config.dropout)

    def forward(
        self, betas: Tensor, pose: Tensor, style: Tensor | None, *, wearer_code: Tensor | None = None
    ) -> Tensor:
        """Predicts for betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4)."""
        del wearer_code  # there is none
        return self.decoder(self.code(self.features(pose), style_shape(betas, style)))

    def code(self, x: Tensor, s: Tensor) -> Tensor:
        """Code, shape (B, C), of pose features (B, I) and (β, γ) (B, 14)."""
        return self.net(torch.cat((x, s), 1))
