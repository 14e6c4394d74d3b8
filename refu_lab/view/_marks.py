"""Colours with a meaning: what collides, and how far cloth is from the skin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.metrics import CollisionChecker
from refu_core.modes import Choice
from refu_core.sdf import ExactSdf
from refu_lab.render import COLLIDING
from refu_lab.view._film import SceneMesh

Colour = tuple[float, float, float]


class Marking(Choice):
    """What garments are coloured by."""

    CLOTH = "cloth"
    """Their own colours."""
    COLLISIONS = "collisions"
    """The same, but faces that collide with the body, by an exact check, are red."""
    CLEARANCE = "clearance"
    """Distance to the body."""


CLEARANCE: tuple[tuple[float, Colour], ...] = (
    (0.0, COLLIDING),
    (0.003, (0.27, 0.13, 0.42)),
    (0.006, (0.22, 0.36, 0.56)),
    (0.012, (0.13, 0.56, 0.55)),
    (0.025, (0.36, 0.73, 0.40)),
    (0.050, (0.70, 0.84, 0.26)),
    (np.inf, (0.99, 0.91, 0.30)),
)
"""Bands of distance to the body: each band's upper limit [m] and colour. On a smooth scale nobody could tell which of
two neighbours is farther off. A margin of 4 mm lies in the middle of a band."""


@dataclass(frozen=True, eq=False)
class Band:
    """Faces of a garment that share a colour."""

    faces: NDArray[np.int64]
    """Shape (K, 3), K may be 0."""
    color: Colour


class BandFinder:
    """Finds the bands of garments on one person's body at a time; keeps what it has prepared for a topology."""

    def __init__(self) -> None:
        self._checkers: dict[int, tuple[NDArray[np.int64], CollisionChecker, ExactSdf]] = {}

    def bands(self, marking: Marking, garments: Sequence[SceneMesh], body: SceneMesh | None) -> list[list[Band]]:
        """The bands of each garment of a person; their number depends only on the marking.

        Raises `MeshError` for a body that isn't a closed surface.
        """
        if marking == Marking.CLOTH or body is None:
            return [[Band(one.faces, one.color)] for one in garments]
        checker, sdf = self._prepared(body.faces)
        if marking == Marking.COLLISIONS:
            checker.update(body.vertices)
            return [_colliding(checker, one) for one in garments]
        sdf.update(torch.from_numpy(body.vertices))
        return [_clearance(sdf, one) for one in garments]

    def _prepared(self, faces: NDArray[np.int64]) -> tuple[CollisionChecker, ExactSdf]:
        # A film hands out the same array again and again, so comparing identities is enough.
        known = self._checkers.get(id(faces))
        if known is None or known[0] is not faces:
            known = faces, CollisionChecker(faces), ExactSdf(faces, sign="winding")
            self._checkers = {**dict(list(self._checkers.items())[-3:]), id(faces): known}
        return known[1:]


def _colliding(checker: CollisionChecker, garment: SceneMesh) -> list[Band]:
    found = checker.check(garment.vertices, garment.faces)
    bad: NDArray[np.bool_] = np.zeros(len(garment.faces), bool)
    bad[found.pairs[:, 0]] = True
    bad |= found.inside[garment.faces].any(1)
    return [Band(garment.faces[~bad], garment.color), Band(garment.faces[bad], COLLIDING)]


def _clearance(sdf: ExactSdf, garment: SceneMesh) -> list[Band]:
    distance = sdf.query(torch.from_numpy(garment.vertices)).distance.numpy()
    limits = [limit for limit, _ in CLEARANCE[:-1]]
    band = np.searchsorted(limits, distance[garment.faces].min(1))
    return [Band(garment.faces[band == k], color) for k, (_, color) in enumerate(CLEARANCE)]
