"""What points are closest to: kernels say which face and which of its corners, torch where on it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_ON = 1e-6
"""A closest point with less of a corner than this lies on the edge across."""


class Closest(NamedTuple):
    """What some points are closest to."""

    face: Tensor
    """Of all segments' faces, int64, shape (N,); -1 for none near."""
    weights: Tensor
    """Of the face's corners, shape (N, 3)."""
    sign: Tensor
    """-1 inside, shape (N,)."""


def weights_at(p: Tensor, corners: Tensor, about: Tensor) -> Tensor:
    """Weights of a triangle's corners at its point closest to p, shape (N, 3), which is on what it is `about` on."""
    a, b, c = corners.unbind(1)
    is_on = about > _ON
    ab, ac, ap = b - a, c - a, p - a
    d00, d01, d11 = (ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)
    d20, d21 = (ap * ab).sum(1), (ap * ac).sum(1)
    area = (d00 * d11 - d01 * d01).clamp_min(1e-30)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    within = torch.stack((1 - v - w, v, w), 1)
    first, second = (is_on * about.new_tensor((3.0, 2.0, 1.0))).topk(2, dim=1).indices.unbind(1)
    rows = torch.arange(len(p), device=p.device)
    start, end = corners[rows, first], corners[rows, second]
    along = end - start
    t = ((p - start) * along).sum(1) / (along * along).sum(1).clamp_min(1e-30)
    t = torch.where(is_on.sum(1) > 1, t, torch.zeros_like(t))
    zeros = torch.zeros_like(within)
    on_edge = zeros.index_put((rows, first), 1 - t).index_put((rows, second), t, accumulate=True)
    return torch.where(is_on.all(1)[:, None], within, on_edge)
