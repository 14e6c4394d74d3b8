"""The least that the stages of a frame must read, write and compute: what their times are held against."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from refu_core.backbones import Backbone, BasisDecoder, TailorNet, non_negligible, style_shape
from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate

_POINT = 12
"""Bytes of three float32."""
_TEST = 60
"""Operations of one closest point on one triangle, about."""


class StageWork(NamedTuple):
    """What one stage can't do without."""

    stage: str
    n_bytes: float
    flops: float
    counted: str
    """What was counted."""


def least_work(
    body: SmplBody, garment: GarmentTemplate, backbone: Backbone, *, message_bytes: int, betas: Tensor
) -> list[StageWork]:
    """Of one garment in one frame, by stage: every input read once, every output written once, no product skipped.

    What depends on (β, γ) alone is taken as known already. A distance is one triangle's, as if each vertex knew its
    own; nothing says that a program could know it.

    Args:
        body: Who wears it.
        garment: What is worn.
        backbone: Networks of the garment.
        message_bytes: Length of the message that comes in.
        betas: A body shape, shape (1, 10): it says how many of a tailornet's pivots count.
    """
    n, corners = garment.n_vertices, 3 * len(garment.faces)
    weights, flops = _network_work(backbone, betas)
    posing_bytes, posing_flops = _posing(garment.weights, n)
    body_bytes, body_flops = _posing(body.weights, body.n_vertices)
    surface = body.n_vertices * _POINT + len(body.faces) * _POINT
    return [
        StageWork("decode", 2 * message_bytes, 0, "message read, numbers written"),
        StageWork("body", body_bytes, body_flops, "skinning weights that aren't zero, vertices"),
        StageWork(
            "backbone", weights + posing_bytes, flops + posing_flops, "weights and basis read once, garment posed"
        ),
        StageWork("sdf", surface, 0, "the body's vertices and faces"),
        StageWork("refu", n * (4 * _POINT + 8), n * _TEST, "one triangle a vertex; points, distances, gradients"),
        StageWork("encode", corners * 24 + n * _POINT + corners * 4, 0, "corners of triangles in float64"),
    ]


def _posing(weights: Tensor, n: int) -> tuple[float, float]:
    """Bytes and operations of linear blend skinning."""
    used = int(torch.count_nonzero(weights))
    return used * 8 + 2 * n * _POINT, used * 24 + n * 18


@torch.no_grad()
def _network_work(backbone: Backbone, betas: Tensor) -> tuple[float, float]:
    if not isinstance(backbone, torch.nn.Module):
        return 0.0, 0.0
    count = sum(p.numel() for p in backbone.parameters())
    if isinstance(backbone, TailorNet):
        s = style_shape(betas, None)
        active = len(non_negligible(backbone.mixture(s), backbone.config.skipped))
        high = sum(p.numel() for p in backbone.high.parameters())
        count = sum(p.numel() for p in backbone.low.parameters()) + high * active // len(backbone.pivots)
    decoder = getattr(backbone, "decoder", None)
    if isinstance(decoder, BasisDecoder):
        count += decoder.components.numel() + decoder.mean.numel()
    return 4.0 * count, 2.0 * count
