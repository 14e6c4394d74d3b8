"""Cloth on people who lie, run, or have their legs apart: what is added there, and that nobody else notices."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_set import write_set
from torch import Tensor

import refu_core
from refu_core import GarmentPipeline, RefuError, SmplFrame, Wearer, dress, load_body, load_garment
from refu_core.backbones import (
    KINDS,
    BasisDecoder,
    Beyond,
    BeyondConfig,
    WithBeyond,
    heels_share,
    legs_share,
    load_backbone,
    lying_share,
    save_beyond,
    up_in_root,
)
from refu_core.errors import WeightsError
from refu_core.sdf import ExactSdf
from refu_core.simulation import SamplePlan, posture
from refu_core.training import BeyondSettings, LoopSettings, PretrainSettings, Rehearsal, pretrain, train_beyond
from refu_core.weights import load_weights
from refu_lab.commands.train import BEYOND

pytestmark = pytest.mark.usefixtures("no_curves_in_module")
GARMENT = "tshirt-male"
OWN = "short-pant-male"
LYING = ("lying on the back", "lying on the belly", "lying on the side")


def tilted(degrees: float, *, about: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> Tensor:
    """A straight person whose pelvis is tilted, shape (1, 24, 3)."""
    pose = torch.zeros(1, 24, 3)
    pose[0, 0] = np.radians(degrees) * torch.tensor(about)
    return pose


def with_legs(left: tuple[float, float, float], right: tuple[float, float, float]) -> Tensor:
    """Somebody upright whose hips are turned so [degrees], shape (1, 24, 3)."""
    pose = torch.zeros(1, 24, 3)
    pose[0, 1:3] = torch.deg2rad(torch.tensor((left, right)))
    return pose


@given(st.floats(0, 179.5))
def test_it_is_faded_in_without_a_step(degrees: float) -> None:
    here, there = float(lying_share(tilted(degrees))), float(lying_share(tilted(degrees + 0.5)))
    assert abs(here - there) < 0.06
    assert here == (0 if degrees <= 60 or degrees >= 120 else here)
    assert here == (1 if 76 < degrees < 104 else here)


@given(st.lists(st.lists(st.floats(-4, 4), min_size=3, max_size=3), min_size=6, max_size=6), st.sampled_from([*KINDS]))
def test_who_is_in_a_posture_is_whose_share_is_above_zero(turns: list[list[float]], kind: str) -> None:
    pose = torch.zeros(1, 24, 3, dtype=torch.float64)
    pose[0, :6] = torch.tensor(turns)
    share = float(KINDS[kind].share(pose))
    if kind == "legs" and KINDS["lying"].is_any(turns):
        assert share < 1  # faded out towards who lies, down to zero
    if kind == "heels" and float(legs_share(pose)) > 0:
        assert share < 1  # faded out towards whose legs are apart, down to zero
    elif not 0 < share < 1e-9:  # at the brink, rounding decides
        assert KINDS[kind].is_any(turns) == (share > 0)


@given(st.floats(0, 160), st.sampled_from([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, 0.7, 0.7)]))
def test_legs_are_faded_in_without_a_step(degrees: float, axis: tuple[float, float, float]) -> None:
    x, y, z = axis
    here, there = (float(legs_share(with_legs((x * a, y * a, z * a), (0, 0, 0)))) for a in (degrees, degrees + 0.5))
    assert abs(here - there) < 0.06
    assert here == (0 if degrees <= 36 else here)
    assert here == (1 if z == 0 and degrees >= 110.1 else here)


@pytest.mark.parametrize(("both_hips", "share"), [(-85, 0), (-99, 0), (-121, 1), (-130, 1)])
def test_sitting_is_known_and_squatting_is_not(both_hips: float, share: float) -> None:
    assert float(legs_share(with_legs((both_hips, 0, 0), (both_hips, 0, 0)))) == share


def with_knee(hip: float, knee: float) -> Tensor:
    """Somebody upright whose right leg is bent so [degrees], shape (1, 24, 3)."""
    pose = with_legs((0, 0, 0), (hip, 0, 0))
    pose[0, 5, 0] = math.radians(knee)
    return pose


@pytest.mark.parametrize(
    ("hip", "knee", "share"), [(-20, 50, 0), (-85, 110, 0), (-98, 18, 0), (20, 70, 1), (-30, 120, 1), (5, 130, 1)]
)
def test_runners_raise_their_heels_and_who_walks_sits_or_kicks_does_not(hip: float, knee: float, share: int) -> None:
    assert float(heels_share(with_knee(hip, knee))) == share


@given(st.floats(-60, 20), st.floats(0, 140))
def test_heels_are_faded_in_without_a_step(hip: float, knee: float) -> None:
    here, there = (float(heels_share(with_knee(hip, one))) for one in (knee, knee + 0.5))
    assert abs(here - there) < 0.06


@given(st.floats(-120, 60))
def test_thighs_drawn_up_or_back_are_faded_in_without_a_step(hip: float) -> None:
    here, there = (float(legs_share(with_legs((one, 0, 0), (0, 0, 0)))) for one in (hip, hip + 0.5))
    assert abs(here - there) < 0.06
    assert here == (0 if -85 <= hip <= 25 else here)
    assert here == (1 if hip >= 50.1 else here)


def test_who_lies_with_legs_apart_lies() -> None:
    pose = with_legs((0, 0, 50), (0, 0, -50))
    assert float(legs_share(pose)) == 1
    pose[0, 0] = tilted(90)[0, 0]
    assert float(legs_share(pose)) == 0
    assert float(lying_share(pose)) == 1
    pose[0, 5, 0] = math.radians(110)
    assert float(heels_share(pose)) == 0


@pytest.mark.parametrize("degrees", [0, 45, 59.9, 125, 180])
def test_who_does_not_lie_wears_what_the_backbone_says(degrees: float) -> None:
    both = load_backbone("tailornet", GARMENT, mode="hybrid")
    assert isinstance(both, WithBeyond)
    given = torch.zeros(1, 10), tilted(degrees), None
    assert torch.equal(both(*given), both.known(*given))


def test_who_lies_wears_something_else_beside_who_stands() -> None:
    both = load_backbone("tailornet", GARMENT, mode="hybrid")
    assert isinstance(both, WithBeyond)
    betas, pose = torch.zeros(3, 10), torch.cat((tilted(10), tilted(90), tilted(-90)))
    added = (both(betas, pose, None) - both.known(betas, pose, None)).norm(dim=-1)
    assert float(added[0].max()) == 0
    assert float(added[1:].mean(1).min()) > 0.002
    alone = torch.cat([both(betas[:1], one[None], None) for one in pose])
    torch.testing.assert_close(alone, both(betas, pose, None), rtol=0, atol=1e-5)


def test_a_hem_lies_on_the_calf_of_who_runs(tmp_path: Path) -> None:
    """The network is told of the knees, though the dress's backbone sees none."""
    garment = "dress-female"
    shipped = Path(refu_core.__file__).parent / "weights" / garment
    shutil.copytree(shipped, tmp_path / garment, ignore=shutil.ignore_patterns("heels.*"))
    pose = with_knee(-25, 115)[0].numpy()
    without, with_it = (
        GarmentPipeline.load([garment], sdf="none", **how)(SmplFrame(pose=pose))[garment].local
        for how in ({"weights": tmp_path}, {})
    )
    is_lifted = with_it[:, 1] - without[:, 1] > 0.03
    assert is_lifted.sum() > 50
    assert with_it[is_lifted, 2].mean() < -0.05  # behind
    assert with_it[is_lifted, 0].mean() < -0.02  # right


