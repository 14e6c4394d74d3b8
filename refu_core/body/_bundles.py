"""Bundles of faces that lie together, for kernels to see by boxes what is near what."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from refu_core.body._bundle_kernels import Bundles
from refu_core.mesh import grouped

_SIZE = 64
"""Faces of a bundle: with half as many, boxes take longer than they save."""


def bundled(rest: NDArray[np.floating[Any]], faces: Sequence[NDArray[np.integer[Any]]], device: torch.device) -> Any:
    """`Bundles` of groups of faces, (F_k, 3) each, which lie together in the pose `rest` (V, 3) [m]."""
    corners: list[NDArray[np.integer[Any]]] = []
    first = [0]
    for of_group in faces:
        order = grouped(rest[of_group].mean(1))
        corners += [np.unique(of_group[some]) for some in np.array_split(order, max(1, round(len(order) / _SIZE)))]
        first.append(len(corners))
    bundles = Bundles()
    bundles.first, bundles.start, bundles.corner = (
        wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=str(device))
        for values in (first, np.cumsum([0, *map(len, corners)]), np.concatenate(corners))
    )
    for name, n in (
        ("low", len(corners)),
        ("high", len(corners)),
        ("group_low", len(faces)),
        ("group_high", len(faces)),
    ):
        setattr(bundles, name, wp.zeros(n, dtype=wp.vec3, device=str(device)))
    return bundles
