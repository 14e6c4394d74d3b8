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


def signed_distance(points: Tensor, corners: Tensor, feature: Feature) -> SdfSample:
    """Distance and gradient of `points`, shape (N, 3), from the closest face's `corners`, shape (N, 3 vertices, 3)."""
    kind, each = feature.kind.long(), torch.arange(len(points), device=points.device)
    is_face, is_edge = (kind == 0)[:, None], (kind >= int(EDGE))[:, None]
    first = torch.where(is_edge[:, 0], kind - int(EDGE), kind - int(VERTEX)).clamp_min(0)
    start, along = corners[each, first], corners[each, (first + 1) % 3] - corners[each, first]
    offset = points - start
    t = (offset * along).sum(-1, keepdim=True) / (along * along).sum(-1, keepdim=True).clamp_min(1e-30)
    offset = torch.where(is_edge, offset - t * along, offset)
    from_face, from_rest = _from_face(points, corners, feature), _from_offset(offset, feature)
    return SdfSample(
        torch.where(is_face[:, 0], from_face.distance, from_rest.distance),
        torch.where(is_face, from_face.gradient, from_rest.gradient),
    )


def _from_face(points: Tensor, corners: Tensor, feature: Feature) -> SdfSample:
    a, b, c = corners.unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    height = ((points - a) * normal).sum(-1)
    # Within intersecting limbs the winding number's side may not be the normal's. On the surface rounding decides.
    off_surface = height.detach().abs() > float(ON_SURFACE)
    flip = torch.where(off_surface & (feature.sign * height.detach() < 0), -1.0, 1.0).to(points)
    return SdfSample(flip * height, flip[:, None] * normal)


def _from_offset(offset: Tensor, feature: Feature) -> SdfSample:
    """Distance and gradient from the offset of each point from its closest edge or vertex, shape (N, 3)."""
    # On the feature itself a distance has no derivative; the height over it along the pseudo-normal stands in.
    height = (offset * feature.normal).sum(-1)
    touching = torch.linalg.vector_norm(offset.detach(), dim=-1) < float(ON_SURFACE)
    length = torch.linalg.vector_norm(torch.where(touching[:, None], feature.normal, offset), dim=-1)
    direction = offset * (feature.sign / length)[:, None]
    return SdfSample(
        torch.where(touching, height, feature.sign * length),
        torch.where(touching[:, None], feature.normal, direction),
    )