@pytest.mark.parametrize("name", ["side lunge", "leg behind", "leg to the side", "bent knees turned out"])
@pytest.mark.parametrize("garment", ["dress-female", "skirt-female"])
def test_thighs_are_less_deep_in_loose_cloth(garment: str, name: str, tmp_path: Path) -> None:
    shipped = Path(refu_core.__file__).parent / "weights" / garment
    shutil.copytree(shipped, tmp_path / garment, ignore=shutil.ignore_patterns("legs.*"))
    depth = []
    for how in ({"weights": tmp_path}, {}):
        pipeline = GarmentPipeline.load([garment], sdf="none", **how)
        output = pipeline(SmplFrame(pose=posture(name)))
        sdf = ExactSdf(pipeline.body.faces)
        sdf.update(torch.tensor(output.body))
        depth.append(float((-sdf.query(torch.tensor(output[garment].local)).distance).clamp(min=0).mean()))
    assert depth[1] < 0.7 * depth[0]


def on_a_bed(pose: Tensor) -> Tensor:
    """Shorts that slide down, as far as they lie on front or back."""
    n = load_garment(OWN).n_vertices
    return 0.05 * up_in_root(pose)[:, 2:, None] * torch.tensor([1.0, 0.0, 0.0]).expand(len(pose), n, 3)


