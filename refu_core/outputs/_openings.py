"""A garment's openings as frames: where a sleeve ends, which way it faces, and how wide it is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from refu_core.mesh import as_points
from refu_core.outputs._rings import Ring, newell, rings_of

if TYPE_CHECKING:
    from refu_core.garments import GarmentTemplate

_FLAT = 0.1
"""A ring with less than this share of the area of a circle of the same length is drawn together. Its direction is then
taken more and more from the cloth beside it."""


@dataclass(frozen=True, eq=False)
class Opening:
    """One opening of a garment in one frame, in the axes of the vertices that were given."""

    name: str
    """`neck`, `left_sleeve`, `right_sleeve`, `waist`, `hem`, `left_leg`, `right_leg`, `front` (between the edges of a
    coat that is open), or `opening_0`, …"""
    centre: NDArray[np.float64]
    """Centre of the rim [m], shape (3,)."""
    rotation: NDArray[np.float64]
    """Columns are the frame's x, y and z, shape (3, 3): z points out of the garment, through the opening. In the rest
    pose x points to the wearer's left, or for a sleeve to the front; from there it moves with the cloth."""
    width: float
    """Extent of the rim along x [m]."""
    height: float
    """Extent of the rim along y [m]."""
    perimeter: float
    """Length of the rim [m]."""
    ring: NDArray[np.float64]
    """The rim's vertices in order, counter-clockwise as seen against z [m], shape (K, 3); the last is joined to the
    first."""


class Openings:
    """The openings of one garment, found once from its boundary; a frame then takes a fraction of a millisecond.

    Each is recognised by geometry and skinning weights, whatever the garment is called: a sleeve is moved by an arm and
    opens away from the trunk. The boundary of an open coat is one loop, which is cut into neck, hem and front.

    Centre and x are linear in the rim's vertices, with weights from the rest pose, so they are as steady as the cloth.
    """

    def __init__(self, garment: GarmentTemplate) -> None:
        """For any garment, the project's or a user's own; one without a boundary has no openings."""
        rest = garment.v_template.detach().cpu().double().numpy()
        self._n_vertices = len(rest)
        rings = rings_of(garment)
        self.names: tuple[str, ...] = tuple(rings)
        """Names of the openings, in the order of `frames`."""
        self._rings = [(name, ring, _along(ring, rest)) for name, ring in rings.items()]

    def frames(self, vertices: Any) -> tuple[Opening, ...]:
        """The openings of a garment as it is worn, in the right-handed axes of its `vertices` (V, 3) [m].

        Raises `MeshError` for anything but finite numbers of that shape.
        """
        points = as_points("the garment's vertices", vertices, self._n_vertices)
        return tuple(_frame(name, ring, along, points) for name, ring, along in self._rings)


def _along(ring: Ring, rest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights (K,) with which the rim's vertices add up to the opening's x, in the rest pose and as the cloth moves."""
    points = rest[ring.vertices]
    area = newell(points)
    normal = area / max(float(np.linalg.norm(area)), 1e-12)
    wanted = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.7 else np.array([0, 0, 1.0])
    wanted -= (wanted @ normal) * normal
    middle = points - ring.shares @ points
    spread = (ring.shares[:, None] * middle).T @ middle
    weight: NDArray[np.float64] = ring.shares * (middle @ np.linalg.pinv(spread, rcond=1e-4) @ wanted)
    return weight


def _frame(name: str, ring: Ring, along: NDArray[np.float64], points: NDArray[np.float64]) -> Opening:
    rim = points[ring.vertices]
    after = np.roll(rim, -1, axis=0)
    centre = ring.shares @ rim
    away = rim - centre
    step = after - rim
    length = np.sqrt(np.einsum("ij,ij->i", step, step))
    perimeter = float(length.sum())
    area = 0.5 * np.cross(away, np.roll(away, -1, axis=0)).sum(0)
    roundness = 4 * math.pi * float(np.linalg.norm(area)) / max(perimeter, 1e-9) ** 2
    z = area
    if roundness < _FLAT:
        out = 0.5 * (rim + after) - points[ring.inner]
        out -= ((out * step).sum(1) / np.maximum(length, 1e-12) ** 2)[:, None] * step
        z = _unit(area) * roundness / _FLAT + _unit(out.sum(0)) * (1 - roundness / _FLAT)
    z = _unit(z)
    x = along @ away
    x = _unit(x - (x @ z) * z)
    y = np.cross(z, x)
    flat = away @ np.stack((x, y), axis=1)
    width, height = (flat.max(0) - flat.min(0)).tolist()
    return Opening(name, centre, np.stack((x, y, z), axis=1), width, height, perimeter, rim)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-12 else np.array([0.0, 0.0, 1.0])
