"""What a backbone sees of a body: pose features of the joints that move a garment, and style and shape."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from torch import Tensor, nn

from refu_core._warp import Repeated, is_plain
from refu_core.backbones._feature_kernels import features_kernel
from refu_core.body import require_batch, rotvec_to_rotmat, up_in
from refu_core.errors import RefuError
from refu_core.frames import N_BETAS, N_JOINTS, N_STYLES
from refu_core.garments import GarmentTemplate

N_STYLE_SHAPE = N_BETAS + N_STYLES
"""Width of (β, γ)."""

_CARRIES = 0.05
"""Least mean skinning weight of a joint in the cloth that it carries: hips have .03 in a T-shirt and .34 in shorts,
elbows .07 in a shirt. With hips bounded, too, a T-shirt was 27 mm inside a squatting person, and cut the shorts."""

ENCODINGS: tuple[str, ...] = ("matrix", "rotvec")


def up_in_root(pose: Tensor) -> Tensor:
    """World up in the root's axes, of unit length, shape (B, 3), for poses (B, 24, 3) [rad].

    This is all of the root's rotation that matters to cloth: it tilts gravity, and the heading changes nothing.
    """
    return up_in(rotvec_to_rotmat(pose[:, 0]))


SEEN_TILT = (np.radians(40), np.radians(60))
"""No recorded motion of the training tilts the pelvis beyond the first of these [rad]; lying postures do, but networks
are told of no tilt beyond the second.
On a lying person, a skirt was off by 30 to 46 mm and a T-shirt by 15 to 23; with this, by 32 to 44 and 12 to 18."""
MOST_TILT = 0.5
"""The cosine of the second."""


def told_up(up: Tensor) -> Tensor:
    """`up` (B, 3), of unit length, tilted by 60° at most.

    Beyond 120° the tilt falls again: a handstand is told as upright; otherwise a slight change could turn it over.
    """
    x, y, z = up.unbind(-1)
    sine2 = 1 - MOST_TILT**2
    level = (sine2 / (x * x + z * z).clamp_min(sine2)).sqrt()
    return torch.where(
        y[:, None] >= MOST_TILT, up, torch.stack((x * level, y.abs().clamp_min(MOST_TILT), z * level), -1)
    )


def tilt_rotvec(up: Tensor) -> Tensor:
    """The smallest rotation that turns `up` to +y, as a rotation vector [rad]; both of the shape (B, 3).

    This is a root's rotation without its heading. A half turn has no unique axis: any in the x-z plane will do there.
    """
    x, y, z = up.unbind(-1)
    sine = (x * x + z * z).clamp_min(1e-12).sqrt()
    factor = torch.where(sine > 1e-5, torch.atan2(sine, y) / sine, torch.ones_like(sine))
    over = torch.where((sine <= 1e-5) & (y < 0), torch.pi, -z * factor)
    return torch.stack((over, torch.zeros_like(x), x * factor), -1)


def upright(pose: Tensor, up: Tensor) -> Tensor:
    """Poses (B, 24, 3) [rad], in whose axes `up` (B, 3), of unit length, is up, for a network that takes y as up.

    Roots lose their heading. Poses with y up stay as they are, bit for bit.
    """
    of_root = (rotvec_to_rotmat(pose[:, 0]).mT @ up[..., None])[..., 0]
    root = torch.where(up[:, 1:2] == 1, pose[:, 0], tilt_rotvec(of_root))
    return torch.cat((root[:, None], pose[:, 1:]), 1)


class PoseFeatures(nn.Module):
    """θ as a network's input.

    `matrix`: world up in the root's frame (`told_up`), then R - 1 of every other joint of `joints`, nine numbers each:
    free of the jumps of rotation vectors and, with few samples, what generalises best (docs/guide/train.md).
    `rotvec`: the paper's 72 numbers, heading removed from the root, joints that aren't in `joints` zeroed.
    """

    def __init__(self, joints: tuple[int, ...], encoding: str) -> None:
        super().__init__()
        if encoding not in ENCODINGS:
            raise RefuError(f"no pose encoding {encoding!r}: wanted {' or '.join(ENCODINGS)}")
        self.encoding = encoding
        self.joints = tuple(j for j in joints if j != 0)
        self.size = 3 + 9 * len(self.joints) if encoding == "matrix" else 72
        # In numpy: on the meta device, where a card's sizes are tried out, sums make torch import all of its compiler.
        per_joint = np.repeat(np.arange(24), 3)
        if encoding == "matrix":
            per_joint = np.concatenate((np.zeros(3, np.int64), 1 + np.repeat(np.arange(len(self.joints)), 9)))
        self.groups = torch.from_numpy(np.concatenate((per_joint, per_joint[-1] + 1 + np.arange(N_STYLE_SHAPE))))
        """Which numbers of (features, β, γ) belong together, shape (size + 14,): those of one joint."""
        keep = torch.zeros(24, 1)
        keep[list(joints)] = 1.0
        self.register_buffer("_index", torch.tensor((0, *self.joints), dtype=torch.int32), persistent=False)
        self.register_buffer("_keep", keep, persistent=False)
        self.register_buffer("_eye", torch.from_numpy(np.eye(3, dtype=np.float32)), persistent=False)
        self._index: Tensor
        self._keep: Tensor
        self._eye: Tensor

    def columns_of(self, joints: tuple[int, ...]) -> Tensor:
        """Which of the features belong to these joints and to up. Raises `ValueError` for a joint that it lacks."""
        columns = np.arange(self.size)  # in NumPy, as above
        if self.encoding == "matrix":
            first = [3 + 9 * self.joints.index(joint) for joint in joints if joint != 0]
            columns = np.concatenate([columns[:3], *(columns[at : at + 9] for at in first)])
        return torch.from_numpy(columns)

    def are_bounded(self, garment: GarmentTemplate) -> Tensor:
        """Which numbers of (features, β, γ) a garment's network should see only within their known range, (size + 14,).

        Beyond that range, skinning takes cloth along with the joints that carry it. But a hem that raised thighs push
        is carried by other joints: there only the network can move it.
        """
        carries = garment.weights.detach().cpu().mean(0) >= _CARRIES
        carries[0] = False  # up is limited already (`told_up`); bounding it cost a skirt 0.4 mm on its test samples
        joints = self._index.cpu() if self.encoding == "matrix" else torch.arange(24)
        return torch.cat((carries[joints[self.groups[: self.size]]], torch.ones(N_STYLE_SHAPE, dtype=torch.bool)))

    def forward(self, pose: Tensor) -> Tensor:
        """Features, shape (B, size), of poses (B, 24, 3) [rad]. Raises `FrameError` for anything else."""
        require_batch("pose", pose, (N_JOINTS, 3))
        if self.encoding == "rotvec":
            whole = torch.cat((tilt_rotvec(told_up(up_in_root(pose)))[:, None], pose[:, 1:]), 1)
            return (whole * self._keep).flatten(1)
        if is_plain(pose):
            features = pose.new_empty(len(pose), self.size)
            _see((len(pose), len(self._index)), self._index, pose.contiguous(), features)
            return features
        rotations = rotvec_to_rotmat(pose[:, self._index])  # the root's first
        return torch.cat((told_up(up_in(rotations[:, 0])), (rotations[:, 1:] - self._eye).flatten(1)), 1)


_see = Repeated(features_kernel, (wp.int32, wp.vec3, wp.float32), [MOST_TILT])


def style_shape(betas: Tensor, style: Tensor | None) -> Tensor:
    """(β, γ) side by side, shape (B, 14), of betas (B, 10) and style (B, 4); no style is the mean style."""
    if style is None:
        style = betas.new_zeros(len(betas), N_STYLES)
    return torch.cat((betas, style.expand(len(betas), -1)), 1)
