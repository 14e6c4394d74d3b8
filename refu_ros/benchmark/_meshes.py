"""A garment with fewer or more vertices, otherwise alike."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from refu_core.garments import GarmentTemplate


def resized(garment: GarmentTemplate, size: float) -> GarmentTemplate:
    """With `size` times the vertices, about: below 1 its upper part, above 1 with every triangle cut into four."""
    if size < 1:
        return _upper_part(garment, size)
    return _cut_in_four(garment) if size > 1 else garment


def _upper_part(garment: GarmentTemplate, share: float) -> GarmentTemplate:
    height = garment.v_template[garment.faces, 1].mean(1)
    faces = garment.faces[height >= height.quantile(1 - share)]
    kept, faces = torch.unique(faces, return_inverse=True)
    return _of_rows(garment, faces, torch.stack((kept, kept), 1))


def _cut_in_four(garment: GarmentTemplate) -> GarmentTemplate:
    n, edges = garment.n_vertices, garment.edges
    number = {tuple(edge): n + i for i, edge in enumerate(edges.tolist())}
    faces = []
    for a, b, c in garment.faces.tolist():
        ab, bc, ca = (number[min(i, j), max(i, j)] for i, j in ((a, b), (b, c), (c, a)))
        faces += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    own = torch.arange(n)
    return _of_rows(garment, torch.tensor(faces), torch.cat((torch.stack((own, own), 1), edges)))


def _of_rows(garment: GarmentTemplate, faces: Tensor, ends: Tensor) -> GarmentTemplate:
    """The garment whose vertices are the middles of pairs (V', 2) of its vertices."""

    def middle(values: Tensor) -> Tensor:
        return values[ends].mean(1)

    shapedirs = garment.shapedirs.view(garment.n_vertices, 3, -1)
    return replace(
        garment,
        faces=faces,
        weights=middle(garment.weights),
        v_template=middle(garment.v_template),
        shapedirs=middle(shapedirs).reshape(3 * len(ends), -1),
        styledirs=None,
    )
