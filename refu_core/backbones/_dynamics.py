"""A backbone that knows how a person moves: the effect of cloth's inertia, added to how it hangs at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from refu_core.backbones._features import N_STYLE_SHAPE, style_shape
from refu_core.backbones._perceptron import Perceptron
from refu_core.backbones._tailornet import TailorNet
from refu_core.frames import LAGS, N_JOINTS, N_PAST


@dataclass(frozen=True)
class DynamicsConfig:
    """Sizes of the perceptron."""

    joints: tuple[int, ...]
    """Those whose motion it sees; the root is always one of them."""
    hidden: tuple[int, ...] = (256, 256)
    activation: str = "silu"
    dropout: float = 0.2


class Dynamics(nn.Module):
    """f(θ, β, γ, past) - f(θ, β, γ, 0): zero for a person who stands still. It has no state, so it can't drift."""

    def __init__(self, config: DynamicsConfig, still: TailorNet) -> None:
        """`still` is the backbone that this one is added to."""
        super().__init__()
        self.config = config
        joints = (0, *(j for j in config.joints if j))
        of_joints = np.arange(9 * N_JOINTS).reshape(N_JOINTS, 9)[list(joints)].ravel()
        columns = np.concatenate((of_joints, np.arange(9 * N_JOINTS, N_PAST)))
        self.register_buffer("_columns", torch.from_numpy(columns), persistent=False)
        known = tuple(j for j in config.joints if j in still.features.joints)  # all, unless they were carried over
        self.register_buffer("_now", still.features.columns_of(known), persistent=False)
        self._columns: Tensor
        self._now: Tensor
        groups = still.features.groups
        now = torch.cat((groups[self._now], groups[still.features.size :])).numpy()
        self.groups = torch.from_numpy(np.concatenate((now, np.tile(now.max() + 1 + columns // 9, len(LAGS)))))
        """Which inputs belong together, as in `PoseFeatures.groups`: those of one joint, at all lags."""
        n_past = len(LAGS) * len(columns)
        n, m = len(self._now) + N_STYLE_SHAPE + n_past, still.decoder.size
        self.net = Perceptron(n, config.hidden, m, activation=config.activation, dropout=config.dropout)

    def forward(self, x: Tensor, s: Tensor, past: Tensor) -> Tensor:
        """Code, shape (B, C), of pose features (B, I), (β, γ) (B, 14) and the past (B, 4, 219)."""
        moved = self.seen(past)
        now = torch.cat((x[:, self._now], s), 1)
        both = torch.cat((torch.cat((now, moved), 1), torch.cat((now, torch.zeros_like(moved)), 1)))
        with_past, without = self.net(both).chunk(2)
        return with_past - without

    def seen(self, past: Tensor) -> Tensor:
        """What it sees of the past (B, 4, 219), shape (B, P)."""
        return past[..., self._columns].flatten(1)

    def standardise(self, x: Tensor, s: Tensor, past: Tensor, is_bounded: Tensor) -> None:
        """Takes the inputs' sizes from the training set; `is_bounded` is for x and s, the past is always bounded."""
        moved = self.seen(past)
        bounded = (is_bounded[self._now], is_bounded[x.shape[1] :], torch.ones(moved.shape[1], dtype=torch.bool))
        inputs = torch.cat((x[:, self._now], s, moved), 1)
        self.net.standardise(inputs, self.groups, is_bounded=torch.cat(bounded))


class Dynamic(nn.Module):
    """A TailorNet with `Dynamics` on top: both share an output basis, so it costs hardly more than the first alone."""

    heeds_past = True

    def __init__(self, still: TailorNet, dynamics: Dynamics) -> None:
        super().__init__()
        self.still, self.dynamics = still, dynamics

    @property
    def decoder(self) -> nn.Module:
        """The decoder of both."""
        return self.still.decoder

    def wearer_code(self, betas: Tensor, style: Tensor | None) -> Tensor:
        """`TailorNet.wearer_code`."""
        return self.still.wearer_code(betas, style)

    def forward(
        self,
        betas: Tensor,
        pose: Tensor,
        style: Tensor | None,
        *,
        wearer_code: Tensor | None = None,
        past: Tensor | None = None,
    ) -> Tensor:
        """Predicts as the TailorNet does and, if given the past (B, 4, 219), adds the effect of motion."""
        x, s = self.still.features(pose), style_shape(betas, style)
        code = self.still.code(x, s, wearer_code)
        if past is not None:
            code = code + self.dynamics(x, s, past)
        return self.still.decoder(code)
