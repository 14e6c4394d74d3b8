"""What the rest of the project knows of a signed distance."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor


class SdfSample(NamedTuple):
    """Signed distance f of some points to the body, and its gradient."""

    distance: Tensor
    """Distance to the body's surface, negative inside [m], shape (N,)."""
    gradient: Tensor
    """Unit direction in which the distance grows, shape (N, 3)."""
    face: Tensor | None = None
    """Closest face of the body, shape (N,), where the distance is to faces."""

    def rows(self, index: Tensor) -> SdfSample:
        """The sample at some of the points."""
        face = None if self.face is None else self.face[index]
        return SdfSample(self.distance[index], self.gradient[index], face)


@runtime_checkable
class BodySdf(Protocol):
    """The signed distance function f of one posed body (the paper's Sec. 3.1 and 3.3)."""

    def update(self, vertices: Tensor, *, pose: Tensor | None = None, betas: Tensor | None = None) -> None:
        """Takes over a new pose: the body's vertices [m], shape (V, 3).

        `pose` (24, 3) [rad] and `betas` (10,) are what the body was posed by; a network that stands for the body needs
        them, a distance to its faces doesn't.
        """
        ...

    def query(self, points: Tensor, *, near: Tensor | None = None) -> SdfSample:
        """Distance and gradient at `points` [m], shape (N, 3), in the frame of the body's vertices.

        `near`, integers of shape (N,), may name a body face near each point: the `face` of an earlier sample, or what
        `RestFaces` says of a garment's vertices. It is a hint, which makes some implementations fast.
        """
        ...


def query_batch(
    sdf: BodySdf,
    vertices: Tensor,
    points: Tensor,
    *,
    near: Tensor | None = None,
    pose: Tensor | None = None,
    betas: Tensor | None = None,
) -> SdfSample:
    """`sdf` of a batch of bodies at points of their own, one body after the other; fields lead with (B, N).

    Derivatives of all of them are kept, though `sdf` itself ends at the last body.

    Args:
        sdf: Any signed distance.
        vertices: Bodies [m], shape (B, V, 3).
        points: Shape (B, N, 3) [m].
        near: Near faces, shape (N,) for all bodies or (B, N).
        pose: What the bodies were posed by [rad], shape (B, 24, 3).
        betas: Their shapes, shape (B, 10).
    """
    samples = []
    for i, (body, here) in enumerate(zip(vertices, points, strict=True)):
        sdf.update(body, pose=None if pose is None else pose[i], betas=None if betas is None else betas[i])
        samples.append(sdf.query(here, near=near[i] if near is not None and near.ndim == 2 else near))
    faces = [sample.face for sample in samples if sample.face is not None]
    return SdfSample(
        torch.stack([sample.distance for sample in samples]),
        torch.stack([sample.gradient for sample in samples]),
        torch.stack(faces) if len(faces) == len(samples) else None,
    )
