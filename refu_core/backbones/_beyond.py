"""What cloth does in postures that a backbone doesn't know, on top of it: who lies, stretches legs, or runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from refu_core.backbones._decoder import BasisDecoder
from refu_core.backbones._features import MOST_TILT, N_STYLE_SHAPE, PoseFeatures, style_shape, up_in_root
from refu_core.backbones._perceptron import Perceptron
from refu_core.backbones._protocol import Backbone
from refu_core.body import rotvec_to_rotmat

TILTS = (MOST_TILT, 0.25)
"""Cosines of the tilts of the pelvis between which a lying person's cloth is faded in: 60°, the most that other
networks are told of (`told_up`), and 76°."""
SIDEWAYS = (0.6, 1.3)
"""How far the thighs point apart sideways where cloth is faded in: 35° and 81°; those of recorded people do by 33° at
most. Without, a skirt is off by 20 to 120 mm from 70° on. Faded in from 47° to 70°, it jumped by 78 mm as people sat
down with crossed legs within 0.6 s; now by 45."""
APART = (math.cos(math.radians(85)), math.cos(math.radians(110)))
"""Cosines of the angles between the thighs; recorded ones are at 78° at most."""
DRAWN_UP = (math.cos(math.radians(100)), math.cos(math.radians(120)))
"""Cosines of the angle by which a thigh is drawn up: in a chair it is 90°, in a squat 120°."""
DRAWN_BACK = (math.sin(math.radians(25)), math.sin(math.radians(50)))
"""Sines of the angle by which a thigh points backwards; recorded ones do by 24.5° at most."""
RAISED = (math.cos(math.radians(35)), math.cos(math.radians(85)))
"""Cosines of the angle by which a lower leg is raised: who walks raises it by 50°, who runs by 90° and more.
Faded in from 50° to 75°, a runner's dress jumped more often: before contact, a vertex went 20 mm farther than the
skinned one in 8 of 34 frame pairs, now in 5."""
BEHIND = (0.0, 0.4)
"""How far a raised lower leg points backwards: by 0.4 of its length where the heel is at the seat."""


def _faded(value: Tensor, range_: tuple[float, float]) -> Tensor:
    """0 to 1 as a value goes from one end of a range to the other, without a corner."""
    first, full = range_
    t = ((value - first) / (full - first)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def lying_share(pose: Tensor) -> Tensor:
    """How much some people (B, 24, 3) [rad] lie, 0 to 1, shape (B,); a handstand isn't lying."""
    return _faded(up_in_root(pose)[:, 1].abs(), TILTS)


def legs_share(pose: Tensor) -> Tensor:
    """How much some people (B, 24, 3) [rad] have their thighs apart, drawn up or drawn back, 0 to 1, shape (B,).

    None of it is left of somebody who lies.
    """
    thighs = rotvec_to_rotmat(pose[:, 1:3])[..., 1]  # where they point, turned round
    left, right = thighs.unbind(1)
    sideways, apart = _faded(right[:, 0] - left[:, 0], SIDEWAYS), _faded((left * right).sum(1), APART)
    drawn_up = _faded(thighs[..., 1].amin(1), DRAWN_UP)
    drawn_back = _faded(thighs[..., 2].amax(1), DRAWN_BACK)
    others = (1 - sideways) * (1 - apart) * (1 - drawn_up) * (1 - drawn_back)
    return (1 - others) * (1 - lying_share(pose))


def heels_share(pose: Tensor) -> Tensor:
    """How much some people (B, 24, 3) [rad] have a lower leg raised behind them, 0 to 1, shape (B,).

    None of it is left of somebody who lies, or whose thighs are apart or drawn up or back.
    """
    thighs, knees = rotvec_to_rotmat(pose[:, 1:3]), rotvec_to_rotmat(pose[:, 4:6])
    legs = (thighs @ knees[..., 1:2])[..., 0]  # where lower legs point, turned round
    left, right = (_faded(legs[..., 1], RAISED) * _faded(legs[..., 2], BEHIND)).unbind(1)
    return (1 - (1 - left) * (1 - right)) * (1 - legs_share(pose)) * (1 - lying_share(pose))


def _turned(rotvec: Sequence[float], way: Sequence[float] = (0.0, 1.0, 0.0)) -> tuple[float, float, float]:
    """Where a rotation vector [rad] turns a direction, or the y axis."""
    vx, vy, vz = way
    if not 0 < (angle := math.hypot(*rotvec)) < math.inf:
        return vx, vy, vz
    x, y, z = (one / angle for one in rotvec)
    sine, cosine = math.sin(angle), math.cos(angle)
    along = (1 - cosine) * (x * vx + y * vy + z * vz)
    return (
        along * x + cosine * vx + sine * (y * vz - z * vy),
        along * y + cosine * vy + sine * (z * vx - x * vz),
        along * z + cosine * vz + sine * (x * vy - y * vx),
    )


def _lies(pose: Sequence[Sequence[float]]) -> bool:
    return abs(_turned(pose[0])[1]) < TILTS[0]


def _lies_flat(pose: Sequence[Sequence[float]]) -> bool:
    return abs(_turned(pose[0])[1]) <= TILTS[1]


