"""Exact signed distance: against libigl and a slow reference, its derivatives, and what it refuses."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from refu_core.body import SmplBody, load_body
from refu_core.errors import MeshError
from refu_core.sdf import BodySdf, ExactSdf


@pytest.fixture(scope="module")
def body() -> SmplBody:
    return load_body("male")


def posed(body: SmplBody, seed: int, *, bend: float = 0.25) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    pose = bend * torch.randn(1, 24, 3, generator=generator)
    return body(pose=pose, betas=torch.randn(1, 10, generator=generator)).vertices[0]


def around(vertices: Tensor, n: int, seed: int, *, spread: float = 0.02) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randint(len(vertices), (n,), generator=generator)
    return vertices[chosen] + spread * torch.randn(n, 3, generator=generator)


def sphere(dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    return torch.tensor(mesh.vertices, dtype=dtype), torch.tensor(mesh.faces)


def winding_number(vertices: Tensor, faces: Tensor, points: Tensor) -> np.ndarray:
    return igl.winding_number(vertices.double().numpy(), faces.long().numpy(), points.double().numpy())


@pytest.mark.parametrize("seed", range(6))
def test_agrees_with_libigl(body: SmplBody, seed: int) -> None:
    vertices = posed(body, seed)
    points = torch.cat([around(vertices, 3000, seed), around(vertices, 500, seed, spread=0.5)])
    sdf = ExactSdf(body.faces)
    sdf.update(posed(body, seed + 100))  # the BVH is built for another pose than it is asked in
    sdf.update(vertices)
    sample = sdf.query(points)
    faces = body.faces.long().numpy()
    squared, _, closest = igl.point_mesh_squared_distance(points.double().numpy(), vertices.double().numpy(), faces)
    np.testing.assert_allclose(sample.distance.abs().numpy(), np.sqrt(squared), atol=1e-5)
    inside = sample.distance.numpy() < 0

    # A pseudo-normal can only be misled where limbs run into each other: there the winding number counts two layers, or
    # the closest face lies within the body.
    is_wrong = inside != (winding_number(vertices, body.faces, points) > 0.5)
    assert is_wrong.mean() < 0.02
    outward = closest + 1e-3 * (closest - points.numpy()) / np.sqrt(squared)[:, None]
    layers = igl.winding_number(vertices.double().numpy(), faces, outward[is_wrong])
    assert (layers > 0.5).all()


def test_sign_by_winding_number_is_right_within_touching_limbs(body: SmplBody) -> None:
    vertices = posed(body, 0, bend=0.5)
    points = around(vertices, 4000, 1)
    wanted = winding_number(vertices, body.faces, points) > 0.5
    by_normal, by_winding = ExactSdf(body.faces), ExactSdf(body.faces, sign="winding")
    by_normal.update(vertices)
    by_winding.update(vertices)
    assert ((by_normal.query(points).distance < 0).numpy() != wanted).any()  # or this test tests nothing
    np.testing.assert_array_equal((by_winding.query(points).distance < 0).numpy(), wanted)
    np.testing.assert_array_equal((by_winding.closest(points).sign < 0).numpy(), wanted)


@pytest.mark.parametrize("sign", ["normal", "winding"])
def test_gradient_is_the_unit_direction_of_growth(body: SmplBody, sign: str) -> None:
    vertices = posed(body, 3)
    points = around(vertices, 2000, 3)
    sdf = ExactSdf(body.faces, sign=sign)
    sdf.update(vertices)
    sample = sdf.query(points)
    torch.testing.assert_close(sample.gradient.norm(dim=1), torch.ones(len(points)))
    step = 1e-3
    ahead = sdf.query(points + step * sample.gradient).distance
    behind = sdf.query(points - step * sample.gradient).distance
    growth = (ahead - behind) / (2 * step)
    # At most one: distance is 1-Lipschitz. Less only within a step of the medial axis, the surface's sharp side, or a
    # sign that flips with the layers of touching limbs.
    assert (growth > 0.99).float().mean() > 0.93


def test_closest_gives_face_and_barycentrics(body: SmplBody) -> None:
    vertices = posed(body, 4)
    points = around(vertices, 1000, 4)
    sdf = ExactSdf(body.faces)
    sdf.update(vertices)
    found, sample = sdf.closest(points), sdf.query(points)
    corners = vertices[sdf.faces.long()[found.face.long()]]
    foot = (found.barycentrics[:, :, None] * corners).sum(1)
    torch.testing.assert_close((points - foot).norm(dim=1), found.distance, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.sign * found.distance, sample.distance)
    torch.testing.assert_close(found.barycentrics.sum(1), torch.ones(len(points)))
    assert (found.barycentrics >= -1e-6).all()


def test_closest_within_a_limit(body: SmplBody) -> None:
    vertices = posed(body, 5)
    points = around(vertices, 1000, 5)
    sdf = ExactSdf(body.faces)
    sdf.update(vertices)
    limited, full = sdf.closest(points, max_distance=0.01), sdf.closest(points)
    within = full.distance < 0.01
    assert 0 < within.sum() < len(points)
    assert torch.equal(limited.face >= 0, within)
    assert torch.equal(limited.distance[within], full.distance[within])
    assert torch.isinf(limited.distance[~within]).all()
    assert (limited.sign[~within] == 1).all()


def test_gradient_is_finite_and_unit_on_surface_and_medial_axis() -> None:
    vertices, faces = sphere()
    sdf = ExactSdf(faces)
    sdf.update(vertices)
    middles = vertices[faces].mean(1)
    edges = vertices[faces[:, :2]].mean(1)
    special = torch.cat([vertices, middles, edges, torch.zeros(1, 3), 1e6 * vertices[:3]])
    sample = sdf.query(special.requires_grad_())
    torch.testing.assert_close(sample.gradient.norm(dim=1), torch.ones(len(special)))
    on_surface = slice(0, len(special) - 4)
    assert sample.distance[on_surface].abs().max() < 1e-6
    outward = torch.nn.functional.normalize(special[on_surface], dim=1)
    assert ((sample.gradient[on_surface] * outward).sum(1) > 0.9).all()
    (derivative,) = torch.autograd.grad(sample.distance.sum() + sample.gradient.sum(), special)
    assert torch.isfinite(derivative).all()


@pytest.mark.parametrize("sign", ["normal", "winding"])
def test_gradcheck_of_distance_and_gradient(sign: str) -> None:
    vertices, faces = sphere(torch.float64)
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator, dtype=torch.float64), dim=1)
    radii = torch.where(torch.arange(40) % 2 == 0, 1.3, 0.85)[:, None]
    # Outside there are closest faces, edges and vertices, inside only faces; near a switch nothing is smooth.
    points = torch.cat([directions * radii, 1.2 * vertices[:4], 1.2 * vertices[faces[:4, :2]].mean(1)])
    sdf = ExactSdf(faces, sign=sign)
    sdf.update(vertices)
    step = 1e-4

    def closest_feature(where: Tensor) -> Tensor:
        return sdf._features(where.float(), sdf.closest(where).face)[0]

    feature = closest_feature(points)
    nudged = [closest_feature(points + step * sign_ * axis) for axis in torch.eye(3) for sign_ in (-1, 1)]
    smooth = torch.stack([other == feature for other in nudged]).all(0)
    assert {min(int(kind), 4) for kind in feature[smooth]} >= {0, 1, 4}

    def f(points: Tensor, vertices: Tensor) -> tuple[Tensor, Tensor]:
        sdf.update(vertices)
        return tuple(sdf.query(points))

    inputs = points[smooth].clone().requires_grad_(), vertices.clone().requires_grad_()
    assert torch.autograd.gradcheck(f, inputs, eps=1e-6, atol=1e-6)


def test_tracked_and_untracked_answers_agree(body: SmplBody) -> None:
    vertices = posed(body, 6)
    points = around(vertices, 2000, 6)
    sdf = ExactSdf(body.faces)
    sdf.update(vertices)
    plain, tracked = sdf.query(points), sdf.query(points.clone().requires_grad_())
    assert not plain.distance.requires_grad
    assert tracked.distance.requires_grad
    torch.testing.assert_close(tracked.distance, plain.distance, atol=1e-6, rtol=0)
    clear = plain.distance.abs() > 1e-4  # nearer, float32 directions are noise
    torch.testing.assert_close(tracked.gradient[clear], plain.gradient[clear], atol=2e-3, rtol=0)
    double = sdf.query(points.double())
    assert double.distance.dtype == torch.float64
    torch.testing.assert_close(double.distance.float(), plain.distance, atol=1e-6, rtol=0)


@given(seed=st.integers(0, 2**31), shift=st.floats(-2, 2), angle=st.floats(-3, 3))
def test_moves_with_the_body(seed: int, shift: float, angle: float) -> None:
    vertices, faces = sphere()
    points = around(vertices, 50, seed, spread=0.2)
    rotation = torch.linalg.matrix_exp(angle * torch.tensor([[0.0, -1, 0.3], [1, 0, -0.5], [-0.3, 0.5, 0]]))
    moved = ExactSdf(faces)
    moved.update(vertices @ rotation.T + shift)
    still = ExactSdf(faces)
    still.update(vertices)
    a, b = still.query(points), moved.query(points @ rotation.T + shift)
    torch.testing.assert_close(a.distance, b.distance, atol=5e-6, rtol=0)


def test_rebuild_and_refit_answer_alike(body: SmplBody) -> None:
    squat = torch.zeros(1, 24, 3)
    squat[0, [1, 2, 4, 5], 0] = torch.tensor([-1.9, -1.9, 2.2, 2.2])
    vertices = body(pose=squat, betas=torch.zeros(1, 10)).vertices[0]
    points = around(vertices, 2000, 8)
    once, by_itself, by_hand = (
        ExactSdf(body.faces, rebuild_distance=torch.inf),
        ExactSdf(body.faces),
        ExactSdf(body.faces),
    )
    for sdf in (once, by_itself, by_hand):
        sdf.update(body.v_template)
        built = sdf.mesh_id
        sdf.update(body.v_template + 0.01)
        assert sdf.mesh_id == built
        sdf.update(vertices)
    by_hand.rebuild()
    for sdf in (by_itself, by_hand):
        torch.testing.assert_close(once.query(points).distance, sdf.query(points).distance, atol=1e-7, rtol=0)


def test_few_points_are_answered_as_many_are(body: SmplBody) -> None:
    sdf = ExactSdf(body.faces)
    for seed in (1, 2, 3):
        sdf.update(posed(body, seed))
        if seed == 3:
            sdf.rebuild()
        points = around(posed(body, seed), 600, seed)
        many = sdf.query(points)
        few = [sdf.query(piece) for piece in points.split((1, 256, 57, 257, 29))]  # none overwrites the one before
        assert torch.equal(torch.cat([sample.distance for sample in few]), many.distance)
        assert torch.equal(torch.cat([sample.gradient for sample in few]), many.gradient)
        faces = [sample.face for sample in few if sample.face is not None]
        assert many.face is not None
        assert torch.equal(torch.cat(faces), many.face)


def test_no_points_and_satisfies_the_protocol() -> None:
    vertices, faces = sphere()
    sdf = ExactSdf(faces.numpy())
    sdf.update(vertices)
    assert isinstance(sdf, BodySdf)
    sample = sdf.query(torch.empty(0, 3))
    assert sample.distance.shape == (0,)
    assert sample.gradient.shape == (0, 3)
    assert sdf.query(torch.empty(0, 3, requires_grad=True)).distance.shape == (0,)


@pytest.mark.parametrize(
    ("faces", "words"),
    [
        ([[0, 1, 2]], "3 open edges"),
        ([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 2, 3]], "3 edges whose two faces face opposite ways"),
        ([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2], [0, 1, 4]], "2 open edges, 1 edges of more than two faces"),
        ([[0, 1, 1]], "three different vertices"),
        ([[0, 1]], r"shape \(F, 3\), got int64 of shape \(1, 2\)"),
        ([[0.0, 1.0, 2.0]], "integers"),
        ([[0, 1, -2]], "got -2 to 1"),
    ],
)
def test_refuses_faces_that_bound_no_volume(faces: list[list[int]], words: str) -> None:
    with pytest.raises(MeshError, match=words):
        ExactSdf(np.array(faces))


def test_refuses_bad_vertices_points_and_order() -> None:
    vertices, faces = sphere()
    sdf = ExactSdf(faces)
    with pytest.raises(MeshError, match=r"call update"):
        sdf.query(vertices)
    with pytest.raises(MeshError, match=r"shape \(162, 3\), got \(161, 3\)"):
        sdf.update(vertices[:161])
    broken = vertices.clone()
    broken[7, 1] = torch.nan
    with pytest.raises(MeshError, match=r"got 1 of 162 with NaN"):
        sdf.update(broken)
    with pytest.raises(MeshError, match=r"negative volume"):
        sdf.update(-vertices)
    sdf.update(vertices)
    with pytest.raises(MeshError, match=r"shape \(N, 3\), got \(162, 2\)"):
        sdf.query(vertices[:, :2])
    with pytest.raises(
        MeshError, match=r"points must be within 1e\+07 m of the origin, got 1e\+18 m; is the unit metres"
    ):
        sdf.query(1e18 * torch.ones(2, 3))  # its square is no number any more: the distance was infinite
    with pytest.raises(MeshError, match=r"points must be finite, got 1 of 162"):
        sdf.query(broken)
    with pytest.raises(MeshError, match=r"max_distance must be positive"):
        sdf.closest(vertices, max_distance=0)
    with pytest.raises(MeshError, match=r'"normal" or "winding"'):
        ExactSdf(faces, sign="parity")
