"""Garment templates: posing and unposing, following the shape, what loading refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from refu_core import GarmentError, GarmentPipeline, SmplFrame, WeightsError, load_body, load_garment
from refu_core.body import LEGS, apply_transforms, blend_transforms, weight_of_parts
from refu_core.garments import BUILTIN_GARMENTS, PAPER_GARMENTS, SkinBelow
from refu_core.sdf import ExactSdf

PAPER_VERTICES = {"shirt-male": 9723, "tshirt-male": 7702, "short-pant-male": 2710, "skirt-female": 7130}


@pytest.mark.parametrize("name", PAPER_GARMENTS)
def test_about_the_papers_size(name: str) -> None:
    assert load_garment(name).n_vertices == pytest.approx(PAPER_VERTICES[name], rel=0.03)


@pytest.mark.parametrize("name", PAPER_GARMENTS)
@settings(max_examples=10)
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


def write_garment(path: Path, **changes: Any) -> Path:
    """The shorts in a file of one's own; a key that is None is left out, others of the card are changed."""
    with (resources.files("refu_core") / "assets" / "garment_short-pant-male.npz").open("rb") as file:
        arrays = dict(np.load(file))
    card = json.loads(arrays["card"].item())
    card |= {key: value for key, value in changes.items() if key in card}
    arrays["card"] = np.array(json.dumps(card).encode())
    arrays |= {key: value for key, value in changes.items() if key not in card}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def test_a_garment_is_one_file(tmp_path: Path) -> None:
    path = write_garment(tmp_path / "garment_kilt.npz", layer=7, color=[0.5, 0.25, 1])
    kilt, shorts = load_garment(path), load_garment("short-pant-male")
    assert (kilt.name, kilt.card.layer, kilt.card.color) == ("kilt", 7, (0.5, 0.25, 1))
    assert kilt.card.joints == shorts.card.joints
    torch.testing.assert_close(kilt.shapedirs, shorts.shapedirs, atol=0, rtol=0)
    assert load_garment(str(path)).name == "kilt"
    frame = SmplFrame(np.zeros((24, 3)))
    worn = GarmentPipeline.load([str(path), shorts], backbone="skinned", sdf="accurate")
    alone = GarmentPipeline.load(shorts, backbone="skinned", sdf="accurate")
    out = worn(frame)
    assert list(out) == ["kilt", "short-pant-male"]
    # The kilt's layer is the outer one: it is lifted off the shorts, which lie as they do alone.
    np.testing.assert_array_equal(out["short-pant-male"].local, alone(frame)["short-pant-male"].local)
    assert np.abs(out["kilt"].local - out["short-pant-male"].local).max() > 1e-3
    assert GarmentPipeline.load([path, shorts]).untrained == ("kilt",)  # the best there is of each
    with pytest.raises(WeightsError, match="kilt"):
        GarmentPipeline.load(path, backbone="tailornet")


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"layer": -1}, "layer: wanted a whole number up to 99, got -1"),
        ({"layer": True}, "layer: wanted a whole number"),
        ({"color": [0.1, 0.2]}, "color: wanted three numbers"),
        ({"color": [0.1, 0.2, "blue"]}, "color: wanted three numbers"),
        ({"color": 3}, "a card of other types"),
        ({"joints": [0, 24]}, "joints: wanted different numbers of joints, 0 to 23"),
        ({"joints": [1, 1]}, "joints: wanted different"),
        ({"held_at_waist": 1}, "held_at_waist: wanted true or false"),
        ({"tailoring": [{"name": "length", "mean": 0, "std": 0.1}]}, "tailoring: wanted 4 parameters or none"),
        ({"tailoring": [{"name": "length"}]}, "a card of other types"),
        ({"card": None}, "it has no card"),
        ({"card": np.array(b"{}")}, "wanted a card of layer, color"),
        ({"card": np.array(3)}, "card: wanted a text"),
        ({"card": np.array(b"[" * 4000)}, "not a garment"),
        ({"body": np.array("robot")}, "cut for the body 'robot': wanted"),
        ({"weights": np.zeros((2699, 24))}, "rows that sum to 1"),
        ({"weights": np.zeros((2, 24))}, "weights: wanted finite numbers"),
        ({"v_template": np.full((2699, 3), np.nan)}, "v_template: wanted finite numbers"),
        ({"v_template": np.array("word")}, "v_template: wanted finite numbers"),
        ({"v_template": np.full((5, 3), "x")}, "v_template: wanted finite numbers .*, got <U1"),
        ({"f": np.array([[0, 1, 2699]])}, "faces must index vertices 0 to 2698"),
    ],
)
def test_files_that_make_no_garment_are_refused(changes: dict[str, Any], wanted: str, tmp_path: Path) -> None:
    with pytest.raises(GarmentError, match=wanted):
        load_garment(write_garment(tmp_path / "kilt.npz", **changes))


