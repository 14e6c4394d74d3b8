"""What the rest of the project knows of a signed distance."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

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

    def update(self, vertices: Tensor) -> None:
        """Takes over a new pose: the body's vertices [m], shape (V, 3)."""
        ...

    def query(self, points: Tensor) -> SdfSample:
        """Distance and gradient at `points` [m], shape (N, 3), in the frame of the body's vertices."""
        ...
