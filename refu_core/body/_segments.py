"""The segments of a body as closed solids, which push each other apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from refu_core._cache import remembered
from refu_core.body._parts import joints_of
from refu_core.mesh import linked, rim_of

SOFTNESS: tuple[tuple[tuple[int, ...], float], ...] = (
    ((0, 3), 1.0),
    ((6, 9, 13, 14), 1.0),
    (joints_of("head"), 0.5),
    (joints_of("left_upper_arm"), 1.0),
    (joints_of("right_upper_arm"), 1.0),
    ((18,), 0.7),
    ((19,), 0.7),
    ((20, 22), 0.25),
    ((21, 23), 0.25),
    (joints_of("left_thigh"), 1.0),
    (joints_of("right_thigh"), 1.0),
    ((4,), 0.7),
    ((5,), 0.7),
    ((7, 10), 0.25),
    ((8, 11), 0.25),
)
"""Joints of the segments that give way to each other, and their softness: of two, each gives way by its share of the
sum. The trunk is two segments, because a trunk that bends to the side comes down on its own hip.
Flanks and thighs are flesh; forearms and shins have bone below the skin; hands, feet and heads hardly give way."""


class Solids(NamedTuple):
    """K segments of a body, each closed by a fan to the middle of every loop that it was cut along.

    Those middles, M in all, are numbered after the body's V vertices.
    """

    of_vertex: NDArray[np.int32]
    """The segment of each vertex, shape (V,)."""
    faces: list[NDArray[np.int32]]
    """Faces of each segment, indexing V + M vertices, shape (F_k, 3)."""
    middle_start: NDArray[np.int32]
    """Where the vertices that each middle is the mean of begin in `middle_vertex`, shape (M + 1,)."""
    middle_vertex: NDArray[np.int32]


def shares(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share that each vertex has in each segment, (V, K), from skinning weights (V, 24)."""
    return np.stack([weights[:, list(joints)].sum(axis=1) for joints, _ in SOFTNESS], axis=1)


@remembered(4)
def cut(faces: NDArray[np.int32], share: NDArray[np.float64]) -> Solids:
    """Cuts a mesh of faces (F, 3) by the `share` that each vertex has in each segment, (V, K)."""
    n_vertices, n_segments = share.shape
    of_vertex = share.argmax(axis=1).astype(np.int32)
    of_face = share[faces].sum(axis=1).argmax(axis=1)
    closed, loops = [], []
    n_points = n_vertices
    for segment in range(n_segments):
        own = faces[of_face == segment]
        on_rim = rim_of(own)
        start, end = own[on_rim], np.roll(own, -1, axis=1)[on_rim]
        _, loop = linked(np.stack((start, end), axis=1), n_vertices)
        caps = []
        for one in np.unique(loop[start]):
            on = loop[start] == one
            loops.append(np.unique(start[on]))
            caps.append(np.stack([end[on], start[on], np.full(on.sum(), n_points)], axis=1))
            n_points += 1
        closed.append(np.concatenate([own, *caps]).astype(np.int32))
    sizes = [len(loop) for loop in loops]
    return Solids(
        of_vertex, closed, np.cumsum([0, *sizes]).astype(np.int32), np.concatenate([*loops, []]).astype(np.int32)
    )