def lying_set(folder: Path, seed: int, **how: Any) -> dict[str, Any]:
    """A set of people turned in any direction, as if it were of a plan of people who lie; that plan."""
    how = {"pairs": 60, "test_pairs": 8, "displacement": on_a_bed, **how}
    count, garment = 4 * how["pairs"], load_garment(OWN)
    plan = asdict(SamplePlan(OWN, count, seed=seed, recorded_share=0.0, posture_share=1.0, postures=LYING))
    write_set(folder, garment, load_body(garment.body), poses=4, spread=0.8, turn=1.3, plan=plan, **how)
    return plan


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of shorts, learnt from people who stand, and a set of people who lie."""
    folder, garment = tmp_path_factory.mktemp("lying"), load_garment(OWN)
    body = load_body(garment.body)
    plan = asdict(SamplePlan(OWN, 60, pivots=4, recorded_share=0.0))
    write_set(folder / "standing", garment, body, pairs=12, poses=5, displacement=on_a_bed, plan=plan)
    lying_set(folder / "lying", 1)
    loop = LoopSettings(batch_size=16, check_every=20)
    few = PretrainSettings(loop, rank=4, style_shape_steps=2, low_steps=2, steps=2)
    pretrain(OWN, folder / "standing", folder / "weights", settings=few, quiet=True)
    return folder


def test_it_learns_what_a_backbone_cannot_know_and_comes_back_from_its_file(folder: Path) -> None:
    settings = BeyondSettings(LoopSettings(batch_size=32, learning_rate=3e-3), steps=500)
    how: dict[str, Any] = {"mode": "none", "rehearsal": Rehearsal(30), "settings": settings}
    card = train_beyond("lying", OWN, folder / "lying", folder / "weights", **how)
    assert card["figures"]["mpve_mm"] < 0.8 * card["figures"]["without_mm"]
    both = load_backbone("tailornet", OWN, mode="none", folder=folder / "weights")
    assert isinstance(both, WithBeyond)
    pose = torch.cat((tilted(0), tilted(90)))
    off = (both(torch.zeros(2, 10), pose, None) - both.known(torch.zeros(2, 10), pose, None)).norm(dim=-1).mean(1)
    assert off[0] == 0
    assert float(off[1]) > 0.005
    assert card["rehearsed"] == {"count": 0, "plans": []}  # of those plans nobody lies
    again = train_beyond("lying", OWN, folder / "lying", folder / "weights", **how)
    assert again["figures"] == card["figures"]


def test_it_is_gone_on_with(folder: Path, tmp_path: Path) -> None:
    """What was learnt from a set that isn't there any more is rehearsed, beside the few people of a new one."""
    weights, lost, later = tmp_path / "weights", folder / "lying", tmp_path / "later"
    shutil.copytree(folder / "weights", weights, ignore=shutil.ignore_patterns("lying.*"))
    plan = json.loads((lost / "card.json").read_text())["plan"]
    lying_set(later, 2, pairs=6, test_pairs=2, displacement=None)
    settings = BeyondSettings(LoopSettings(batch_size=32, learning_rate=3e-3), steps=300)
    how: dict[str, Any] = {"mode": "none", "rehearsal": Rehearsal(300), "settings": settings}

    def added() -> Tensor:
        both = load_backbone("tailornet", OWN, mode="none", folder=weights)
        assert isinstance(both, WithBeyond)
        given = torch.zeros(1, 10), tilted(-90), None
        return both(*given) - both.known(*given)

    train_beyond("lying", OWN, lost, weights, **how)
    before = added()
    card = train_beyond("lying", OWN, later, weights, **how)
    assert json.loads(json.dumps(card["rehearsed"]["plans"])) == [plan]
    assert card["rehearsed"]["count"] > 100
    off = (added() - before).norm()
    (weights / "lying.json").unlink()
    train_beyond("lying", OWN, later, weights, **how)
    assert off < 0.5 * (added() - before).norm()


def test_nothing_is_rehearsed_where_all_plans_are_known(folder: Path, tmp_path: Path) -> None:
    weights = tmp_path / "weights"
    shutil.copytree(folder / "weights", weights, ignore=shutil.ignore_patterns("lying.*"))
    how: dict[str, Any] = {"mode": "none", "settings": BeyondSettings(LoopSettings(batch_size=32), steps=2)}
    sets = [folder / "standing", folder / "lying"]
    card = train_beyond("lying", OWN, sets, weights, rehearsal=Rehearsal(0), **how)
    assert card["rehearsed"] == {"count": 0, "plans": []}


