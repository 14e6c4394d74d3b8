"""What cloth does on somebody who lies, on top of a backbone that knows upright people."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from refu_core.backbones._decoder import BasisDecoder
from refu_core.backbones._features import MOST_TILT, N_STYLE_SHAPE, PoseFeatures, style_shape, up_in_root
from refu_core.backbones._perceptron import Perceptron
from refu_core.backbones._protocol import Backbone

TILTS = (MOST_TILT, 0.25)
"""Cosines of the tilts of the pelvis between which a lying person's cloth is faded in: 60°, the most that other
networks are told of (`told_up`), and 76°."""


def lying_share(up: Tensor) -> Tensor:
    """How much somebody lies, 0 to 1, shape (B,), by world up in the root's axes (B, 3); a handstand isn't lying."""
    first, full = TILTS
    t = ((first - up[:, 1].abs()) / (first - full)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def is_lying(root: Sequence[float]) -> bool:
    """Whether `lying_share` is above zero for somebody whose root is turned by this rotation vector [rad], shape (3,).

    In Python: torch takes a hundred times as long for one person.
    """
    angle = math.hypot(*root)
    share = (root[1] / angle) ** 2 if angle else 1.0
    return abs(share + (1 - share) * math.cos(angle)) < TILTS[0]


@dataclass(frozen=True)
class LyingConfig:
    """Sizes of the perceptron."""

    joints: tuple[int, ...]
    """Those that it sees, beside world up."""
    hidden: tuple[int, ...] = (128, 128)
    """Hidden layers: with one of them, a lying T-shirt is off by 17.1 mm, with two by 16.4, with three or wider ones by
    16.3."""
    activation: str = "silu"
    dropout: float = 0.2


class Lying(nn.Module):
    """(θ, β, γ) of somebody who lies to what is added to a backbone's displacements; zero for everybody else."""

    def __init__(self, config: LyingConfig, decoder: BasisDecoder) -> None:
        """`decoder` holds what may be added; its mean is zero, so that there may be nothing to add."""
        super().__init__()
        self.config, self.decoder = config, decoder
        self.features = PoseFeatures(config.joints, "matrix")
        n = 3 + self.features.size + N_STYLE_SHAPE
        self.net = Perceptron(n, config.hidden, decoder.size, activation=config.activation, dropout=config.dropout)

    def seen(self, betas: Tensor, pose: Tensor, style: Tensor | None) -> Tensor:
        """What the perceptron sees, shape (B, I): world up as it is, pose features, β and γ."""
        return torch.cat((up_in_root(pose), self.features(pose), style_shape(betas, style)), 1)

    def forward(self, seen: Tensor) -> Tensor:
        """Code of what is added, shape (B, R), from what is `seen` (B, I)."""
        return lying_share(seen[:, :3])[:, None] * self.net(seen)


class WithLying(nn.Module):
    """A backbone with `Lying` on top, which costs nothing for who doesn't lie."""

    def __init__(self, upright: Backbone, lying: Lying) -> None:
        super().__init__()
        self.upright, self.lying = upright, lying
        self._is_serial = next(lying.parameters()).device.type == "cpu"
        self.heeds_past = upright.heeds_past

    @property
    def decoder(self) -> nn.Module:
        """That of the backbone."""
        decoder: nn.Module = self.upright.decoder  # type: ignore[attr-defined]
        return decoder

    def wearer_code(self, betas: Tensor, style: Tensor | None) -> Tensor | None:
        """That of the backbone."""
        return self.upright.wearer_code(betas, style)

    def forward(self, betas: Tensor, pose: Tensor, style: Tensor | None, **told: Any) -> Tensor:
        """Predicts as the backbone does, which is given what it is `told`, and adds what cloth of lying people does."""
        displacement = self.upright(betas, pose, style, **told)
        assert displacement is not None  # there are weights
        if self._is_serial and not any(map(is_lying, pose[:, 0].tolist())):
            return displacement
        return displacement + self.lying.decoder(self.lying(self.lying.seen(betas, pose, style)))
