"""Turns and shifts that may bring a mesh to where it is worn."""

from __future__ import annotations

import numpy as np

from refu_core.fitting._mesh_file import F64, SurfaceMesh
from refu_core.fitting._posed import PosedBody
from refu_core.mesh import face_normals

_ASKEW = np.radians(10)
"""A garment stands askew if its breadth is turned farther than this from an axis [rad]."""
_BROADER = 1.7
"""A garment's breadth shows only if the variance along it is more than this many times that along its depth."""
LIFTS = (-0.06, 0.06, -0.12, 0.12)
"""How far a mesh is lifted when a search for its height begins [m]: between the origins of SMPL and SMPL-X, and between
the shoulders of people 1.60 and 1.75 m tall, are 12 cm."""
HIGHEST = 0.15
"""How far it is lifted at most [m]; what would have to go farther was modelled otherwise, and is searched for."""


def turns_of(up: str | None, mesh: SurfaceMesh, *, is_placed: bool) -> list[F64]:
    """Rotations that may bring a mesh upright and to face z; the likeliest first. A placed mesh faces z."""
    z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    bases = {"y": [np.eye(3)], "z": [z_up], None: [np.eye(3), z_up]}[up]
    if is_placed:
        return bases
    found = [about_y(quarters * np.pi / 2) @ base for quarters in (0, 2, 1, -1) for base in bases]
    askew = [(_skew(mesh, base), base) for base in bases]
    return found + [about_y(half - angle) @ base for half in (0, np.pi) for angle, base in askew if angle]


def about_y(angle: float) -> F64:
    """The rotation by some angle [rad] about the axis that is up."""
    cos, sin = np.cos(angle).round(12), np.sin(angle).round(12)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


ROUND = about_y(np.pi)
"""Turns a mesh round."""
LYING = [
    about_y(quarters * np.pi / 2) @ np.array(base, np.float64)
    for quarters in (0, 2, 1, -1)
    for base in (
        [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, 0, -1], [0, -1, 0]],
    )
]
"""Rotations that may set upright a mesh that lies on its side, x up or down, or stands on its head."""


def _skew(mesh: SurfaceMesh, base: F64) -> float:
    """By how much a mesh that is turned upright by `base` is askew [rad]: people are broader than deep.

    Zero where it isn't, or where its breadth doesn't show.
    """
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    flat = (mesh.vertices[mesh.faces].mean(1) @ base.T)[:, ::2]
    flat = flat - np.average(flat, axis=0, weights=area)
    (depth, breadth), axes = np.linalg.eigh((flat.T * area) @ flat)
    angle = float(np.arctan2(-axes[1, 1], axes[0, 1]))
    off_axis = abs(angle - np.pi / 2 * round(angle / (np.pi / 2)))
    return angle if breadth > _BROADER * depth and off_axis > _ASKEW else 0.0


def is_sideways_turn(turn: F64) -> bool:
    return abs(float(turn[0, 0])) < 0.5


def is_backward(turn: F64) -> bool:
    """Whether a mesh that is turned like that, with y or z up, faces where nobody's does by convention: -z or +y."""
    return float(turn[0, 0]) < -0.5 and float(turn[1].max()) > 0.5


def shifts(body: PosedBody, *, is_placed: bool) -> list[tuple[str, F64]]:
    """Where a mesh may stand by convention: with the body's origin, or on a floor below its feet."""
    found = [("", np.zeros(3)), ("floor", np.array([0.0, body.floor, 0.0]))]
    return found[:1] if is_placed else found


def heights(vertices: F64, body: PosedBody) -> list[F64]:
    """Shifts that put a mesh (V, 3) [m] round the body's middle, at all heights."""
    skin = body.vertices.double().numpy()
    low, high = vertices.min(0), vertices.max(0)
    middle = (low + high) / 2
    found = []
    for height in np.arange(skin[:, 1].min() - low[1], skin[:, 1].max() - high[1] + 0.02, 0.08):
        near = np.abs(skin[:, 1] - (middle[1] + height)) < max(0.05, (high[1] - low[1]) / 4)
        front, back = (skin[near, 2].max(), skin[near, 2].min()) if near.any() else (0.0, 0.0)
        found.append(np.array([-middle[0], height, (front + back) / 2 - middle[2]]))
    return found
