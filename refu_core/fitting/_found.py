"""A place on the body that was found for a mesh."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from refu_core.fitting._mesh_file import F64
from refu_core.fitting._placing import UNITS
from refu_core.fitting._posed import LEFT_HIP, RIGHT_ELBOW, RIGHT_SHOULDER
from refu_core.fitting._surround import Fit
from refu_core.fitting._ways import is_backward, is_sideways_turn

TOLERANCE = 0.015
"""A mesh is taken as it is unless something else fits this much better, as a share of its size."""


@dataclass(frozen=True, eq=False)
class Place:
    """x_body = unit · turn x + shift, on the body in `pose`."""

    unit: float
    turn: F64
    """Rotation, shape (3, 3)."""
    kind: str
    """How it was placed: as it is (empty), moved from a `floor`, or `searched`."""
    shift: F64
    """[m], shape (3,)."""
    lift: float
    """How much higher it is than by convention [m]: its wearer, or the origin of their model, was another."""
    pose: F64
    """Rotation vectors [rad], shape (24, 3)."""
    fit: Fit
    top: float
    """How high the mesh reaches [m]."""
    notes: list[str] = field(default_factory=list)
    """What was found out, one sentence each."""

    def is_like(self, other: Place) -> bool:
        """Whether it has the same unit and axes, and was placed in the same way."""
        is_as_large = (self.unit, self.kind) == (other.unit, other.kind)
        return is_as_large and bool(np.array_equal(self.turn, other.turn))

    def faces_as(self, other: Place) -> bool:
        """Whether it has the same axes, but for what a trunk may be turned."""
        return bool(np.allclose(self.turn, other.turn, atol=0.5))

    @property
    def is_sideways(self) -> bool:
        """Whether the mesh would have been modelled facing x, as nobody does."""
        return is_sideways_turn(self.turn)

    def cost(self, extent: float) -> float:
        """The cost as a share of the garment's size; otherwise the smallest size would always be nearest to the skin.

        What nobody does without need counts, too: modelling a garment backward, sideways or askew, with spread legs,
        hanging or bent arms, or for a body of another height.
        """
        arms, legs = np.abs(self.pose[[RIGHT_SHOULDER, RIGHT_ELBOW], 1:]).sum(), abs(self.pose[LEFT_HIP, 2])
        askew = np.arccos(min(1.0, np.abs(self.turn[0]).max()))
        turned = 0.02 * self.is_sideways + 0.005 * (is_backward(self.turn) + askew)
        without_need = turned + 0.1 * legs + 0.005 * arms + TOLERANCE * (self.lift != 0)
        return float(self.fit.cost / (self.unit * extent) + without_need)

    def __call__(self, vertices: F64) -> F64:
        """Vertices (V, 3) on the body [m]."""
        found: F64 = self.unit * vertices @ self.turn.T + self.shift
        return found


def told(place: Place) -> Place:
    """The place with what was found out, in words."""
    notes = []
    name = next((name for name, unit in UNITS.items() if np.isclose(unit, place.unit)), None)
    if name != "m":
        notes.append(f"lengths are {name}" if name else f"scaled by {place.unit:.4g}, which is no unit")
    turn = place.turn
    if not np.allclose(turn, np.eye(3)):
        k = int(np.abs(turn[1]).argmax())
        up = f"{'-' if turn[1, k] < 0 else ''}{'xyz'[k]}"
        front = turn.T @ [0.0, 0.0, 1.0]
        axis = int(np.abs(front).argmax())
        askew = np.degrees(np.arccos(min(1.0, abs(front[axis]))))
        about = f"{askew:.0f}° off " if askew > 1 else ""
        notes.append(f"{up} is up and {about}{'+' if front[axis] > 0 else '-'}{'xyz'[axis]} is in front")
    if place.kind == "floor":
        notes.append("it stood with the floor at 0 and was moved to the body's feet")
        if place.lift:
            notes[-1] += f", and {1e3 * abs(place.lift):.0f} mm {'up' if place.lift > 0 else 'down'} from there"
    elif np.abs(place.shift).max() > 1e-3:
        notes.append("moved by ({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * place.shift)))
    forward, arms, elbows, legs = np.degrees(
        [*place.pose[RIGHT_SHOULDER, 1:], place.pose[RIGHT_ELBOW, 1], place.pose[LEFT_HIP, 2]]
    )
    if max(abs(arms), abs(forward), elbows, legs) > 3:
        bent = f", {forward:.0f}° forward and bent by {elbows:.0f}°" if max(abs(forward), elbows) > 3 else ""
        notes.append(f"modelled with arms {arms:.0f}° down{bent} and legs {legs:.0f}° apart; brought into the T-pose")
    return replace(place, notes=notes)
