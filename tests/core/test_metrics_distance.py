"""Errors of a signed distance, and the figures that the exact check gives, against loops over single points."""

from __future__ import annotations

import math

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from refu_core.metrics import CollisionChecker, GarmentMetrics
from refu_lab.reproduction._sdf import sdf_errors


@given(seed=st.integers(0, 2**31), n=st.integers(1, 60))
def test_distance_errors_equal_the_slow_reference(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    accurate = rng.normal(scale=0.02, size=n)
    accurate[rng.random(n) < 0.3] *= 1e-4  # on the skin, as good as
    approximate = accurate + rng.normal(scale=0.002, size=n)
    found = sdf_errors(approximate, accurate)
    absolute, relative, missed, hidden = [], [], 0, 0
    for f, s in zip(approximate.tolist(), accurate.tolist(), strict=True):
        absolute.append(abs(f - s))
        missed += abs(f - s) > 0.002
        hidden += s < -0.002 and f >= 0
        if abs(s) > 0.0001:
            relative.append(abs((f - s) / s))
    assert found["mean_absolute_mm"] == pytest.approx(1000 * sum(absolute) / n)
    assert found["missed_percent"] == pytest.approx(100 * missed / n)
    assert found["hidden_percent"] == pytest.approx(100 * hidden / n)
    assert found["mean_relative_percent"] == (pytest.approx(100 * sum(relative) / len(relative)) if relative else None)
    # The 99th percentile between two of the sorted errors.
    place = 0.99 * (n - 1)
    low, high = sorted(absolute)[math.floor(place)], sorted(absolute)[math.ceil(place)]
    assert found["p99_mm"] == pytest.approx(1000 * (low + (place - math.floor(place)) * (high - low)))


def test_distance_errors_of_nothing() -> None:
    none = sdf_errors([], [])
    assert (none["mean_absolute_mm"], none["missed_percent"]) == (None, None)


def test_energy_and_collision_error_from_the_mesh_alone() -> None:
    """E = Σ max(0, -f)² and L_c = Σ max(0, -f), with f from libigl, for a garment through a body."""
    body, garment = trimesh.creation.icosphere(subdivisions=3), trimesh.creation.icosphere(subdivisions=2, radius=0.6)
    garment.vertices += (0.55, 0.1, -0.05)
    checker = CollisionChecker(body.faces)
    checker.update(body.vertices.astype(np.float32))
    vertices = garment.vertices.astype(np.float32)
    frame = GarmentMetrics(garment.faces).add(vertices, checker.check(vertices, garment.faces))
    f = igl.signed_distance(vertices.astype(np.float64), body.vertices, body.faces)[0]
    assert 0 < frame.n_inside < len(vertices)
    assert frame.n_inside == (f < 0).sum()
    assert frame.energy == pytest.approx(sum(max(0.0, -d) ** 2 for d in f), rel=1e-4)
    assert frame.collision_error_mm == pytest.approx(1000 * sum(max(0.0, -d) for d in f), rel=1e-4)
