"""Bundles of neighbouring faces, whose boxes tell kernels what is near what."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core._cache import remembered
from refu_core._warp import ints
from refu_core.body._bundle_kernels import Bundles
from refu_core.mesh import grouped

_SIZE = 64
"""Faces per bundle: with half as many, the boxes cost more time than they save."""


def bundled(rest: NDArray[np.floating[Any]], faces: Sequence[NDArray[np.integer[Any]]], device: torch.device) -> Any:
    """`Bundles` of groups of faces, (F_k, 3) each, bundled by how near they lie in the pose `rest` (V, 3) [m]."""
    first, corners = _corners(rest, faces)
    bundles = Bundles()
    bundles.first, bundles.start, bundles.corner = (
        ints(values, device) for values in (first, np.cumsum([0, *map(len, corners)]), np.concatenate(corners))
    )
    bundles.low, bundles.high = (wp.zeros(len(corners), dtype=wp.vec3, device=str(device)) for _ in range(2))
    bundles.group_low, bundles.group_high = (wp.zeros(len(faces), dtype=wp.vec3, device=str(device)) for _ in range(2))
    return bundles


@remembered(8)
def _corners(
    rest: NDArray[np.floating[Any]], faces: Sequence[NDArray[np.integer[Any]]]
) -> tuple[list[int], list[NDArray[np.integer[Any]]]]:
    """The first bundle of each group, and the number of all bundles; the vertices of each bundle."""
    corners: list[NDArray[np.integer[Any]]] = []
    first = [0]
    for of_group in faces:
        order = grouped(rest[of_group].mean(1))
        corners += [
            np.unique(of_group[some]) for some in np.array_split(order, max(1, len(order) // _SIZE)) if len(some)
        ]
        first.append(len(corners))
    return first, corners
