"""What the rest of the project knows of a signed distance."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from refu_core.errors import MeshError
from refu_core.garments import GarmentTemplate


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
    """The signed distance function f of one posed body (paper, Eq. 1 and Sec. 3.3)."""

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

    def of_garment(self, garment: GarmentTemplate) -> GarmentSdf:
        """The same distance for all vertices of one garment, about which much is known beforehand."""
        ...


class GarmentSdf(Protocol):
    """The signed distance of a garment's vertices to one posed body."""

    def __call__(self, vertices: Tensor, *, on_mean: Tensor, reach: float = math.inf) -> SdfSample:
        """Distance and gradient of posed vertices [m], shape (N, 3), in the frame of the body's. Not differentiable.

        `on_mean` is where they are on the unposed mean shape [m], shape (N, 3). Distances beyond `reach` [m] may be
        clipped from above; such a sample's face is -1.
        """
        ...


def plain_garment_sdf(sdf: BodySdf) -> GarmentSdf:
    """The `GarmentSdf` of a distance that treats a garment's vertices like any other points."""

    def ask(vertices: Tensor, *, on_mean: Tensor, reach: float = math.inf) -> SdfSample:  # noqa: ARG001
        return sdf.query(vertices)

    return ask


def query_batch(
    sdf: BodySdf,
    vertices: Tensor,
    points: Tensor,
    *,
    near: Tensor | None = None,
    pose: Tensor | None = None,
    betas: Tensor | None = None,
) -> SdfSample:
    """Queries `sdf` for a batch of bodies, each at points of its own; the shapes of the fields begin with (B, N).

    Bodies are queried one after the other: derivatives of all are kept, and `sdf` is left at the last one. They have
    `vertices` (B, V, 3) [m] and are queried at `points` (B, N, 3) [m], with `near` faces (N,) for all or (B, N); `pose`
    (B, 24, 3) [rad] and `betas` (B, 10) are what they were posed by.

    Without bodies, B = 0, `sdf` isn't asked, and names no faces. Raises `MeshError` for another number of bodies than
    of points, and as `sdf`.
    """
    if len(vertices) != len(points):
        raise MeshError(f"wanted points of {len(vertices)} bodies, (B, N, 3), got the shape {tuple(points.shape)}")
    if not len(vertices):
        if points.ndim != 3 or points.shape[2] != 3:
            raise MeshError(f"wanted points (0, N, 3) of no bodies, got the shape {tuple(points.shape)}")
        return SdfSample(points[..., 0] + vertices.sum(), points + vertices.sum())  # empty, with derivatives in both
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
