"""Vertices that end inside the body leave it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import igl
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from refu_core import GarmentPipeline, SmplFrame, load_body
from refu_core.contact import DEFAULT_CONTACT, Sheet, WayOut
from refu_core.mesh import Connectivity
from refu_core.metrics import CollisionChecker
from refu_lab.stress._frames import promised

MARGIN = 0.004


def two_balls(apart: float) -> trimesh.Trimesh:
    """Two balls of 5 cm in one mesh, which overlap; their middles are `apart` [m]."""
    balls = [trimesh.creation.icosphere(3, 0.05) for _ in range(2)]
    balls[1].apply_translation((apart, 0.003, 0.001))
    return trimesh.util.concatenate(balls)


def made(mesh: trimesh.Trimesh, **changes: float) -> WayOut:
    body = torch.tensor(mesh.vertices, dtype=torch.float32)
    skin = Sheet(Connectivity.of(mesh.faces, len(body)), body)
    return WayOut(skin, settings=replace(DEFAULT_CONTACT, **changes))


def winding(mesh: trimesh.Trimesh, points: Tensor) -> NDArray[np.float64]:
    vertices = mesh.vertices.astype(np.float32).astype(np.float64)
    return np.round(igl.winding_number(vertices, np.asarray(mesh.faces), points.double().numpy()))


def drawn(seed: int, n: int = 400) -> Tensor:
    """Points in and around the balls, (n, 3) [m]."""
    low, high = torch.tensor([-0.06, -0.06, -0.06]), torch.tensor([0.15, 0.06, 0.06])
    return low + (high - low) * torch.rand(n, 3, generator=torch.Generator().manual_seed(seed))


@given(st.integers(0, 2**31), st.floats(0.01, 0.09))
@settings(max_examples=15)
def test_nobody_is_inside_and_who_was_outside_stays(seed: int, apart: float) -> None:
    mesh, points = two_balls(apart), drawn(seed)
    was_inside = winding(mesh, points) != 0
    out, n_inside = made(mesh)(points, points, MARGIN)
    assert was_inside.sum() > 10
    assert int(n_inside) == 0
    assert not winding(mesh, out).any()
    assert torch.equal(out[~was_inside], points[~was_inside])


@given(st.integers(0, 2**31), st.floats(0.02, 0.09))
@settings(max_examples=10)
def test_the_way_is_hardly_longer_than_the_shortest_one(seed: int, apart: float) -> None:
    mesh, points = two_balls(apart), drawn(seed, 150)
    inside = np.flatnonzero(winding(mesh, points))
    out, _ = made(mesh)(points, points, MARGIN)
    # Slow and obvious: of many places on the skin those without anything above them.
    places, of_face = trimesh.sample.sample_surface(mesh, 20_000, seed=1)
    above = torch.tensor(places + 2e-4 * mesh.face_normals[of_face], dtype=torch.float32)
    is_open = winding(mesh, above) == 0
    x = points.double().numpy()[inside]
    shortest = np.linalg.norm(x[:, None] - places[is_open][None], axis=2).min(1)
    foot, has_way = made(mesh).open_skin(points)
    assert np.array_equal(np.flatnonzero(has_way), inside)
    np.testing.assert_allclose((foot - points).norm(dim=1).double().numpy()[inside], shortest, atol=0.004)
    gone = np.linalg.norm(out.double().numpy()[inside] - x, axis=1)
    assert (gone < shortest + MARGIN + 0.008).all()  # edges of these balls are 7 mm long


def test_the_margin_is_kept_where_there_is_room() -> None:
    mesh = trimesh.creation.icosphere(3, 0.05)
    points = drawn(1)
    inside = winding(mesh, points) != 0
    out, _ = made(mesh)(points, points, MARGIN)
    distance = -trimesh.proximity.signed_distance(mesh, out.double().numpy()[inside])
    np.testing.assert_allclose(distance, MARGIN, atol=2e-4)


def test_no_way_is_longer_than_any_may_be() -> None:
    mesh, points = trimesh.creation.icosphere(3, 0.05), torch.zeros(1, 3)
    way_out = made(mesh, max_displacement=0.03)
    out, n_inside = way_out(points, points, MARGIN)
    assert torch.equal(out, points)
    assert int(n_inside) == 1
    # From where it may go to there is one that is as long as it may be.
    out, n_inside = way_out(points, torch.tensor([[0.03, 0.0, 0.0]]), MARGIN)
    assert int(n_inside) in (0, 1)
    assert (out - torch.tensor([[0.03, 0.0, 0.0]])).norm() <= 0.03 + 1e-6


def test_where_nobody_is_inside_the_very_points_come_back() -> None:
    mesh = two_balls(0.06)
    points = drawn(3)
    points = points[winding(mesh, points) == 0]
    out, n_inside = made(mesh)(points, points, MARGIN)
    assert out is points
    assert int(n_inside) == 0


def test_the_same_launches_in_every_frame_do_the_same() -> None:
    mesh, points = two_balls(0.05), drawn(5)
    expected, n_expected = made(mesh)(points, points, MARGIN)
    as_on_a_gpu = made(mesh)
    as_on_a_gpu._is_serial = False
    as_on_a_gpu(points + 0.02, points, MARGIN)  # leaves nothing behind
    out, n_inside = as_on_a_gpu(points, points, MARGIN)
    assert torch.equal(out, expected)
    assert int(n_inside) == int(n_expected)


@cache
def pipeline(sdf: str) -> GarmentPipeline:
    return GarmentPipeline.load(["shirt-male"], sdf=sdf)


@pytest.mark.parametrize("sdf", ["hybrid", "accurate"])
def test_no_vertex_of_promised_frames_is_inside(sdf: str) -> None:
    """Each of these left up to 35 vertices inside, where the walk missed a face or skin was buried."""
    rng, frames = np.random.default_rng(12345), []
    for i in range(287):
        frame = promised(rng)
        if i in (37, 80, 185, 189, 197, 286):
            frames.append(frame)
    checker = CollisionChecker(load_body("male").faces)
    for frame in frames:
        out = pipeline(sdf)(frame)
        assert out.stats.within_promise
        assert out.stats.garments["shirt-male"].n_unresolved == 0
        checker.update(out.body)
        assert checker.check(out["shirt-male"].local, out["shirt-male"].faces).max_depth < 1e-4


def test_a_frame_in_which_all_is_clear_is_not_touched() -> None:
    certified, plain = pipeline("hybrid"), GarmentPipeline.load(["shirt-male"], certify=False)
    pose = np.zeros((24, 3))
    pose[16, 2], pose[17, 2] = -0.8, 0.8
    one, other = (p(SmplFrame(pose=pose))["shirt-male"].vertices for p in (certified, plain))
    np.testing.assert_array_equal(one, other)
