"""The post-processes that ReFU is compared with, against dense least squares written out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from refu_core.errors import MeshError
from refu_core.sdf import ExactSdf, SdfSample
from refu_lab.baselines import PostProcess

RADIUS = 0.1


def ball(points: Tensor) -> SdfSample:
    """The distance to a ball around the origin, which is known by hand."""
    length = points.norm(dim=-1)
    return SdfSample(length - RADIUS, points / length[:, None])


@pytest.fixture(scope="module")
def cloth() -> tuple[Tensor, Tensor]:
    """A noisy cap of a few mm to either side of the ball, vertices and faces."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    cap = mesh.submesh([np.flatnonzero(mesh.triangles_center[:, 1] > 0.2)], append=True)
    rng = np.random.default_rng(0)
    heights = RADIUS + 0.004 + 0.006 * rng.normal(size=(len(cap.vertices), 1))
    return torch.tensor(cap.vertices * heights, dtype=torch.float32), torch.tensor(cap.faces)


def laplacian_of(faces: Tensor, n: int) -> NDArray[np.float64]:
    around: list[set[int]] = [set() for _ in range(n)]
    for face in faces.tolist():
        for vertex in face:
            around[vertex] |= set(face) - {vertex}
    matrix = np.eye(n)
    for i, neighbours in enumerate(around):
        for k in neighbours:
            matrix[i, k] = -1 / len(neighbours)
    return matrix


@pytest.mark.parametrize(("clearance", "reach"), [(0.001, 0.0), (0.004, 0.004)])
def test_optimisation_solves_drapes_least_squares(cloth: tuple[Tensor, Tensor], clearance: float, reach: float) -> None:
    points, faces = cloth
    n = len(points)
    laplacian = np.kron(laplacian_of(faces, n), np.eye(3))
    y = points.double().numpy()
    for smoothness, damping in ((4.0, 0.8), (2.0, 0.6), (1.0, 0.4)):
        length = np.linalg.norm(y, axis=1)
        inside = np.flatnonzero(length < RADIUS + reach)
        normal = y / length[:, None]
        closest = RADIUS * normal
        push, wanted = np.zeros((len(inside), 3 * n)), np.zeros(len(inside))
        for row, i in enumerate(inside):
            push[row, 3 * i : 3 * i + 3] = normal[i]
            wanted[row] = normal[i] @ closest[i] + clearance
        rows = np.vstack([push, np.sqrt(smoothness) * laplacian, np.sqrt(damping) * np.eye(3 * n)])
        target = np.concatenate([wanted, np.sqrt(smoothness) * laplacian @ y.ravel(), np.sqrt(damping) * y.ravel()])
        y = np.linalg.lstsq(rows, target, rcond=None)[0].reshape(n, 3)
    done = PostProcess(faces, n).optimise(points, ball, clearance=clearance, reach=reach)
    torch.testing.assert_close(done.double(), torch.tensor(y), atol=1e-5, rtol=0)
    assert (done.norm(dim=1) < RADIUS).sum() < 0.5 * (points.norm(dim=1) < RADIUS).sum()


def test_on_an_exact_distance_most_is_outside_and_the_rest_of_the_cloth_follows(cloth: tuple[Tensor, Tensor]) -> None:
    points, faces = cloth
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    process = PostProcess(faces, len(points))
    before = sdf.query(points).distance
    done = process.optimise(points, sdf.query, clearance=0.004)
    assert (sdf.query(done).distance < 0).sum() < 0.4 * (before < 0).sum()
    assert (done != points).all(dim=1)[before > 0.002].any()


def test_nothing_inside_nothing_done(cloth: tuple[Tensor, Tensor]) -> None:
    points, faces = cloth
    process = PostProcess(faces, len(points))
    outside = 1.5 * points
    assert torch.equal(process.optimise(outside, ball), outside)


def test_refuses_faces_of_other_vertices(cloth: tuple[Tensor, Tensor]) -> None:
    points, faces = cloth
    with pytest.raises(MeshError, match="index vertices 0 to 4"):
        PostProcess(faces, 5)
    with pytest.raises(MeshError, match=r"integers of shape \(F, 3\)"):
        PostProcess(faces[:, :2], len(points))
