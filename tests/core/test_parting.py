"""Triangles of garments that cut each other, and cloth deep inside the body: each step against a slow, obvious one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_layers import sheet, wavy
from torch import Tensor

from refu_core.contact import DEFAULT_CONTACT, Layer, Parting, Resolver, Sheet
from refu_core.contact._parting_kernels import depth_below
from refu_core.mesh import Connectivity
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.sdf import BandSdf, ExactSdf, MeshSdf

Array = NDArray[np.float64]


@wp.kernel
def _depth_kernel(corners: wp.array[wp.vec3], n: wp.vec3, depth: wp.array[float], place: wp.array[wp.vec3]) -> None:
    own = wp.matrix_from_rows(corners[0], corners[1], corners[2])
    found, w = depth_below(n, own, wp.matrix_from_rows(corners[3], corners[4], corners[5]))
    depth[0] = found
    place[0] = w


def grid(n: int) -> Array:
    """Barycentrics all over a triangle, shape (K, 3)."""
    return np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n


@given(seed=st.integers(0, 10_000))
@settings(max_examples=60)
def test_a_face_has_as_far_to_go_as_its_deepest_place(seed: int) -> None:
    """Of many places on both triangles, the one where one lies deepest below the other."""
    rng = np.random.default_rng(seed)
    n = np.array([0.0, 1.0, 0.0])
    corners = rng.uniform(-0.01, 0.01, (6, 3)) * [1, 0.4, 1]
    found, place = wp.zeros(1, dtype=wp.float32, device="cpu"), wp.zeros(1, dtype=wp.vec3, device="cpu")
    points = wp.array(corners.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(_depth_kernel, 1, [points, wp.vec3(*n), found, place], device="cpu")
    own, other = corners[:3], corners[3:]
    deepest = 0.0
    for first, second, sign in ((own, other, 1), (other, own, -1)):
        (ax, az), (bx, bz), (cx, cz) = second[:, [0, 2]]
        to_weights = np.linalg.inv([[ax, bx, cx], [az, bz, cz], [1, 1, 1]])
        for p in grid(60) @ first:
            w = to_weights @ [p[0], p[2], 1]
            if w.min() >= 0:
                deepest = max(deepest, sign * float(w @ second[:, 1] - p[1]))
    depth, w = float(found.numpy()[0]), place.numpy()[0].astype(float)
    assert depth >= deepest - 1e-6
    assert depth <= deepest + 1e-3, "and no farther: the places are as close together as this"
    if depth > 0:
        assert w.min() >= -1e-5
        assert w.sum() == pytest.approx(1, abs=1e-5)


def over(seed: int, height: float, amplitude: float) -> tuple[Layer, Tensor, Tensor, Tensor, Tensor]:
    """A layer, and its garments: the outer one so far above a wavy inner one, with waves of its own."""
    below, below_faces = sheet(11, step=0.013)
    above, above_faces = sheet(13)
    layer = Layer(above_faces, above, below_faces, below)
    low = wavy(below, seed, amplitude=amplitude)
    high = wavy(above, seed + 1, amplitude=amplitude) + torch.tensor([0.0, height, 0.0])
    return layer, high, above_faces, low, below_faces


@given(seed=st.integers(0, 1000), height=st.floats(-0.004, 0.008))
@settings(max_examples=12)
def test_what_cuts_is_found(seed: int, height: float) -> None:
    layer, high, faces, low, below_faces = over(seed, height, 0.006)
    layer(high, low)
    checker = SheetChecker(below_faces.numpy())
    checker.update(low.numpy())
    pairs = checker.with_other(high.numpy(), faces.numpy())
    assert int(layer.parting.find(high)) == len(pairs)


@given(seed=st.integers(0, 1000), height=st.floats(0.001, 0.008))
@settings(max_examples=12)
def test_sheets_that_cut_are_parted_and_nothing_else_is_moved(seed: int, height: float) -> None:
    layer, high, faces, low, below_faces = over(seed, height, 0.006)
    layer(high, low)
    n_cut = layer.parting.find(high)
    found = high
    calls = 0
    while calls < 2 and layer.parting.find(found) > 0:  # as a frame does, which allows three
        calls += 1
        found = layer.parting.part(found)
    if not n_cut:
        assert torch.equal(found, high)
        return
    checker = SheetChecker(below_faces.numpy())
    checker.update(low.numpy())
    after = len(checker.with_other(found.numpy(), faces.numpy()))
    assert after == 0, "there is room for all"
    farthest = calls * DEFAULT_CONTACT.sweeps * DEFAULT_CONTACT.gap
    assert (found - high).norm(dim=1).max() <= 3 * farthest


def test_a_ridge_through_the_middle_of_a_face_is_cleared() -> None:
    """No vertex of the outer garment is below the sheet."""
    below, below_faces = sheet(13, step=0.005)
    ridge = below.clone()
    ridge[6 * 13 + 6, 1] += 0.006
    above, above_faces = sheet(5, step=0.017)
    above += below.mean(0) - above.mean(0) + torch.tensor([0.006, 0.004, 0.004])
    layer = Layer(above_faces, above, below_faces, below)
    lifted, n_low = layer(above, ridge)
    checker = SheetChecker(below_faces.numpy())
    checker.update(ridge.numpy())
    assert n_low == 0
    assert len(checker.with_other(lifted.numpy(), above_faces.numpy())) > 0
    assert layer.parting.find(lifted)
    found = layer.parting.part(lifted)
    assert len(checker.with_other(found.numpy(), above_faces.numpy())) == 0
    moved = (found - above).norm(dim=1)
    assert moved.max() < 0.006
    assert not layer.parting.find(found)


@pytest.mark.parametrize("also_deep", [False, True])
def test_cloth_that_runs_through_a_body_between_its_vertices_is_parted_if_that_leaves_fewer_cuts(
    also_deep: bool,
) -> None:
    """A sheet over a ball, no vertex of it inside; and the same with a second ball deep in it, which has no way out."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    above, faces = sheet(7, step=0.017, height=0.028)
    above += torch.tensor([0.0085, 0.0, 0.0085]) - torch.tensor([0.051, 0.0, 0.051])
    other = ball.vertices * [0.3, 1.0, 0.3] + [0.04, 0.02, 0.04]
    vertices = np.concatenate((ball.vertices, other)) if also_deep else ball.vertices
    body_faces = np.concatenate((ball.faces, ball.faces + len(ball.vertices))) if also_deep else ball.faces
    skin = Sheet(Connectivity.of(body_faces), torch.zeros(len(vertices), 3))
    skin.take(torch.from_numpy(vertices).float())
    checker = CollisionChecker(body_faces.astype(np.int32))
    checker.update(vertices.astype(np.float32))
    before = checker.check(above.numpy(), faces.numpy())
    assert before.n_pairs > 0
    assert also_deep or not before.inside.any()
    parting = Parting(Connectivity.of(faces), above, skin, settings=DEFAULT_CONTACT)
    found = parting.parted(above)
    after = checker.check(found.numpy(), faces.numpy())
    assert after.n_pairs < before.n_pairs if not also_deep else after.n_pairs <= before.n_pairs
    assert also_deep or after.is_free


