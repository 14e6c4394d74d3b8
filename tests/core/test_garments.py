"""Garment templates: posing and unposing, following the shape, what loading refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from refu_core import GarmentError, load_body, load_garment
from refu_core.body import apply_transforms, blend_transforms
from refu_core.garments import BUILTIN_GARMENTS
from refu_core.sdf import ExactSdf

PAPER_VERTICES = {"shirt-male": 9723, "tshirt-male": 7702, "short-pant-male": 2710, "skirt-female": 7130}


@pytest.mark.parametrize("name", BUILTIN_GARMENTS)
def test_about_the_papers_size(name: str) -> None:
    assert load_garment(name).n_vertices == pytest.approx(PAPER_VERTICES[name], rel=0.03)


@pytest.mark.parametrize("name", BUILTIN_GARMENTS)
@given(seed=st.integers(0, 2**32 - 1))
def test_unposing_inverts_posing(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    garment = load_garment(name, dtype=torch.float64)
    body = load_body(garment.body, dtype=torch.float64)
    betas = torch.as_tensor(rng.normal(size=(2, 10)))
    transforms = body(rng.uniform(-1.2, 1.2, (2, 24, 3)) / np.sqrt(3), betas).transforms
    unposed = garment.rest(betas) + 0.01 * torch.as_tensor(rng.normal(size=(2, garment.n_vertices, 3)))
    torch.testing.assert_close(
        garment.unpose(garment.pose(unposed, transforms), transforms), unposed, atol=1e-9, rtol=0
    )


def test_unposing_stays_finite_where_blends_collapse() -> None:
    garment, body = load_garment("tshirt-male"), load_body("male")
    pose = torch.zeros(1, 24, 3)
    pose[0, 16] = torch.tensor([torch.pi, 0, 0])  # the upper arm turned half a turn against the collar
    transforms = body(pose).transforms
    posed = garment.pose(garment.rest(torch.zeros(1, 10)), transforms)
    assert torch.isfinite(garment.unpose(posed, transforms)).all()


@pytest.mark.parametrize("name", BUILTIN_GARMENTS)
def test_rest_pose_leaves_the_template_where_it_is(name: str) -> None:
    garment = load_garment(name)
    body = load_body(garment.body)
    betas = torch.randn(1, 10, generator=torch.Generator().manual_seed(0))
    rest = garment.rest(betas)
    torch.testing.assert_close(
        garment.pose(rest, body(torch.zeros(1, 24, 3), betas).transforms), rest, atol=1e-6, rtol=0
    )


def test_skin_points_posed_as_a_garment_move_with_the_skin() -> None:
    """A garment point with a body vertex's place and weights must follow that vertex exactly."""
    body = load_body("female", dtype=torch.float64)
    betas = torch.randn(1, 10, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    out = body(0.5 * torch.randn(1, 24, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64), betas)
    skinned = apply_transforms(body.rest_vertices(betas), blend_transforms(body.weights, out.transforms))
    torch.testing.assert_close(skinned, out.vertices)


def test_turning_the_person_turns_the_garment() -> None:
    garment, body = load_garment("skirt-female"), load_body("female")
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(3)
    pose = rng.normal(0, 0.3, (24, 3))
    turn = Rotation.from_rotvec([0.3, 2.1, -0.4])
    turned = pose.copy()
    turned[0] = (turn * Rotation.from_rotvec(pose[0])).as_rotvec()
    rest = garment.rest(torch.zeros(1, 10))
    here, there = (garment.pose(rest, body(p[None]).transforms)[0].numpy() for p in (pose, turned))
    root = body.rest_joints(torch.zeros(1, 10))[0, 0].numpy()
    np.testing.assert_allclose(turn.apply(here - root) + root, there, atol=2e-6)


def test_edges_are_each_there_once() -> None:
    garment = load_garment("short-pant-male")
    edges = garment.edges.numpy()
    wanted = {tuple(sorted((int(f[i]), int(f[(i + 1) % 3])))) for f in garment.faces.numpy() for i in range(3)}
    assert len(edges) == len(wanted)
    assert {(int(a), int(b)) for a, b in edges} == wanted


def test_unknown_garments_and_styles_are_named() -> None:
    with pytest.raises(GarmentError, match="no garment 'kilt': wanted one of shirt-male"):
        load_garment("kilt")
    plain = replace(load_garment("tshirt-male"), styledirs=None)
    with pytest.raises(GarmentError, match="tshirt-male has one style only"):
        plain.rest(torch.zeros(1, 10), torch.zeros(1, 4))


@pytest.mark.parametrize("name", BUILTIN_GARMENTS)
def test_styles_change_the_cut_and_stay_outside(name: str) -> None:
    garment = load_garment(name)
    assert garment.styledirs is not None
    body = load_body(garment.body)
    sdf = ExactSdf(body.faces)
    sdf.update(body.v_template)
    betas = torch.zeros(1, 10)
    mean = garment.rest(betas)
    torch.testing.assert_close(garment.rest(betas, torch.zeros(1, 4)), mean)
    for k in range(4):
        for sign in (-1.5, 1.5):
            style = torch.zeros(1, 4)
            style[0, k] = sign
            cut = garment.rest(betas, style)
            assert (cut - mean).norm(dim=-1).max() > 0.003
            assert float(sdf.query(cut[0]).distance.min()) > 0
