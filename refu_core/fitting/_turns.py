"""Rotations that may bring a mesh upright, with its front along z."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from refu_core.fitting._mesh_file import SurfaceMesh
from refu_core.mesh import face_normals

F64 = NDArray[np.float64]

_ASKEW = np.radians(10)
"""A garment stands askew if its breadth is turned farther than this from an axis [rad]."""
_BROADER = 1.7
"""A garment's breadth shows only if the variance along it is more than this many times that along its depth."""


def turns_of(up: str | None, mesh: SurfaceMesh, *, is_placed: bool) -> list[F64]:
    """Rotations that may bring a mesh upright and to face z; the likeliest first. A placed mesh faces z."""
    z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    bases = {"y": [np.eye(3)], "z": [z_up], None: [np.eye(3), z_up]}[up]
    if is_placed:
        return bases
    found = [_about_y(quarters * np.pi / 2) @ base for quarters in (0, 2, 1, -1) for base in bases]
    askew = [(_skew(mesh, base), base) for base in bases]
    return found + [_about_y(half - angle) @ base for half in (0, np.pi) for angle, base in askew if angle]


def _about_y(angle: float) -> F64:
    cos, sin = np.cos(angle).round(12), np.sin(angle).round(12)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


LYING = [
    _about_y(quarters * np.pi / 2) @ np.array(base, np.float64)
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
