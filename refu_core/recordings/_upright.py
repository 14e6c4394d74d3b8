"""Which way is up, judged by the people, who stand most of the time."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from refu_core.frames import MAX_ANGLE

Array = NDArray[np.float64]

Axes = Literal["auto", "smpl", "z-up", "y-down", "z-down", "frame"]
"""What root orientations and translations are expressed in: `smpl` (y up), `z-up` (AMASS, ROS), `y-down` (a camera's
optical frame), `z-down` (Motion-X). `auto` judges by the people; `frame` leaves the numbers as they are, whatever they
mean."""
AXES: tuple[Axes, ...] = get_args(Axes)

PELVIS = np.array([0.0, -0.22, 0.02])
"""SMPL's pelvis at rest [m], shape (3,), within 5 mm of the built-in bodies' for any betas. The root turns about it,
and a translation is added afterwards."""
PELVIS_OF_SMPLX = np.array([0.003, -0.351, 0.012])
"""SMPL-X's pelvis [m], shape (3,), for the neutral mean shape, from open projects' tables of its joints."""
_TURNS: dict[str, Array] = {
    "z-up": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),  # as vertices_smpl_from_ros, so nothing changes in ROS axes
    "y-down": np.diag([1.0, -1, -1]),
    "z-down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
_BY_AXIS: dict[str, Axes] = {"+y": "smpl", "+z": "z-up", "-y": "y-down", "-z": "z-down"}
_SAID = {"+z": "z up", "-y": "y down, as a camera has it", "-z": "z down, as Motion-X has it"}
_CLEAR = 0.6
"""An axis is up if the mean of the up vectors is at least this long along it. People who walk, reach and squat have
0.9 and more; a clip with a quarter of its time on the floor still has 0.7."""
_LEANS = 0.9
"""A standing person whose mean cosine to the vertical is below this leans: the camera is tilted by 26° or more."""
_UP = 0.5
"""Cosine between body and vertical above which a person is upright."""


def _are_sound(roots: Array) -> NDArray[np.bool_]:
    """Which roots are small enough to compute with; NaN isn't."""
    sound: NDArray[np.bool_] = np.abs(roots).max(axis=1) <= MAX_ANGLE
    return sound


def up_of_root(roots: Array) -> Array:
    """The body's upward directions, shape (T, 3), for root rotation vectors [rad], shape (T, 3)."""
    return Rotation.from_rotvec(roots).apply([0.0, 1.0, 0.0])


def upright_share(roots: Array, up: ArrayLike = (0.0, 1.0, 0.0)) -> float:
    """Share of frames, 0 to 1, with roots (T, 3) [rad] upright in axes where `up` (3,) is; 1 if no frame is finite."""
    roots = roots[_are_sound(roots)]
    return float((up_of_root(roots) @ np.asarray(up) > _UP).mean()) if len(roots) else 1.0


def axis_of(roots: Array) -> str:
    """The axis that people stand along by their roots (T, 3) [rad], such as `+y`; empty if none is clear."""
    roots = roots[_are_sound(roots)]
    if not len(roots):
        return ""
    mean = up_of_root(roots).mean(axis=0)
    axis = int(np.abs(mean).argmax())
    return f"{'+' if mean[axis] > 0 else '-'}{'xyz'[axis]}" if abs(mean[axis]) >= _CLEAR else ""


def upright_turn(roots: Array) -> Array:
    """The rotation (3, 3) to SMPL's axes from the axes that people stand in; the identity if these aren't clear."""
    return _TURNS.get(_BY_AXIS.get(axis_of(roots), ""), np.eye(3))


def turn_from(up: Array) -> Array:
    """The rotation (3, 3) to SMPL's axes from those in which `up`, shape (3,), is up; the identity if none fits."""
    return next((turn for turn in _TURNS.values() if turn[1] @ up > _CLEAR), np.eye(3))


def to_smpl(
    roots: Array, transl: Array, axes: Axes, notes: list[str], *, usual: Axes, pelvis: Array
) -> tuple[Array, Array]:
    """Roots [rad] and translations [m], shapes (T, 3), in SMPL's axes.

    `usual` are the axes of such files where the motion doesn't show them; a root turns about `pelvis` (3,) [m].
    """
    if axes == "frame":
        return roots, transl
    chosen: str = axes
    lies = False
    if axes == "auto":
        axis = axis_of(roots)
        chosen = _BY_AXIS.get(axis, usual)
        if axis in _SAID:
            notes.append(f"the person stands along {axis}: taken as {_SAID[axis]} (--input-axes says it otherwise)")
        elif axis != "+y":
            seen = f"the person lies along {axis}" if axis else "it doesn't show which way is up"
            notes.append(f"{seen}: taken as {'y' if chosen == 'smpl' else 'z'} up (--input-axes says it otherwise)")
            lies = True
    turn = _TURNS.get(chosen)
    if turn is not None:
        there = _are_sound(roots)
        turned = roots.copy()
        if there.any():
            turned[there] = (Rotation.from_matrix(turn) * Rotation.from_rotvec(roots[there])).as_rotvec()
        roots, transl = turned, transl @ turn.T + (turn - np.eye(3)) @ pelvis
    sound = roots[_are_sound(roots)]
    if lies or not len(sound):
        return roots, transl
    share, lean = upright_share(sound), float(up_of_root(sound)[:, 1].mean())
    if share < 0.5:
        notes.append(f"the person is upright in {100 * share:.0f} % of the frames only")
    elif lean < _LEANS:
        notes.append(f"the person leans by {np.degrees(np.arccos(lean)):.0f}° on average: perhaps the camera is tilted")
    return roots, transl
