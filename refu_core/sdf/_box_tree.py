"""A tree of boxes around a body's faces, eight to a node: built for one pose, fitted to all others."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Repeated, as_warp, memory
from refu_core.errors import MeshError
from refu_core.mesh import grouped_at_rest
from refu_core.sdf._box_kernels import MAX_FACES, WIDTH, Boxes, Eight, fit_kernel

_WIDTH = int(WIDTH)


class BoxTree:
    """The boxes that `closest_in_boxes` reads, on a CPU."""

    def __init__(self, faces: Tensor, rest: Tensor) -> None:
        """For `faces`, int32, shape (F, 3), grouped by where they are in a pose with the vertices `rest` (V, 3) [m].

        Faces that are close together there should be so in all poses; this affects speed alone.

        Raises `MeshError` for more faces than it has room for.
        """
        n = len(faces)
        if n > MAX_FACES:
            raise MeshError(f"a tree of boxes holds {MAX_FACES} faces, got {n}: simplify the body")
        depth = 0
        while _WIDTH ** (depth + 1) < n:
            depth += 1
        n_above = sum(_WIDTH**level for level in range(depth))  # nodes whose children are nodes
        corners = rest.detach().cpu().numpy()[faces.numpy()]
        order = grouped_at_rest(0.5 * (corners.min(1) + corners.max(1)), _WIDTH)
        self._order = torch.from_numpy(order.astype(np.int32))
        self._bounds = memory(n_above + -(-n // _WIDTH), 6, _WIDTH)
        self._bounds[:, :3], self._bounds[:, 3:] = torch.inf, -torch.inf
        self.boxes: Any = Boxes()
        """The boxes as kernels take them."""
        self.boxes.bounds = wp.from_torch(self._bounds, dtype=Eight)
        self.boxes.order = as_warp(self._order, wp.int32)
        self.boxes.first = _WIDTH * n_above + 1
        self._fit = Repeated(fit_kernel, (wp.vec3, wp.float32), [as_warp(faces, wp.int32), self.boxes])

    def fit(self, points: Tensor) -> None:
        """Fits the boxes to a pose with the vertices `points` (V, 3) [m]."""
        self._fit((1,), points, self._bounds)
