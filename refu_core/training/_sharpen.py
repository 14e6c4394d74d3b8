"""Folds as strong as cloth's: what networks tell too softly, they tell louder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core.backbones import BasisDecoder
from refu_core.metrics import FoldBands

_LAST = ("low.layers", "style_shape.layers", "high.weights", "high.biases")
"""What ends in a code, by the beginning of its names."""


def sharpened(basis: BasisDecoder, bands: FoldBands, gains: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Mean [m], (V, 3), and components, (R, 3 V), that say in the same codes what has bands `gains` times as strong.

    A band has one gain for the whole garment, so all of it is one linear map of displacements, and is applied to the
    basis in the place of every frame.
    """
    louder = np.array([*gains, 1.0])
    rows = torch.cat((basis.mean[None], basis.components)).double().numpy()
    columns = rows.reshape(len(rows), -1, 3).transpose(1, 0, 2)
    made = torch.as_tensor(np.einsum("b,bvrc->rvc", louder, bands.split(columns)))
    return made[0].float(), made[1:].flatten(1).float()


def orthonormal(components: Tensor) -> tuple[Tensor, Tensor]:
    """An orthonormal basis (R, 3 V) of what `components` (R, 3 V) span, and the map (R, R) from their codes to its."""
    basis, upper = torch.linalg.qr(components.double().T)
    sign = upper.diagonal().sign()  # a component stays on the side where it was
    return (basis * sign).T.float(), (upper * sign[:, None]).T


def in_new_codes(tensors: Mapping[str, Tensor], to_new: Tensor) -> dict[str, Tensor]:
    """The `tensors` of a TailorNet, whose networks end in codes of another basis: `to_new` (R, R) of old codes."""
    last = {prefix: max(_number(name, prefix) for name in tensors if _number(name, prefix) >= 0) for prefix in _LAST}
    changed = dict(tensors)
    for name, tensor in tensors.items():
        if not any(_number(name, prefix) == number for prefix, number in last.items()):
            continue
        whole = tensor.double()
        is_linear = name.endswith(".weight")  # of nn.Linear: outputs before inputs
        changed[name] = (to_new.T @ whole if is_linear else whole @ to_new).to(tensor.dtype)
    return changed


def _number(name: str, prefix: str) -> int:
    """Which layer a name is of, -1 if it is of something else."""
    _, found, rest = name.partition(f"{prefix}.")
    return int(rest.split(".")[0]) if found else -1


def next_gains(gains: NDArray[np.float64], ratios: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gains nearer to those whose bands have the energy of true ones; `ratios` is what `gains` gave, both (4,)."""
    better: NDArray[np.float64] = np.maximum(gains * ratios**-0.6, 1.0)
    return better