def test_paths_that_name_no_garment_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GarmentError, match=r"kilt\.npz: can't be read"):
        load_garment(tmp_path / "kilt.npz")
    with pytest.raises(GarmentError, match="a garment has its file's name"):
        load_garment(write_garment(tmp_path / "a kilt.npz"))
    with pytest.raises(GarmentError, match=r"wanted a garment's name or the path of an \.npz, got int"):
        load_garment(5)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", PAPER_GARMENTS)
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


@pytest.mark.parametrize("name", ["tshirt-male", "skirt-female"])
def test_cloth_goes_with_the_skin_that_it_lies_on(name: str) -> None:
    garment = load_garment(name)
    body = load_body(garment.body)
    below = SkinBelow.of(garment, body)
    together = torch.tensor([0.01, -0.02, 0.03])
    as_one = below(together.expand(2, body.n_vertices, 3))
    torch.testing.assert_close(as_one, together.expand(2, garment.n_vertices, 3))
    shift = torch.randn(2, body.n_vertices, 3, generator=torch.Generator().manual_seed(0))
    moved = below(shift)
    parts = weight_of_parts(body.weights, (tuple({*range(24)} - {*LEGS[0], *LEGS[1]}), *LEGS)).argmax(1)
    for i in range(0, garment.n_vertices, 500):
        square = (body.v_template - garment.v_template[i]).norm(dim=1) ** 2
        nearest = torch.stack([square[parts == part].min() for part in range(3)])
        of_part = (-2 * nearest / nearest.min()).softmax(0)
        weight = torch.zeros(body.n_vertices)
        for part in range(3):
            own = torch.nonzero(parts == part)[:, 0]
            own = own[square[own].argsort()[:8]]
            within = (-(square[own] - square[own].min()) / (2 * 0.01**2)).softmax(0)
            weight[own] = of_part[part] * within
        weight[weight.argsort()[:-8]] = 0
        wanted = (weight[:, None] * shift).sum(1) / weight.sum()
        torch.testing.assert_close(moved[:, i], wanted, atol=1e-4, rtol=1e-4)


def test_cloth_between_the_legs_goes_half_way_with_either() -> None:
    garment = load_garment("skirt-female")
    body = load_body(garment.body)
    shift = torch.zeros(1, body.n_vertices, 3)
    shift[0, weight_of_parts(body.weights, LEGS)[:, 0] > 0.5, 0] = 1.0
    moved = SkinBelow.of(garment, body)(shift)[0, :, 0]
    hem = torch.nonzero(garment.v_template[:, 1] < garment.v_template[:, 1].min() + 0.02)[:, 0]
    front = hem[(garment.v_template[hem, 2] > 0.1)]
    middle = front[garment.v_template[front, 0].abs().argmin()]
    assert 0.35 < float(moved[middle]) < 0.65
    # Along the hem from one leg to the other it is a slope, not a step.
    across = front[garment.v_template[front, 0].argsort()]
    assert float(moved[across].diff().abs().max()) < 0.25


def test_gradcheck_of_cloth_that_goes_with_the_skin() -> None:
    garment, body = load_garment("short-pant-male"), load_body("male").to(dtype=torch.float64)
    below = SkinBelow.of(garment, body)
    few = SkinBelow(below.vertex[:20] % 30, below.weight[:20])
    shift = torch.randn(2, 30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(few, shift)
