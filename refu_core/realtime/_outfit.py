"""Garments that one person wears together: which is over which, and how an outer one is brought off the inner ones."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from refu_core.garments import GarmentTemplate, inner_first
from refu_core.repulsion import Layer


class Outfit:
    """Brings garments off those that are worn below them."""

    def __init__(self, garments: Mapping[str, GarmentTemplate]) -> None:
        """Prepares each pair of `garments`, by name."""
        self.order = inner_first(garments)
        """Names from the skin outwards."""
        self._below: dict[str, dict[str, Layer]] = {}
        for i, name in enumerate(self.order):
            outer = garments[name]
            self._below[name] = {
                inner: Layer(outer.faces, outer.v_template, garments[inner].faces, garments[inner].v_template)
                for inner in self.order[:i]
            }

    def lift(self, name: str, vertices: Tensor, worn: Mapping[str, Tensor]) -> tuple[Tensor, int]:
        """The vertices (V, 3) [m] of garment `name` off the inner garments, and how many were too near one of those.

        `worn` has the vertices of the inner garments.
        """
        n_layered = 0
        for inner, layer in self._below[name].items():
            vertices, n_low = layer(vertices, worn[inner])
            n_layered += n_low
        return vertices, n_layered

    def queued(self, name: str, vertices: Tensor, worn: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The same of a GPU that isn't waited for, the number of shape (1,)."""
        n_layered = torch.zeros(1, dtype=torch.int32, device=vertices.device)
        for inner, layer in self._below[name].items():
            vertices, n_low = layer.queued(vertices, worn[inner])
            n_layered = n_layered + n_low
        return vertices, n_layered
