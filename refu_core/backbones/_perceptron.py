"""Perceptrons: one, and several of the same size side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from refu_core._warp import is_plain

_ANY = 1e4
"""No input is larger, and no number in a file of weights may be."""
ACTIVATIONS = {"relu": functional.relu, "silu": functional.silu}


class _Standardised(nn.Module):
    """Scales its inputs to a common size; until `standardise` is called they stay as they are.

    A bounded input is clamped to its range in the training set. Beyond what it has learnt, a perceptron extrapolates
    linearly: with the legs 47° apart, beyond any sample, a skirt was 51 mm inside the thighs, and is 34 mm with this.
    Out there, cloth is that of the nearest known pose, posed anew.
    """

    __call__: Callable[..., Tensor]
    shift: Tensor
    scale: Tensor
    lowest: Tensor
    highest: Tensor

    def __init__(self, inputs: int, activation: str, dropout: float) -> None:
        super().__init__()
        self.activation, self.dropout = ACTIVATIONS[activation], dropout
        self.register_buffer("shift", torch.zeros(inputs))
        self.register_buffer("scale", torch.ones(inputs))
        self.register_buffer("lowest", torch.full((inputs,), -_ANY))
        self.register_buffer("highest", torch.full((inputs,), _ANY))

    def standardise(self, inputs: Tensor, groups: Tensor | None = None, *, is_bounded: Tensor | bool = True) -> None:
        """Takes range, shift and scale from the inputs of the training set (N, I); one scale per group (I,).

        `is_bounded` (I,) says which inputs are clamped to their range.
        """
        groups = torch.arange(inputs.shape[1]) if groups is None else groups
        for name, values in _measured(inputs, groups, is_bounded).items():
            getattr(self, name).copy_(values)

    def widen(self, inputs: Tensor) -> None:
        """Widens the range of clamped inputs by further samples (N, I); shift and scale stay as they are."""
        with torch.no_grad():
            self.lowest.copy_(torch.where(self.lowest > -_ANY, inputs.amin(0).minimum(self.lowest), -_ANY))
            self.highest.copy_(torch.where(self.highest < _ANY, inputs.amax(0).maximum(self.highest), _ANY))

    def take_in(self, inputs: Tensor, groups: Tensor, *, at: int) -> None:
        """Inserts further inputs before number `at`, with no effect yet; range and sizes are those of samples (N, J).

        They are clamped. Joints that are added later don't carry the cloth, so beyond the range skinning adds nothing.
        """
        for name, values in _measured(inputs, groups, is_bounded=True).items():
            setattr(self, name, _inserted(getattr(self, name), values, at))
        self._take_in(inputs.shape[1], at)

    def _take_in(self, count: int, at: int) -> None:
        """Makes room for `count` inputs in the first layer."""
        raise NotImplementedError

    def seen(self, x: Tensor) -> Tensor:
        """The inputs (B, I) as the first layer sees them."""
        return (x.clamp(self.lowest, self.highest) - self.shift) * self.scale


class Perceptron(_Standardised):
    """Linear layers with an activation and dropout between them, on standardised input."""

    def __init__(
        self, inputs: int, hidden: Sequence[int], outputs: int, *, activation: str, dropout: float = 0.0
    ) -> None:
        super().__init__(inputs, activation, dropout)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise((inputs, *hidden, outputs)))

    def _take_in(self, count: int, at: int) -> None:
        first = self.layers[0]
        assert isinstance(first, nn.Linear)
        weight = first.weight.detach()
        first.weight = nn.Parameter(_inserted(weight, weight.new_zeros(len(weight), count), at))
        first.in_features += count

    def forward(self, x: Tensor) -> Tensor:
        """Shape (B, I) -> (B, O)."""
        x = self.seen(x)
        *hidden, last = self.layers
        for layer in hidden:
            x = self.activation(layer(x))
            x = functional.dropout(x, self.dropout) if self.training else x
        out: Tensor = last(x)
        return out


class StackedPerceptrons(_Standardised):
    """K perceptrons of one shape on one input, and their weighted sum."""

    def __init__(
        self, count: int, inputs: int, hidden: Sequence[int], outputs: int, *, activation: str, dropout: float = 0.0
    ) -> None:
        super().__init__(inputs, activation, dropout)
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for a, b in pairwise((inputs, *hidden, outputs)):
            bound = a**-0.5  # as in nn.Linear
            self.weights.append(nn.Parameter(torch.empty(count, a, b).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(count, b).uniform_(-bound, bound)))
        self._is_serial = True  # where numbers may be read: not in a CUDA graph
        self._known: dict[int, tuple[list[int] | None, Tensor, tuple[list[Tensor], list[Tensor], Tensor]]] = {}

    def _take_in(self, count: int, at: int) -> None:
        first = self.weights[0].detach().mT
        self.weights[0] = nn.Parameter(_inserted(first, first.new_zeros(*first.shape[:2], count), at).mT.contiguous())

    def forward(self, x: Tensor, mixture: Tensor) -> Tensor:
        """Σ_k mixture[:, k] · perceptron_k(x), shape (B, O), of x (B, I) and mixture (B, K)."""
        (*weights, last), (*biases, last_bias), mixture = self._counting(mixture)
        h = self.seen(x).expand(mixture.shape[1], -1, -1)  # (K, B, I)
        for weight, bias in zip(weights, biases, strict=True):
            h = self.activation(torch.baddbmm(bias, h, weight))
            h = functional.dropout(h, self.dropout) if self.training else h
        # Mixing before the last layer turns it into one product, without a (K, B, O) array, large with dense heads.
        mixed = (h * mixture.T[..., None]).transpose(0, 1).flatten(1)  # (B, K * H)
        return torch.addmm(last_bias, mixed, last.flatten(0, 1))

    def _counting(self, mixture: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """Weights and biases of the perceptrons that count in a mixture (B, K), and their part of it.

        Of the last layer, which is linear, the biases are mixed already, (B, O).
        They are remembered, since a mixture stays with its wearer. A GPU, which would have to be waited for, and
        whatever needs derivatives, get all.
        """
        tensors = [*self.weights, *self.biases]
        is_serial = self._is_serial and not mixture.is_cuda
        if self.training or not is_serial or not is_plain(mixture, *tensors):
            return _mixed(list(self.weights), list(self.biases), mixture)
        is_counted = not any(one.is_inference() for one in (mixture, *tensors))  # else nothing says when they change
        version = [one._version for one in (mixture, *tensors)] if is_counted else None
        known = self._known.get(id(mixture))
        if known is None or version is None or known[0] != version:
            (rows,) = torch.nonzero((mixture > _LEAST).any(0), as_tuple=True)
            weights, biases = ([one.detach()[rows] for one in some] for some in (self.weights, self.biases))
            if len(self._known) >= _MOST_MIXTURES:
                self._known.clear()
            known = self._known[id(mixture)] = version, mixture, _mixed(weights, biases, mixture[:, rows])
        return known[2]


def _mixed(weights: list[Tensor], biases: list[Tensor], mixture: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
    *inner, last = biases
    return weights, [*(bias[:, None] for bias in inner), mixture @ last], mixture


_LEAST = 1e-4
"""Shares below this don't count: of 20 perceptrons of a T-shirt, two are left on average, and vertices are moved by
at most 0.002 mm."""
_MOST_MIXTURES = 8  # are remembered: a pipeline's threads have one each


@torch.no_grad()
def _measured(inputs: Tensor, groups: Tensor, is_bounded: Tensor | bool) -> dict[str, Tensor]:
    """Range, shift and scale of the inputs (N, I) of samples; one scale per group (I,)."""
    bounded = torch.as_tensor(is_bounded, device=inputs.device)
    # Within a group relative sizes stay as they are: a number of a joint's rotation that hardly varies says little, and
    # isn't blown up to the size of the rest. The same holds for groups that don't vary at all.
    variance = inputs.new_zeros(int(groups.max()) + 1).index_add(0, groups, inputs.var(0))
    return {
        "lowest": torch.where(bounded, inputs.amin(0), -_ANY),
        "highest": torch.where(bounded, inputs.amax(0), _ANY),
        "shift": inputs.mean(0),
        "scale": 1 / ((variance / torch.bincount(groups)).sqrt() + 1e-3)[groups],
    }


def _inserted(values: Tensor, new: Tensor, at: int) -> Tensor:
    """Values (…, I) with new ones (…, J) inserted before number `at`."""
    return torch.cat((values[..., :at], new, values[..., at:]), -1)