def test_one_that_went_with_another_tailornet_is_learnt_anew(folder: Path, tmp_path: Path) -> None:
    weights, later = tmp_path / "weights", tmp_path / "later"
    shutil.copytree(folder / "weights", weights, ignore=shutil.ignore_patterns("lying.*"))
    how: dict[str, Any] = {"mode": "none", "settings": BeyondSettings(LoopSettings(batch_size=32), steps=2)}
    train_beyond("lying", OWN, folder / "lying", weights, rehearsal=Rehearsal(9), **how)
    card = json.loads((weights / "lying.json").read_text())
    card |= {"tailornet_sha256": "0" * 64, "basis_sha256": "0" * 64}
    (weights / "lying.json").write_text(json.dumps(card))
    lying_set(later, 2, pairs=6, test_pairs=2)
    assert train_beyond("lying", OWN, later, weights, rehearsal=Rehearsal(9), **how)["rehearsed"]["plans"] == []
    load_backbone("tailornet", OWN, mode="none", folder=weights)


def test_nobody_lies_in_a_set_of_people_who_stand(folder: Path) -> None:
    with pytest.raises(RefuError, match=r"of the kind lying to learn from and to test on, the set of .* has 0 and 0"):
        train_beyond("lying", OWN, folder / "standing", folder / "weights", mode="none", rehearsal=Rehearsal(30))


def test_what_does_not_belong_together_is_refused(folder: Path, tmp_path: Path) -> None:
    for file in (folder / "weights").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    card = {"garment": OWN, "body_fingerprint": load_body("male").fingerprint}
    components = torch.linalg.qr(torch.randn(30, 2)).Q.T
    save_beyond(tmp_path, Beyond("lying", BeyondConfig((0, 1)), BasisDecoder(torch.zeros(10, 3), components)), card)
    with pytest.raises(WeightsError, match=r"lying.* got 10; train it again"):
        load_backbone("tailornet", OWN, mode="none", folder=tmp_path)
    other = (tmp_path / "lying.json").read_text()
    (tmp_path / "lying.json").write_text(other.replace(load_weights(tmp_path / "basis").card["sha256"], "0" * 64))
    with pytest.raises(WeightsError, match="basis_sha256"):
        load_backbone("tailornet", OWN, mode="none", folder=tmp_path)


def test_kinds_of_postures_have_networks_of_their_own(folder: Path, tmp_path: Path) -> None:
    for file in (folder / "weights").iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    squat = with_legs((-120, 0, 0), (-120, 0, 0))
    garment, pose = load_garment(OWN), torch.cat((tilted(0), tilted(90), squat, with_knee(-20, 120)))
    card = {"garment": OWN, "body_fingerprint": load_body("male").fingerprint}
    components = torch.linalg.qr(torch.randn(3 * garment.n_vertices, 2)).Q.T
    given = torch.zeros(4, 10), pose, None
    known = load_backbone("tailornet", OWN, mode="none", folder=tmp_path)(*given)
    changed = []
    for kind in KINDS:
        decoder = BasisDecoder(torch.zeros(garment.n_vertices, 3), components)
        save_beyond(tmp_path, Beyond(kind, BeyondConfig((0, 1, 2)), decoder), card)
        both = load_backbone("tailornet", OWN, mode="none", folder=tmp_path)
        changed.append(((both(*given) - known).abs().amax((1, 2)) > 0).tolist())
    assert changed == [[False, True, False, False], [False, True, True, False], [False, True, True, True]]


def test_no_such_kind(folder: Path) -> None:
    with pytest.raises(RefuError, match="no kind of postures sitting: wanted lying, legs, heels"):
        train_beyond("sitting", OWN, folder / "lying", folder / "weights", rehearsal=Rehearsal(1))


def test_the_command_knows_every_kind() -> None:
    assert set(BEYOND) == set(KINDS)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_a_pose_that_is_none_makes_no_error_of_its_own(value: float) -> None:
    """The functions of tensors give NaN for it; an infinite one ended in a *math domain error*."""
    outfit = GarmentPipeline.load(["tshirt-male"], collider=False).outfit
    pose = torch.zeros(2, 24, 3)
    pose[0, 0, 1] = value
    wearer = Wearer.of(outfit, torch.zeros(2, 10))
    worn = dress(pose, wearer).drapes["tshirt-male"].vertices
    assert bool(worn[0].isnan().any())
    torch.testing.assert_close(worn[1], dress(torch.zeros_like(pose), wearer).drapes["tshirt-male"].vertices[1])
