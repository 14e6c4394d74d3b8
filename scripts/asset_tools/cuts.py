"""Where cloth ends: surfaces that a garment is cut along, and that its edges then stay on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from asset_tools.surfaces import Faces, Vertices, compact


class Cut(Protocol):
    """A surface; cloth is where `height` is positive."""

    def height(self, points: Vertices) -> NDArray[np.float64]:
        """Positive inside the garment [m], shape (P,)."""

    def project(self, points: Vertices) -> Vertices:
        """The points moved onto the surface, shape (P, 3)."""


@dataclass(frozen=True)
class Plane:
    """Keeps what lies on one side of a coordinate plane: hems, waists, sleeve ends."""

    axis: int
    at: float
    side: float
    """+1 keeps larger coordinates, -1 smaller ones."""

    def height(self, points: Vertices) -> NDArray[np.float64]:
        return self.side * (points[:, self.axis] - self.at)

    def project(self, points: Vertices) -> Vertices:
        moved = points.copy()
        moved[:, self.axis] = self.at
        return moved


@dataclass(frozen=True)
class Neckline:
    """Keeps what lies outside an upright elliptic cylinder: seen from above, the neck's opening is an ellipse.

    A cylinder that leans forward would run along the back of the neck; an upright one meets both back and chest at an
    angle, and the opening is lower in front because the chest is.
    """

    centre: tuple[float, float, float]
    half_width: float
    half_depth: float
    below: float = 0.08
    """How deep under `centre` the cylinder reaches [m]; it must not cut the chest."""

    def _ellipse(self, points: Vertices) -> NDArray[np.float64]:
        return (points - np.array(self.centre))[:, [0, 2]] / [self.half_width, self.half_depth]

    def height(self, points: Vertices) -> NDArray[np.float64]:
        under = self.centre[1] - self.below - points[:, 1]
        return np.where(under > 0, under, (np.linalg.norm(self._ellipse(points), axis=1) - 1) * self.half_width)

    def project(self, points: Vertices) -> Vertices:
        ellipse = self._ellipse(points)
        moved = points.copy()
        moved[:, [0, 2]] = ellipse / np.linalg.norm(ellipse, axis=1, keepdims=True) * [self.half_width, self.half_depth]
        moved[:, [0, 2]] += np.array(self.centre)[[0, 2]]
        return moved


def clip(v: Vertices, f: Faces, cut: Cut) -> tuple[Vertices, Faces]:
    """The part of a mesh where `cut.height` is positive, its crossed faces cut in two."""
    height = cut.height(v)
    height = np.where(np.abs(height) < 1e-9, 1e-9, height)
    inside = height > 0
    count = inside[f].sum(1)
    points, kept = list(v), list(f[count == 3])
    middle: dict[tuple[int, int], int] = {}

    def crossing(a: int, b: int) -> int:
        key = (a, b) if a < b else (b, a)
        if key not in middle:
            t = height[key[0]] / (height[key[0]] - height[key[1]])
            middle[key] = len(points)
            points.append(v[key[0]] + t * (v[key[1]] - v[key[0]]))
        return middle[key]

    for face in f[(count == 1) | (count == 2)]:
        x, y, z = (int(i) for i in face)
        lone = inside[face].sum() == 1  # one corner stays, or one goes
        while inside[x] != lone or inside[y] == lone or inside[z] == lone:
            x, y, z = y, z, x
        xy, xz = crossing(x, y), crossing(x, z)
        kept += [np.array([x, xy, xz])] if lone else [np.array([xy, y, z]), np.array([xy, z, xz])]
    used, local = compact(np.array(kept, dtype=np.int64))
    return np.array(points)[used], local
