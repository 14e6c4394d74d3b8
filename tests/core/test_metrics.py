"""The metrics against slow references written from the paper's words."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from refu_core.errors import MeshError
from refu_core.metrics import Collisions, GarmentMetrics

MESH = trimesh.creation.icosphere(subdivisions=1)
N, G = len(MESH.vertices), len(MESH.faces)


def random_frame(rng: np.random.Generator, *, free: bool = False) -> tuple[NDArray[np.float32], Collisions]:
    vertices = (MESH.vertices + rng.normal(scale=0.02, size=(N, 3))).astype(np.float32)
    if free:
        none = np.zeros(N, np.bool_)
        return vertices, Collisions(np.zeros((0, 2), np.int32), none[:0], none, none.astype(np.float32))
    pairs = np.unique(rng.integers(0, G, size=(12, 2)), axis=0).astype(np.int32)
    inside = rng.random(N) < 0.2
    depth = np.where(inside, rng.uniform(0.001, 0.02, N), 0).astype(np.float32)
    return vertices, Collisions(pairs, rng.random(len(pairs)) < 0.5, inside, depth)


NEIGHBOURS = [sorted({int(v) for face in MESH.faces if i in face for v in face} - {i}) for i in range(N)]


def laplacian(vertices: NDArray[np.float64], i: int) -> NDArray[np.float64]:
    return vertices[i] - np.mean(vertices[NEIGHBOURS[i]], axis=0)


def fold_energies(vertices: NDArray[np.float64]) -> list[float]:
    energies, left = [], vertices
    for n_sweeps in (1, 4, 16, 64):
        level = left
        for _ in range(n_sweeps):
            level = level - 0.5 * np.array([laplacian(level, i) for i in range(N)])
        energies.append(float(((left - level) ** 2).sum()))
        left = level
    return energies


@settings(max_examples=5)
@given(seed=st.integers(0, 2**31), n_frames=st.integers(1, 5))
def test_equals_the_slow_reference(seed: int, n_frames: int) -> None:
    rng = np.random.default_rng(seed)
    metrics = GarmentMetrics(MESH.faces)
    rows: list[dict[str, float]] = []
    energies: list[list[float]] = []
    for k in range(n_frames):
        vertices, collisions = random_frame(rng, free=k == 1)
        truth = (vertices + rng.normal(scale=0.01, size=(N, 3))).astype(np.float32)
        region = rng.random(N) < 0.5
        metrics.add(vertices, collisions, truth=truth, resolved=region)
        pairs = [(int(f), bool(is_vf)) for (f, _), is_vf in zip(collisions.pairs, collisions.pair_is_vf, strict=True)]
        a, b = vertices.astype(float), truth.astype(float)
        depth, inside = collisions.depth.tolist(), collisions.inside.tolist()
        smoothness = [np.linalg.norm(laplacian(a, i) - laplacian(b, i)) for i in range(N) if region[i]]
        rows.append(
            {
                "mpve_mm": 1e3 * float(np.mean([np.linalg.norm(a[i] - b[i]) for i in range(N)])),
                "vfcp_percent": 100 * sum(inside) / N,
                "cfmp_percent": 100.0 * (not pairs and not any(inside)),
                "avg_vf": len({face for face, is_vf in pairs if is_vf}),
                "avg_ee": len({face for face, is_vf in pairs if not is_vf}),
                "mean_energy": sum(one**2 for one in depth),
                "mean_collision_error_mm": 1e3 * sum(depth),
                "max_depth_mm": 1e3 * max(depth),
                "laplacian_mm": 1e3 * float(np.mean(smoothness)),
            }
        )
        energies += [fold_energies(a), fold_energies(b)]
    found = metrics.summary().as_dict()
    assert found.pop("n_frames") == n_frames
    ratios = np.sum(energies[::2], axis=0) / np.sum(energies[1::2], axis=0)
    assert [found.pop(f"folds_{n}") for n in (1, 4, 16, 64)] == pytest.approx(list(ratios), rel=1e-5)
    for name, value in found.items():
        values = [row[name] for row in rows]
        wanted = max(values) if name == "max_depth_mm" else np.mean(values)
        assert value == pytest.approx(wanted, rel=1e-5, abs=1e-9), name


def test_figures_of_one_frame() -> None:
    rng = np.random.default_rng(0)
    vertices, collisions = random_frame(rng)
    frame = GarmentMetrics(MESH.faces).add(vertices, collisions)
    assert (frame.n_vertices, frame.n_inside) == (N, collisions.n_inside)
    assert (frame.n_vf, frame.n_ee, frame.is_free) == (collisions.n_vf, collisions.n_ee, collisions.is_free)
    assert frame.mpve_mm is None
    assert frame.laplacian_mm is None
    assert frame.folds is None


def test_a_vertex_on_the_skin_is_not_inside_but_not_free() -> None:
    """A vertex pushed onto the skin lands a rounding error on either side of it."""
    vertices, _ = random_frame(np.random.default_rng(4))
    depth = np.zeros(N, np.float32)
    depth[:3] = 1e-8, 1e-7, 1e-3
    none = np.zeros((0, 2), np.int32)
    frame = GarmentMetrics(MESH.faces).add(vertices, Collisions(none, np.zeros(0, np.bool_), depth > 0, depth))
    assert frame.n_inside == 1
    assert not frame.is_free
    depth[2] = 0
    frame = GarmentMetrics(MESH.faces).add(vertices, Collisions(none, np.zeros(0, np.bool_), depth > 0, depth))
    assert (frame.n_inside, frame.is_free) == (0, False)


def test_laplacian_error_ignores_translation_and_mpve_does_not() -> None:
    vertices, collisions = random_frame(np.random.default_rng(1))
    frame = GarmentMetrics(MESH.faces).add(vertices + np.float32(0.125), collisions, truth=vertices)
    assert frame.mpve_mm == pytest.approx(125 * 3**0.5, rel=1e-4)
    assert frame.laplacian_mm == pytest.approx(0, abs=1e-3)


def test_nothing_added() -> None:
    metrics = GarmentMetrics(MESH.faces)
    assert metrics.summary().as_dict() == {
        "n_frames": 0,
        "mpve_mm": None,
        "vfcp_percent": None,
        "cfmp_percent": None,
        "avg_vf": None,
        "avg_ee": None,
        "max_depth_mm": None,
        "mean_energy": None,
        "mean_collision_error_mm": None,
        "laplacian_mm": None,
        "folds_1": None,
        "folds_4": None,
        "folds_16": None,
        "folds_64": None,
    }
    json.dumps(metrics.summary().as_dict())


def test_refuses_arrays_of_another_garment() -> None:
    vertices, collisions = random_frame(np.random.default_rng(3))
    metrics = GarmentMetrics(MESH.faces)
    with pytest.raises(MeshError, match=r"belong to the garment's 42 vertices"):
        metrics.add(vertices, collisions, truth=vertices[:10])
    with pytest.raises(MeshError, match=r"\(10,\)"):
        metrics.add(vertices, collisions, resolved=np.zeros(10, np.bool_))
    with pytest.raises(MeshError, match=r"belong to the garment's 41 vertices"):
        metrics.add(vertices[:41], collisions)


def test_all_frames_are_of_one_garment() -> None:
    """With a truth it was SciPy's error about the second frame; without, two garments became one row of figures."""
    vertices, collisions = random_frame(np.random.default_rng(5))
    metrics = GarmentMetrics(MESH.faces)
    metrics.add(vertices, collisions, truth=vertices)
    more = np.concatenate((vertices, vertices[:1]))
    nothing = Collisions(np.zeros((0, 2), np.int32), np.zeros(0, np.bool_), np.zeros(N + 1, bool), np.zeros(N + 1))
    for truth in (more, None):
        with pytest.raises(MeshError, match=r"the garment's vertices must have the shape \(42, 3\), got \(43, 3\)"):
            metrics.add(more, nothing, truth=truth)
    assert metrics.summary().n_frames == 1
