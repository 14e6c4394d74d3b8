"""What a viewer shows: shapes at times, from any source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

BODY, SKIN = "body", "skin"
"""Names of shapes that aren't garments: the collider, and the posed body as it is."""
_CACHE_BYTES = 512 << 20
Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class SceneMesh:
    """A mesh of one person in one frame."""

    name: str
    """Name of the garment, or `BODY` or `SKIN`."""
    person: str
    """Name of the person; empty if there is only one."""
    vertices: NDArray[np.float32]
    """[m], shape (V, 3): z up, relative to a fixed origin near the people, so that precision isn't lost."""
    faces: NDArray[np.int64]
    """Counter-clockwise from outside, shape (F, 3)."""
    color: tuple[float, float, float]
    """sRGB, 0 to 1."""

    @property
    def is_garment(self) -> bool:
        """Whether it is a garment."""
        return self.name not in (BODY, SKIN)


class Film(Protocol):
    """Frames that can be asked for in any order, from one thread."""

    @property
    def times(self) -> NDArray[np.float64]:
        """Time of each frame, from the first one on [s], shape (T,), T > 0."""

    @property
    def title(self) -> str:
        """What is shown, as a title for the user."""

    @property
    def front(self) -> float:
        """Where the first person faces at the beginning: the angle from x towards y [rad]."""

    def shapes(self, index: int) -> Sequence[SceneMesh]:
        """Everything in a frame; a person who isn't there has no shapes. Raises `RefuError`."""

    def facts(self, index: int) -> list[str]:
        """Facts about a frame, one a line."""


def remembering(make: Callable[[int], Made], *, frame_bytes: int) -> Callable[[int], Made]:
    """`make`, which keeps what it made of the frames used last: half a gigabyte of frames of such a size."""
    return lru_cache(max(1, _CACHE_BYTES // max(1, frame_bytes)))(make)
