"""Signed distance to a known face, edge or vertex, in torch, with exact first derivatives of it and its gradient."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from refu_core.sdf._closest_kernels import EDGE, ON_SURFACE, VERTEX
from refu_core.sdf._protocol import SdfSample


class Feature(NamedTuple):
    """The part of its closest face that each point is closest to; constant to first order around the point."""

    kind: Tensor
    """0 the face's interior, 1 to 3 its vertices, 4 to 6 its edges (0, 1), (1, 2), (2, 0); shape (N,)."""
    normal: Tensor
    """Unit pseudo-normal there, shape (N, 3)."""
    sign: Tensor
    """Side of the body, +1 outside, -1 inside, 0 on its surface, shape (N,)."""
    barycentrics: Tensor
    """Weights of the face's vertices at the closest point, shape (N, 3)."""


def signed_distance(points: Tensor, corners: Tensor, feature: Feature) -> SdfSample:
    """Distance and gradient of `points`, shape (N, 3), from the closest face's `corners`, shape (N, 3 vertices, 3)."""
    distance = torch.empty_like(points[:, 0])
    gradient = torch.empty_like(points)
    for rows, sample in (
        _to_faces(points, corners, feature),
        _to_edges(points, corners, feature),
        _to_vertices(points, corners, feature),
    ):
        distance = distance.index_copy(0, rows, sample.distance)
        gradient = gradient.index_copy(0, rows, sample.gradient)
    return SdfSample(distance, gradient)


def _to_faces(points: Tensor, corners: Tensor, feature: Feature) -> tuple[Tensor, SdfSample]:
    rows = torch.nonzero(feature.kind == 0)[:, 0]
    a, b, c = corners[rows].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    height = ((points[rows] - a) * normal).sum(-1)
    # Within intersecting limbs the side by winding number may not be the normal's; nearer, the two differ by rounding.
    off_surface = height.detach().abs() > float(ON_SURFACE)
    flip = torch.where(off_surface & (feature.sign[rows] * height.detach() < 0), -1.0, 1.0).to(points)
    return rows, SdfSample(flip * height, flip[:, None] * normal)


def _to_edges(points: Tensor, corners: Tensor, feature: Feature) -> tuple[Tensor, SdfSample]:
    rows = torch.nonzero(feature.kind >= int(EDGE))[:, 0]
    first = (feature.kind[rows] - int(EDGE)).long()
    each = torch.arange(len(rows), device=rows.device)
    a, b = corners[rows][each, first], corners[rows][each, (first + 1) % 3]
    along, offset = b - a, points[rows] - a
    t = (offset * along).sum(-1, keepdim=True) / (along * along).sum(-1, keepdim=True)
    return rows, _from_offset(offset - t * along, feature.normal[rows], feature.sign[rows])


def _to_vertices(points: Tensor, corners: Tensor, feature: Feature) -> tuple[Tensor, SdfSample]:
    rows = torch.nonzero((feature.kind >= int(VERTEX)) & (feature.kind < int(EDGE)))[:, 0]
    each = torch.arange(len(rows), device=rows.device)
    a = corners[rows][each, (feature.kind[rows] - int(VERTEX)).long()]
    return rows, _from_offset(points[rows] - a, feature.normal[rows], feature.sign[rows])


def _from_offset(offset: Tensor, normal: Tensor, sign: Tensor) -> SdfSample:
    # On the feature itself a distance has no derivative; the height over it along the pseudo-normal stands in.
    height = (offset * normal).sum(-1)
    touching = torch.linalg.vector_norm(offset.detach(), dim=-1) < float(ON_SURFACE)
    length = torch.linalg.vector_norm(torch.where(touching[:, None], normal, offset), dim=-1)
    direction = offset * (sign / length)[:, None]
    return SdfSample(
        torch.where(touching, height, sign * length),
        torch.where(touching[:, None], normal, direction),
    )
