"""What bringing a garment off the body gives."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Resolution:
    """A garment off the body, and what that took."""

    vertices: Tensor
    """Garment vertices [m], shape (N, 3)."""
    distance: Tensor
    """Their signed distance [m], shape (N,); beyond the margin it may be a lower bound."""
    numbers: Tensor
    """`n_inside`, `n_pushed`, `n_unresolved` and `max_depth`, shape (4,), on the garment's device."""

    @property
    def n_inside(self) -> int:
        """Vertices inside the body before."""
        return int(self.numbers[0])

    @property
    def n_pushed(self) -> int:
        """Vertices nearer than the margin before, that were moved."""
        return int(self.numbers[1])

    @property
    def n_unresolved(self) -> int:
        """Vertices still inside: deeper than they may move, or where the body runs through itself."""
        return int(self.numbers[2])

    @property
    def max_depth(self) -> float:
        """Depth of the deepest vertex before [m], 0 where none was inside."""
        return float(self.numbers[3])
