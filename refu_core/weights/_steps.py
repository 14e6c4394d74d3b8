"""Numbers as whole numbers of steps, a byte each."""

from __future__ import annotations

import torch
from torch import Tensor

_STEPS = 127


def in_steps(values: Tensor, dim: int | None = None) -> tuple[Tensor, Tensor]:
    """The steps, int8, of float32 `values`, and a step's size: a number, or with `dim` one for each row along that.

    Sizes are rounded to bfloat16. 127 steps then have few enough digits for float32, so the largest of the values that
    are read tells what the step was: stored again, they are the same to the bit.
    """
    largest = values.abs().amax() if dim is None else values.abs().amax(dim, keepdim=True)
    step = (largest / _STEPS).bfloat16().float()
    steps = (values / step.clamp_min(torch.finfo().tiny)).round().clamp(-_STEPS, _STEPS)
    return steps.to(torch.int8), step