@pytest.mark.parametrize("sdf_of", [ExactSdf, BandSdf])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_a_glimpse_sees_whether_any_face_cuts_the_body(sdf_of: type[MeshSdf], seed: int) -> None:
    """Sheets of long triangles over eggs of any size, which poke through the middle of some of them."""
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=rng.uniform(0.02, 0.06))
    vertices = torch.from_numpy(ball.vertices * rng.uniform(0.5, 1.0, 3)).float()
    above, faces = sheet(7, step=rng.uniform(0.005, 0.025))
    above += torch.tensor([0.0, rng.uniform(0.8, 1.1) * float(vertices[:, 1].max()), 0.0]) - above.mean(0)
    above += torch.from_numpy(rng.normal(0, 0.002, above.shape)).float()
    sdf = sdf_of(torch.from_numpy(ball.faces.astype(np.int32)))
    sdf.update(vertices)
    resolver = Resolver(faces, len(above))
    done = resolver(above, sdf, sdf.query(above), margin=rng.choice([0.0, 0.002]))
    checker = CollisionChecker(ball.faces.astype(np.int32))
    checker.update(vertices.numpy())
    n_pairs = checker.check(done.vertices.numpy(), faces.numpy()).n_pairs
    seen = bool(resolver.glimpse(done, done.vertices, sdf))
    places = torch.from_numpy(grid(20)).float() @ done.vertices[faces.long()]
    clear = float(sdf.query(places.reshape(-1, 3)).distance.min())
    assert seen or n_pairs == 0
    assert not seen or clear < 2e-4, "where nothing cuts, it is only taken in by what nearly touches"
    moved = done.vertices.clone()
    moved[3] += 0.01
    assert resolver.glimpse(done, moved, sdf), "nothing is known of the places to which it was moved"