def _stretches_legs(pose: Sequence[Sequence[float]]) -> bool:
    left, right = map(_turned, pose[1:3])
    between = sum(one * other for one, other in zip(left, right, strict=True))
    is_apart = right[0] - left[0] > SIDEWAYS[0] or between < APART[0]
    is_drawn = min(left[1], right[1]) < DRAWN_UP[0] or max(left[2], right[2]) > DRAWN_BACK[0]
    return (is_apart or is_drawn) and not _lies_flat(pose)


def _raises_heels(pose: Sequence[Sequence[float]]) -> bool:
    legs = (_turned(hip, _turned(knee)) for hip, knee in zip(pose[1:3], pose[4:6], strict=True))
    return any(y < RAISED[0] and z > BEHIND[0] for _, y, z in legs) and not _lies_flat(pose)


@dataclass(frozen=True)
class _Kind:
    """Postures of one kind."""

    share: Callable[[Tensor], Tensor]
    """How much people (B, 24, 3) [rad] are in them, 0 to 1, shape (B,)."""
    is_any: Callable[[Sequence[Sequence[float]]], bool]
    """Whether that may be above zero for one person, by the first six rotation vectors [rad], shape (6, 3).

    In Python: torch takes a hundred times as long for one person.
    """
    joints: tuple[int, ...] = ()
    """Those that its network is told of, whatever the backbone sees."""


KINDS = {
    "lying": _Kind(lying_share, _lies),
    "legs": _Kind(legs_share, _stretches_legs),
    "heels": _Kind(heels_share, _raises_heels, (1, 2, 4, 5)),
}
"""Postures that a garment may have a network for, by that network's name."""


@dataclass(frozen=True)
class BeyondConfig:
    """Sizes of the perceptron."""

    joints: tuple[int, ...]
    """Those that it sees, beside world up."""
    hidden: tuple[int, ...] = (256, 256)
    """Hidden layers: 69 lying skirts are off by 27.6 mm with 128 neurons in each, by 26.9 with 256 and with 512. With
    one layer, a lying T-shirt is off by 17.1 mm, with two by 16.4, with three by 16.3."""
    activation: str = "silu"
    dropout: float = 0.2


class Beyond(nn.Module):
    """(θ, β, γ) of somebody in a posture of one of the `KINDS` to what is added to a backbone's displacements.

    Zero for everybody else.
    """

    def __init__(self, kind: str, config: BeyondConfig, decoder: BasisDecoder) -> None:
        """`decoder` holds what may be added; its mean is zero, so that there may be nothing to add."""
        super().__init__()
        self.kind, self.config, self.decoder = kind, config, decoder
        self.features = PoseFeatures(config.joints, "matrix")
        n = 3 + self.features.size + N_STYLE_SHAPE
        self.net = Perceptron(n, config.hidden, decoder.size, activation=config.activation, dropout=config.dropout)

    def seen(self, betas: Tensor, pose: Tensor, style: Tensor | None) -> Tensor:
        """The share, then what the perceptron sees, shape (B, 1 + I): world up as it is, pose features, β and γ."""
        share = KINDS[self.kind].share(pose)[:, None]
        return torch.cat((share, up_in_root(pose), self.features(pose), style_shape(betas, style)), 1)

    def standardise(self, seen: Tensor) -> None:
        """Takes the range and scale of the perceptron's inputs from what is `seen` of the training set (N, 1 + I)."""
        groups = torch.cat((torch.zeros(3, dtype=torch.long), 1 + self.features.groups))
        self.net.standardise(seen[:, 1:], groups)

    def forward(self, seen: Tensor) -> Tensor:
        """Code of what is added, shape (B, R), from what is `seen` (B, 1 + I)."""
        return seen[:, :1] * self.net(seen[:, 1:])


class WithBeyond(nn.Module):
    """A backbone with networks for postures `beyond` what it knows, which cost nothing for everybody else."""

    def __init__(self, known: Backbone, beyond: Iterable[Beyond]) -> None:
        super().__init__()
        self.known, self.beyond = known, nn.ModuleList(beyond)
        self._is_serial = next(self.beyond.parameters()).device.type == "cpu"
        self.heeds_past = known.heeds_past

    @property
    def decoder(self) -> nn.Module:
        """That of the backbone."""
        decoder: nn.Module = self.known.decoder  # type: ignore[attr-defined]
        return decoder

    def wearer_code(self, betas: Tensor, style: Tensor | None) -> Tensor | None:
        """That of the backbone."""
        return self.known.wearer_code(betas, style)

    def forward(self, betas: Tensor, pose: Tensor, style: Tensor | None, **told: Any) -> Tensor:
        """Predicts as the backbone does, which is given what it is `told`, and adds what cloth does beyond."""
        displacement = self.known(betas, pose, style, **told)
        assert displacement is not None  # there are weights
        people = pose[:, :6].tolist() if self._is_serial else []
        for one in self.beyond:
            assert isinstance(one, Beyond)
            if not self._is_serial or any(map(KINDS[one.kind].is_any, people)):
                displacement = displacement + one.decoder(one(one.seen(betas, pose, style)))
        return displacement
