"""Distances that contradict each other along the garment's edges."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from slow_contact import mend
from torch import Tensor

from refu_core.mesh import Connectivity
from refu_core.sdf import ExactSdf, SdfSample


def sheet(n: int, spacing: float) -> tuple[Tensor, Tensor]:
    """A square sheet of n × n vertices around the origin in the plane y = 0, and its faces, seen from above."""
    x, z = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    points = torch.stack((x, torch.zeros_like(x), z), dim=-1).view(-1, 3) - torch.tensor([n - 1, 0, n - 1]) / 2
    corner = (x * n + z)[:-1, :-1].reshape(-1, 1)
    return points * spacing, torch.cat((corner + torch.tensor([0, 1, n]), corner + torch.tensor([1, n + 1, n])))


def edges_of(faces: Tensor, n_vertices: int) -> Tensor:
    return torch.from_numpy(Connectivity.of(faces, n_vertices).edges.astype(np.int64))


def test_a_closest_face_that_was_missed_is_found_from_a_neighbours() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    points, faces = sheet(15, 0.01)
    points[:, 1] += 0.097
    true = sdf.query(points)
    assert true.face is not None
    missed = (points[:, 0] > 0) & (points[:, 2].abs() < 0.015)
    wrong = true._replace(distance=torch.where(missed, 0.05, true.distance))
    asked: list[int] = []

    def look(here: Tensor, near: Tensor) -> SdfSample:
        asked.append(len(here))
        assert set(near.tolist()) <= set(true.face.tolist())  # type: ignore[union-attr]
        return sdf.query(here)

    edges = edges_of(faces, len(points))
    mended = mend(points, wrong, edges, margin=0.004, look=look)
    at_the_skin = missed & (true.distance < 0.004)
    torch.testing.assert_close(mended.distance[at_the_skin], true.distance[at_the_skin])
    torch.testing.assert_close(mended.gradient[at_the_skin], true.gradient[at_the_skin])
    assert 0 < sum(asked) < 3 * len(points)
    assert at_the_skin.sum() > 3


def test_consistent_distances_are_left_as_they_are() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    points, faces = sheet(15, 0.01)
    points[:, 1] += 0.09
    sample = sdf.query(points)
    edges = edges_of(faces, len(points))
    assert mend(points, sample, edges, margin=0.004, look=lambda here, _: sdf.query(here)) is sample
