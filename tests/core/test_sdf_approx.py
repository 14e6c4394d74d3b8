"""The walking distance: how far it is from the exact one, what it can't get wrong, its derivatives."""

from __future__ import annotations

import math

import igl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from refu_core.body import SmplBody, load_body
from refu_core.errors import MeshError
from refu_core.garments import GarmentTemplate, load_garment
from refu_core.sdf import ApproxSdf, BodySdf, ExactSdf, RestFaces, query_batch
from refu_core.sdf._approx import EXACT_FROM

POSES: dict[str, dict[int, tuple[float, float, float]]] = {
    "a-pose": {16: (0, 0, -0.8), 17: (0, 0, 0.8)},
    "arms down": {16: (0, 0, -1.25), 17: (0, 0, 1.25)},
    "crossed arms": {16: (0, -0.6, -1.1), 17: (0, 0.6, 1.1), 18: (0, -2.0, 0), 19: (0, 2.0, 0)},
    "hands on hips": {16: (0.3, 0.5, -0.9), 17: (0.3, -0.5, 0.9), 18: (0, -1.7, 0), 19: (0, 1.7, 0)},
    "step": {1: (-0.7, 0, 0), 2: (0.5, 0, 0), 4: (0.6, 0, 0), 5: (0.3, 0, 0)},
    "squat": {1: (-1.5, 0, 0.2), 2: (-1.5, 0, -0.2), 4: (1.8, 0, 0), 5: (1.8, 0, 0)},
}


@pytest.fixture(scope="module")
def body() -> SmplBody:
    return load_body("male")


@pytest.fixture(scope="module")
def approx(body: SmplBody) -> ApproxSdf:
    return ApproxSdf(body)


@pytest.fixture(scope="module")
def exact(body: SmplBody) -> ExactSdf:
    return ExactSdf(body.faces)


def pose_of(name: str) -> Tensor:
    pose = torch.zeros(1, 24, 3)
    for joint, rotation in POSES[name].items():
        pose[0, joint] = torch.tensor(rotation)
    return pose


