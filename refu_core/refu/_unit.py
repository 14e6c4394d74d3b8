"""The repulsive force itself: one push along the gradient, by the scaled distance to a margin."""

from __future__ import annotations

import math
from numbers import Real

import torch
from torch import Tensor

from refu_core.errors import MeshError, require_type
from refu_core.sdf import SdfSample, require_tensor

MAX_DISPLACEMENT = 0.1
"""No vertex moves farther than this [m], however wrong its distance is."""

_UP = (0.0, 1.0, 0.0)


def repulse(points: Tensor, sample: SdfSample, *, scale: float | Tensor = 1.0, margin: float = 0.0) -> Tensor:
    """ReFU: the points [m], shape (N, 3), with those closer to the body than `margin` moved along the gradient.

    x' = x - α (f(x) - ε) ∇f/|∇f| where f(x) < ε, and x elsewhere: the paper's Eq. 2 to 4, with f - ε in place of f.
    Differentiable with respect to the points, the sample and the scale. At f = ε the derivative is that of the outer
    branch.

    Gradients needn't have unit length, and one that is zero or not finite is replaced by up. `scale` is α, one number
    or shape (N,); 1 is the paper's "fixed scale". `margin` is ε ≥ 0 [m].

    Raises `MeshError` for tensors whose shapes don't belong together, or a margin that is negative or not finite.
    """
    _check(points, sample, scale, margin)
    rows = pushed_rows(sample.distance, margin)
    if not len(rows):
        return points
    deficit = margin - sample.distance[rows]
    alpha = scale[rows] if isinstance(scale, Tensor) and scale.ndim else scale
    offset = (alpha * deficit).clamp(-MAX_DISPLACEMENT, MAX_DISPLACEMENT)
    return points.index_add(0, rows, offset[:, None] * unit_direction(sample.gradient[rows]))


def pushed_rows(distance: Tensor, margin: float) -> Tensor:
    """Which points a push moves, int64, shape (R,): those with f < ε."""
    return torch.nonzero(distance.detach() < margin)[:, 0]


def unit_direction(gradient: Tensor) -> Tensor:
    """∇f/|∇f| (paper, Eq. 3), shape (…, 3); up where that isn't defined. Finite, and so are its derivatives."""
    length = torch.linalg.vector_norm(gradient.detach(), dim=-1, keepdim=True)
    defined = torch.isfinite(length) & (length > torch.finfo(gradient.dtype).tiny ** 0.5)
    # Replacing it before normalising keeps NaN out of the branch that isn't taken, and so out of the derivative.
    usable = torch.where(defined, gradient, gradient.new_tensor(_UP))
    direction: Tensor = usable / torch.linalg.vector_norm(usable, dim=-1, keepdim=True)
    return direction


def _check(points: Tensor, sample: SdfSample, scale: float | Tensor, margin: float) -> None:
    require_tensor("points", points)
    require_type(sample, SdfSample, "an SdfSample, as the query of a signed distance gives", error=MeshError)
    require_margin(margin)
    n = len(points)
    if points.shape != (n, 3) or sample.distance.shape != (n,) or sample.gradient.shape != (n, 3):
        msg = (
            f"points and gradient must have the shape (N, 3), distance (N,); got {tuple(points.shape)}, "
            f"{tuple(sample.gradient.shape)} and {tuple(sample.distance.shape)}"
        )
        raise MeshError(msg)
    if not points.dtype == sample.distance.dtype == sample.gradient.dtype:
        got = f"{points.dtype} and {sample.distance.dtype}, {sample.gradient.dtype}"
        raise MeshError(f"points and their sample must be of one type, got {got}: query points of that type")
    if isinstance(scale, Tensor) and scale.shape not in ((), (n,)):
        raise MeshError(f"scale must be one number or have the shape ({n},), got {tuple(scale.shape)}")


def require_margin(margin: object) -> None:
    """Raises `MeshError` for what isn't a margin: one number of 0 m or more, or a tensor of one."""
    require_type(margin, (Real, Tensor), "a margin in metres", error=MeshError)
    if not 0 <= margin < math.inf:  # type: ignore[operator]
        raise MeshError(f"the margin must not be negative: wanted a margin of 0 m or more, got {margin}")