def dressed(body: SmplBody, garment: GarmentTemplate, pose: Tensor, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Body (V, 3), a disturbed garment on it (N, 3), which partly runs into it, and where that is on the mean shape."""
    generator = torch.Generator().manual_seed(seed)
    betas = torch.randn(1, 10, generator=generator)
    output = body(pose, betas)
    waves, phase = torch.randn(3, 12, generator=generator) * 12, 6 * torch.rand(12, generator=generator)
    shift = torch.sin(garment.v_template @ waves + phase) @ torch.randn(12, 3, generator=generator)
    shift *= 0.015 / shift.square().sum(1).mean().sqrt()
    worn = garment.pose(garment.rest(betas) + shift, output.transforms)[0]
    return output.vertices[0], worn, garment.v_template + shift


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("name", ["tshirt-male", "short-pant-male"])
def test_is_nearly_exact_near_the_skin(
    body: SmplBody, approx: ApproxSdf, exact: ExactSdf, name: str, pose: str
) -> None:
    skin, worn, unposed = dressed(body, load_garment(name), pose_of(pose))
    approx.update(skin)
    exact.update(skin)
    found, true = approx.query(worn, near=RestFaces(body)(unposed)), exact.query(worn)
    near = true.distance.abs() < 0.02
    error = (found.distance - true.distance).abs()[near]
    assert near.sum() > 1000
    assert (true.distance < -0.002).sum() > 10  # or this test sees no penetration
    assert error.mean() < 5e-4
    assert error.quantile(0.98) < 2e-3
    missed = (true.distance < -0.002) & (found.distance > 0)
    assert missed.sum() < 0.005 * near.sum()
    along = (found.gradient * true.gradient).sum(1)[near & (true.distance.abs() > 1e-3)]
    assert along.quantile(0.02) > 0.95


def test_what_is_deep_is_asked_exactly(body: SmplBody, approx: ApproxSdf, exact: ExactSdf) -> None:
    """In the middle of a limb another way out is nearly as long as the shortest; walks may end at either."""
    walks, garment = ApproxSdf(body, exact_from=math.inf), load_garment("short-pant-male")
    n_wrong = 0
    for seed in range(4):
        skin, worn, unposed = dressed(body, garment, pose_of("squat"), seed)
        worn = worn - 0.05 * torch.nn.functional.normalize(worn - worn.mean(0), dim=1)
        for sdf in (walks, approx, exact):
            sdf.update(skin)
        near = RestFaces(body)(unposed)
        walked, found, true = walks.query(worn, near=near), approx.query(worn, near=near), exact.query(worn)
        deep = walked.distance < -EXACT_FROM
        torch.testing.assert_close(found.distance[deep], true.distance[deep], atol=1e-6, rtol=0)
        assert torch.equal(found.distance[~deep], walked.distance[~deep])
        assert torch.equal(found.face[~deep], walked.face[~deep])
        n_wrong += int(((walked.distance - true.distance).abs()[deep] > 1e-3).sum())
    assert n_wrong > 5  # of what this test is about


def test_legs_in_a_skirt_are_found_from_both_sides() -> None:
    body, garment = load_body("female"), load_garment("skirt-female")
    approx, exact = ApproxSdf(body), ExactSdf(body.faces)
    skin, worn, unposed = dressed(body, garment, pose_of("squat"))
    approx.update(skin)
    exact.update(skin)
    found, true = approx.query(worn, near=RestFaces(body)(unposed)), exact.query(worn)
    inside = true.distance < -0.002
    assert inside.sum() > 200
    assert (found.distance[inside] < 0).float().mean() > 0.98


@pytest.mark.parametrize("pose", ["a-pose", "squat"])
def test_is_the_distance_to_the_face_it_names_and_never_too_small(
    body: SmplBody, approx: ApproxSdf, exact: ExactSdf, pose: str
) -> None:
    skin, worn, unposed = dressed(body, load_garment("tshirt-male"), pose_of(pose))
    approx.update(skin)
    exact.update(skin)
    found, true = approx.query(worn, near=RestFaces(body)(unposed)), exact.query(worn)
    assert found.face is not None
    assert (found.distance.abs() >= true.distance.abs() - 1e-6).all()
    vertices, faces = skin.double().numpy(), body.faces.numpy()
    for i in range(0, len(worn), 97):
        corner = faces[int(found.face[i])][None]
        squared, *_ = igl.point_mesh_squared_distance(worn[i : i + 1].double().numpy(), vertices, corner)
        assert abs(float(found.distance[i])) == pytest.approx(float(np.sqrt(squared).item()), abs=2e-6)
    same = (found.distance - true.distance).abs() < 1e-6
    assert same.float().mean() > 0.9
    clear = same & (true.distance.abs() > 1e-3)  # nearer, float32 directions are noise
    assert ((found.gradient * true.gradient).sum(1)[clear] > 0.999).float().mean() > 0.999


@pytest.mark.parametrize("pose", ["a-pose", "squat"])
def test_deep_within_a_limb_a_walk_goes_on_from_the_first_face_above(
    body: SmplBody, approx: ApproxSdf, exact: ExactSdf, pose: str
) -> None:
    skin = body(pose_of(pose)).vertices[0]
    approx.update(skin)
    exact.update(skin)
    a, b, c = skin[body.faces].unbind(1)
    below = (a + b + c) / 3 - 0.02 * torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    found, true = approx.query(below, near=torch.arange(len(below))), exact.query(below)
    error = (found.distance - true.distance).abs()[true.distance < -0.008]
    assert len(error) > 5000
    assert error.mean() < 7e-4  # 1 mm if it stayed there
    assert (error > 2e-3).float().mean() < 0.1


def test_any_start_leads_there(body: SmplBody, approx: ApproxSdf) -> None:
    skin, worn, unposed = dressed(body, load_garment("tshirt-male"), pose_of("a-pose"))
    approx.update(skin)
    by_itself = approx.query(worn)
    assert by_itself.face is not None
    again = approx.query(worn, near=by_itself.face)
    torch.testing.assert_close(again.distance, by_itself.distance, atol=1e-6, rtol=0)
    from_rest = approx.query(worn, near=RestFaces(body)(unposed))
    agree = (from_rest.distance - by_itself.distance).abs() < 1e-6
    assert agree[by_itself.distance.abs() < 0.02].float().mean() > 0.96
    # A start on another limb is poor, one that is no face at all is read as the last; neither is dangerous.
    nonsense = approx.query(worn, near=torch.full((len(worn),), 1 << 30))
    assert torch.isfinite(nonsense.distance).all()
    assert (nonsense.distance.abs() >= by_itself.distance.abs() - 1e-6).all()


def test_answers_do_not_depend_on_the_order_of_the_points(body: SmplBody) -> None:
    skin, worn, unposed = dressed(body, load_garment("tshirt-male"), pose_of("squat"))
    near = RestFaces(body)(unposed)
    shuffled = torch.randperm(len(worn), generator=torch.Generator().manual_seed(0))
    approx = ApproxSdf(body)
    approx.update(skin)
    # The first call settles in which order points of their number are gone through; parts of them have their own.
    plain = approx.query(worn, near=near)
    for rows in (shuffled, shuffled[:5000], shuffled[:100]):
        again, wanted = approx.query(worn[rows], near=near[rows]), plain.rows(rows)
        assert torch.equal(again.distance, wanted.distance)
        assert torch.equal(again.gradient, wanted.gradient)


@given(shift=st.tuples(*[st.floats(-20, 20)] * 3), turn=st.floats(-3, 3))
@settings(max_examples=15)
def test_moves_with_the_body(body: SmplBody, approx: ApproxSdf, shift: tuple[float, float, float], turn: float) -> None:
    skin, worn, unposed = dressed(body, load_garment("short-pant-male"), pose_of("step"))
    near = RestFaces(body)(unposed)
    approx.update(skin)
    here = approx.query(worn, near=near).distance
    rotation = torch.linalg.matrix_exp(turn * torch.tensor([[0.0, -1, 0.4], [1, 0, -0.2], [-0.4, 0.2, 0]]))
    moved = torch.tensor(shift)
    approx.update(skin @ rotation.T + moved)
    there = approx.query(worn @ rotation.T + moved, near=near).distance
    # The table's cells lie otherwise, so a few vertices between limbs may find another face; rounding is of the shift.
    same = (here - there).abs() < 2e-5
    assert same[here.abs() < 0.02].float().mean() > 0.99


def test_rest_faces_are_near(body: SmplBody) -> None:
    garment = load_garment("tshirt-male")
    rest, exact = RestFaces(body), ExactSdf(body.faces)
    exact.update(body.v_template)
    middle = body.v_template[body.faces].mean(1)
    places = torch.cat((garment.v_template, body.v_template[:100]))
    found, true = rest(places), exact.closest(places).face
    assert found.dtype == torch.int32
    off = (middle[found.long()] - middle[true.long()]).norm(dim=1)
    assert off.median() < 0.02
    assert off.quantile(0.99) < 0.06
    assert rest(places.view(2, -1, 3)).shape == (2, len(places) // 2)
    assert int(rest(torch.full((1, 3), 1e6))) in range(len(body.faces))


def test_gradcheck_of_distance_and_gradient(body: SmplBody, approx: ApproxSdf) -> None:
    skin, worn, unposed = dressed(body, load_garment("tshirt-male"), pose_of("a-pose"))
    near = RestFaces(body)(unposed)
    approx.update(skin)
    found = approx.query(worn, near=near)
    # A few of each kind of closest feature: faces, edges, vertices; none where a millimetre away it is another one.
    aside = [worn + step * axis for axis in torch.eye(3) for step in (-1e-3, 1e-3)]
    nudged = [(points, approx.query(points, near=near).face) for points in aside]
    feature, *_ = approx._features(worn, found.face)
    steady = torch.stack(
        [(face == found.face) & (approx._features(points, face)[0] == feature) for points, face in nudged]
    ).all(0)
    kinds = [feature == 0, (feature >= 1) & (feature < 4), feature >= 4]
    rows = torch.cat([torch.nonzero(steady & kind & (found.distance.abs() > 2e-3))[:6, 0] for kind in kinds])
    assert {min(int(kind), 4) for kind in feature[rows]} >= {0, 4}

    def f(points: Tensor, scale: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        approx.update(skin.double() * scale + shift)
        sample = approx.query(points, near=near[rows])
        return sample.distance, sample.gradient

    points = worn[rows].double().requires_grad_()
    scale = torch.ones(3, dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(f, (points, scale, shift), eps=1e-6, atol=1e-5)


def test_tracked_and_untracked_answers_agree(body: SmplBody, approx: ApproxSdf) -> None:
    skin, worn, unposed = dressed(body, load_garment("tshirt-male"), pose_of("a-pose"))
    near = RestFaces(body)(unposed)
    approx.update(skin)
    plain, tracked = approx.query(worn, near=near), approx.query(worn.clone().requires_grad_(), near=near)
    assert tracked.distance.requires_grad
    torch.testing.assert_close(tracked.distance, plain.distance, atol=1e-6, rtol=0)


def test_a_batch_is_its_bodies_and_keeps_their_derivatives(body: SmplBody, approx: ApproxSdf) -> None:
    garment = load_garment("short-pant-male")
    pairs = [dressed(body, garment, pose_of(pose), seed) for seed, pose in enumerate(("step", "a-pose", "squat"))]
    skins, worn = (torch.stack([pair[k] for pair in pairs]).requires_grad_() for k in (0, 1))
    near = RestFaces(body)(torch.stack([pair[2] for pair in pairs]))
    both = query_batch(approx, skins, worn, near=near)
    assert both.distance.shape == worn.shape[:2]
    assert both.face is not None
    (points, vertices) = torch.autograd.grad(both.distance.sum(), (worn, skins))
    for i in range(3):
        approx.update(skins[i])
        one = approx.query(worn[i], near=near[i])
        assert torch.equal(one.distance, both.distance[i])
        assert torch.equal(one.gradient, both.gradient[i])
        alone = torch.autograd.grad(one.distance.sum(), (worn, skins))
        assert torch.equal(alone[0][i], points[i])
        assert torch.equal(alone[1][i], vertices[i])
    one_hint = query_batch(ExactSdf(body.faces), skins.detach(), worn.detach(), near=near[0])
    assert one_hint.distance.shape == worn.shape[:2]


def test_a_batch_without_bodies_is_empty(body: SmplBody) -> None:
    skins, points = (torch.zeros(0, n, 3, requires_grad=True) for n in (body.n_vertices, 5))
    none = query_batch(ExactSdf(body.faces), skins, points)
    assert none.distance.shape == (0, 5)
    assert none.gradient.shape == (0, 5, 3)
    assert [one.shape for one in torch.autograd.grad(none.distance.sum(), (skins, points))] == [
        skins.shape,
        points.shape,
    ]


def test_satisfies_the_protocol_and_says_what_is_wrong(body: SmplBody) -> None:
    sdf = ApproxSdf(body)
    assert isinstance(sdf, BodySdf)
    points = torch.zeros(4, 3)
    with pytest.raises(MeshError, match=r"call update"):
        sdf.query(points)
    sdf.update(body.v_template)
    with pytest.raises(MeshError, match=r"near must be integers of the shape \(4,\), got torch.int64 of shape \(3,\)"):
        sdf.query(points, near=torch.zeros(3, dtype=torch.int64))
    with pytest.raises(MeshError, match=r"near must be integers"):
        sdf.query(points, near=torch.zeros(4))
    with pytest.raises(MeshError, match=r"points must be finite"):
        sdf.query(points / 0, near=torch.zeros(4, dtype=torch.int32))
    assert sdf.query(points[:0], near=torch.zeros(0, dtype=torch.int32)).distance.shape == (0,)
