"""Training that goes on from trained weights: with wider inputs, and with what they knew rehearsed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_set import write_set
from torch import Tensor

from refu_core import load_body, load_garment
from refu_core.backbones import Mlp, MlpConfig, backbone_from_weights
from refu_core.errors import RefuError, WeightsError
from refu_core.simulation import Clip, SamplePlan, split_clips
from refu_core.training import LoopSettings, PretrainSettings, Rehearsal, pretrain
from refu_core.training._data import Mirror, mirror_pose
from refu_core.training._pretrain import tell_of
from refu_core.training._rehearsal import _SEEDS_APART, symmetric
from refu_core.weights import Weights, load_weights

pytestmark = pytest.mark.usefixtures("no_curves_in_module")
GARMENT = "short-pant-male"
PLAN = SamplePlan(GARMENT, 60, pivots=4, recorded_share=0.0)
LOOP = LoopSettings(batch_size=16, learning_rate=1e-2, weight_decay=0.01, check_every=20)
QUICK = PretrainSettings(LOOP, rank=8, steps=300, validation_share=0.2)


def lifted(pose: Tensor, *, by: float) -> Tensor:
    """Shorts that a bent hip lifts as a whole (N, V, 3) [m]."""
    n = load_garment(GARMENT).n_vertices
    return (by * pose[:, 1, 0])[:, None, None] * torch.tensor([0.0, 1.0, 0.0]).expand(len(pose), n, 3)


def made(folder: Path, *, spread: float, by: float, plan: SamplePlan = PLAN) -> Path:
    """A small set that says which plan it is of."""
    garment = load_garment(GARMENT)
    body = load_body(garment.body)
    write_set(folder, garment, body, pairs=12, poses=5, spread=spread, displacement=lambda pose: lifted(pose, by=by))
    card = json.loads((folder / "card.json").read_text())
    (folder / "card.json").write_text(json.dumps(card | {"plan": asdict(plan)}))
    return folder


@pytest.fixture(scope="module")
def first(no_curves_in_module: None, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: ARG001
    """Weights of hips bent by .2, where cloth is lifted."""
    folder = tmp_path_factory.mktemp("first")
    data = made(folder / "set", spread=0.2, by=0.05)
    config = MlpConfig((0, 1, 2, 4, 5), hidden=(16,))
    pretrain(GARMENT, data, folder, backbone="mlp", settings=QUICK, config=config, quiet=True)
    return folder


@pytest.fixture(scope="module")
def further(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Samples of hips bent by .6, where cloth is lowered."""
    return made(tmp_path_factory.mktemp("further"), spread=0.6, by=-0.05, plan=replace(PLAN, seed=1))


def test_bodies_of_the_plan_are_what_is_rehearsed(first: Path) -> None:
    stored = load_weights(first / "mlp-none")
    network = backbone_from_weights(stored, load_garment(GARMENT))
    samples = Rehearsal(7).of(stored.card, network)
    slots = np.linspace(0, PLAN.count - PLAN.n_test - 1, 7).round().astype(int)
    for k, slot in enumerate(slots):
        pose, _, _ = PLAN.pose(int(slot), 0, [])
        betas, style = PLAN.style_shape(PLAN.pair_of(int(slot)))
        np.testing.assert_array_equal(samples.pose[k], pose)
        predicted = network(*(torch.as_tensor(one)[None] for one in (betas, pose, style)))
        assert predicted is not None
        torch.testing.assert_close(samples.displacement[k], predicted[0], atol=1e-6, rtol=0)
    assert len(Rehearsal(1000).of(stored.card, network)) == PLAN.count - PLAN.n_test


def test_what_was_learnt_later_is_rehearsed_too(first: Path) -> None:
    stored = load_weights(first / "mlp-none")
    network = backbone_from_weights(stored, load_garment(GARMENT))
    later = replace(PLAN, count=24, seed=5)
    card = {"rehearsed": {"count": 3, "plans": [asdict(PLAN)]}, "dataset": {"plan": asdict(later)}}
    samples = Rehearsal(1000).of({"garment": GARMENT, **card}, network)
    wanted = [plan.pose(slot, 0, [])[0] for plan in (PLAN, later) for slot in range(plan.count - plan.n_test)]
    np.testing.assert_array_equal(samples.pose, np.stack(wanted))


def test_bodies_whose_truth_is_known_are_not_asked_about(first: Path) -> None:
    stored = load_weights(first / "mlp-none")
    network = backbone_from_weights(stored, load_garment(GARMENT))
    later = asdict(replace(PLAN, count=24, seed=5))
    card = {"garment": GARMENT, "rehearsed": {"plans": [asdict(PLAN)]}, "dataset": {"plan": later}}
    assert len(Rehearsal(1000).of(card, network, known=[later])) == PLAN.count - PLAN.n_test
    with pytest.raises(RefuError, match="nothing to rehearse"):
        Rehearsal(3).of(stored.card, network, known=[asdict(PLAN)])


def test_recorded_poses_are_those_of_the_training_motions(first: Path) -> None:
    stored = load_weights(first / "mlp-none")
    network = backbone_from_weights(stored, load_garment(GARMENT))
    plan = asdict(replace(PLAN, recorded_share=1.0))
    clips = [Clip(name, np.full((5, 24, 3), k, np.float32), np.zeros((5, 3)), 30.0) for k, name in enumerate("abc")]
    card = {"garment": GARMENT, "dataset": {"plan": plan}}
    samples = Rehearsal(20, clips).of(card, network)
    training = {float(clip.poses[0, 5, 0]) for clip in split_clips(clips)[0]}
    assert {float(pose[5, 0]) for pose in samples.pose} == training
    with pytest.raises(RefuError, match=r"up to 100% of what is to be rehearsed are recorded poses: give"):
        Rehearsal(20).of(card, network)


@pytest.mark.parametrize("card", [{}, {"dataset": {}}, {"dataset": {"plan": {"count": 3}}}])
def test_weights_without_a_plan_have_nothing_to_rehearse(first: Path, card: dict[str, Any]) -> None:
    network = backbone_from_weights(load_weights(first / "mlp-none"), load_garment(GARMENT))
    with pytest.raises(RefuError, match="nothing to rehearse"):
        Rehearsal(3).of({"garment": GARMENT, **card}, network)


@pytest.mark.parametrize(
    "card",
    [
        *({"rehearsed": "x"}, {"rehearsed": []}, {"rehearsed": {"plans": 5}}, {"dataset": "x"}),
        {"dataset": {"plan": asdict(PLAN) | {"garment": "skirt-female"}}},
        {"dataset": {"plan": asdict(PLAN) | {"garment": 5}}},
        {"dataset": {"plan": asdict(PLAN) | {"count": None}}},
    ],
)
def test_damaged_cards_get_a_sentence(first: Path, card: dict[str, Any]) -> None:
    network = backbone_from_weights(load_weights(first / "mlp-none"), load_garment(GARMENT))
    with pytest.raises(RefuError, match=r"nothing to rehearse|a plan is made of"):
        Rehearsal(3).of({"garment": GARMENT, **card}, network)


def test_a_plan_without_end_is_not_counted_out(first: Path) -> None:
    network = backbone_from_weights(load_weights(first / "mlp-none"), load_garment(GARMENT))
    plan = replace(PLAN, count=10**9, recorded_share=0.0)
    assert len(Rehearsal(5).of({"garment": GARMENT, "dataset": {"plan": asdict(plan)}}, network)) == 5


def test_weights_that_need_another_basis_keep_theirs(first: Path, further: Path, tmp_path: Path) -> None:
    """Those of a folder that were trained from scratch before."""
    folder = tmp_path / "own"
    config = MlpConfig((0, 1, 2, 4, 5), hidden=(8,))
    few = replace(QUICK, rank=4, steps=3)
    pretrain(GARMENT, further, folder, backbone="mlp", settings=few, config=config, quiet=True)
    before = (folder / "basis.safetensors").read_bytes()
    how: dict[str, Any] = {"backbone": "mlp", "settings": few, "start": first, "quiet": True}
    (folder / "tailornet-none.json").write_text((folder / "mlp-none.json").read_text())
    with pytest.raises(WeightsError, match=r"tailornet-none.json: was trained with another basis .* use a new folder"):
        pretrain(GARMENT, further, folder, **how)
    assert (folder / "basis.safetensors").read_bytes() == before
    (folder / "tailornet-none.json").unlink()
    pretrain(GARMENT, further, folder, **how)
    assert (folder / "basis.safetensors").read_bytes() == (first / "basis.safetensors").read_bytes()


@torch.no_grad()
def errors(stored: Weights, spread: float, by: float) -> float:
    network = backbone_from_weights(stored, load_garment(GARMENT))
    pose = torch.zeros(9, 24, 3)
    pose[:, 1, 0] = torch.linspace(-spread, spread, 9)
    predicted = network(torch.zeros(9, 10), pose, torch.zeros(9, 4))
    assert predicted is not None
    return float((predicted - lifted(pose, by=by)).norm(dim=-1).mean())


def test_learns_beyond_what_it_saw_and_forgets_less(first: Path, further: Path, tmp_path: Path) -> None:
    before = load_weights(first / "mlp-none")
    how: dict[str, Any] = {"backbone": "mlp", "settings": QUICK, "start": first, "quiet": True}
    card = pretrain(GARMENT, further, tmp_path / "a", **how)
    alone = load_weights(tmp_path / "a" / "mlp-none")
    assert card["goes_on_from"] == before.card["sha256"]
    assert alone.card["config"] == before.card["config"]
    assert alone.card["basis_sha256"] == before.card["basis_sha256"]
    assert (alone.tensors["backbone.net.highest"] >= before.tensors["backbone.net.highest"]).all()
    assert (alone.tensors["backbone.net.highest"] > before.tensors["backbone.net.highest"]).any()
    assert torch.equal(alone.tensors["backbone.net.scale"], before.tensors["backbone.net.scale"])
    assert errors(alone, 0.6, -0.05) < 0.7 * errors(before, 0.6, -0.05)
    again = pretrain(GARMENT, further, tmp_path / "b", rehearsal=Rehearsal(50), **how)
    assert again["rehearsed"] == {"count": 50, "plans": [asdict(PLAN)]}
    rehearsed = load_weights(tmp_path / "b" / "mlp-none")
    known = Rehearsal(40).of(before.card, backbone_from_weights(before, load_garment(GARMENT)))
    drift = []
    for stored in (alone, rehearsed):
        network = backbone_from_weights(stored, load_garment(GARMENT))
        with torch.no_grad():
            drift.append(
                float((network(known.betas, known.pose, known.style) - known.displacement).norm(dim=-1).mean())
            )
    assert drift[1] < 0.8 * drift[0]


def test_further_bodies_are_drawn_as_the_plans_draw_theirs(first: Path) -> None:
    stored = load_weights(first / "mlp-none")
    network = backbone_from_weights(stored, load_garment(GARMENT))
    known, more, many = (Rehearsal(7, further=count).of(stored.card, network) for count in (0, 30, 200))
    assert (len(known), len(more), len(many)) == (7, 37, 207)
    torch.testing.assert_close(more.pose[:7], known.pose)
    assert len(torch.unique(many.pose.flatten(1), dim=0)) == 207
    other = replace(PLAN, seed=PLAN.seed + _SEEDS_APART)
    np.testing.assert_array_equal(more.pose[7], other.pose(0, 0, [])[0])


def test_what_is_said_of_the_mirrored_person_teaches_too(first: Path) -> None:
    garment = load_garment(GARMENT)
    network = backbone_from_weights(load_weights(first / "mlp-none"), garment)
    mirror = Mirror.of(garment)
    assert mirror is not None
    betas, style, pose = torch.randn(5, 10), torch.zeros(5, 4), 0.3 * torch.randn(5, 24, 3)

    def asymmetry(said: Callable[[Tensor, Tensor, Tensor], Tensor]) -> float:
        turned = mirror.displacement(said(betas, mirror_pose(pose), style))
        return float((turned - said(betas, pose, style)).norm(dim=-1).mean())

    with torch.no_grad():
        assert asymmetry(symmetric(network, mirror)) < 0.1 * asymmetry(network)


def test_a_network_becomes_symmetric_without_samples(first: Path, tmp_path: Path) -> None:
    garment, before = load_garment(GARMENT), load_weights(first / "mlp-none")
    mirror = Mirror.of(garment)
    assert mirror is not None
    how: dict[str, Any] = {"backbone": "mlp", "settings": QUICK, "start": first, "quiet": True}
    card = pretrain(GARMENT, (), tmp_path / "taught", rehearsal=Rehearsal(40, further=60), **how)
    assert card["samples"] == 0
    assert card["datasets"] == []
    assert "figures" not in card
    assert card["rehearsed"] == {"count": 100, "plans": [asdict(PLAN)]}
    one, taught = (
        backbone_from_weights(load_weights(folder / "mlp-none"), garment) for folder in (first, tmp_path / "taught")
    )
    new = Rehearsal(1, further=250).of(before.card, one).take(torch.arange(200, 250))
    with torch.no_grad():
        wanted, got, was = (
            network(new.betas, new.pose, new.style) for network in (symmetric(one, mirror), taught, one)
        )
    assert (got - wanted).norm(dim=-1).mean() < 0.7 * (was - wanted).norm(dim=-1).mean()
    with pytest.raises(RefuError, match="wanted a set"):
        pretrain(GARMENT, (), tmp_path / "nothing", **how)


def test_there_must_be_weights_to_rehearse(further: Path, tmp_path: Path) -> None:
    with pytest.raises(RefuError, match="nothing to go on from or to rehearse"):
        pretrain(GARMENT, further, tmp_path, backbone="mlp", settings=QUICK, rehearsal=Rehearsal(3))


def test_joints_that_it_is_told_of_say_nothing_at_first(first: Path) -> None:
    """Then their samples' range is what it sees of them."""
    network = backbone_from_weights(load_weights(first / "mlp-none"), load_garment(GARMENT))
    pose = 0.3 * torch.randn(30, 24, 3, generator=torch.Generator().manual_seed(0))
    before = network(torch.zeros(30, 10), pose, torch.zeros(30, 4))
    tell_of(network, (16, 3), pose)
    assert isinstance(network, Mlp)
    assert network.config.joints == (0, 1, 2, 4, 5, 16, 3)
    after = network(torch.zeros(30, 10), pose, torch.zeros(30, 4))
    assert before is not None
    assert after is not None
    torch.testing.assert_close(after, before, rtol=0, atol=1e-6)
    told = network.features(pose)[:, -18:]
    at = slice(network.features.size - 18, network.features.size)
    torch.testing.assert_close(network.net.lowest[at], told.amin(0))
    torch.testing.assert_close(network.net.highest[at], told.amax(0))
    seen = network.net.seen(torch.cat((network.features(pose), torch.zeros(30, 14)), 1))[:, at]
    assert float(seen.mean(0).abs().max()) < 1e-5
    assert 0.5 < float(seen.view(30, 2, 9).var(0).mean(1).sqrt().min()) < 1.1


@pytest.mark.parametrize("joints", [(1,), (0,), (24,), (16, 16)])
def test_only_joints_that_it_does_not_know_can_be_told(first: Path, joints: tuple[int, ...]) -> None:
    network = backbone_from_weights(load_weights(first / "mlp-none"), load_garment(GARMENT))
    with pytest.raises(RefuError, match=r"wanted joints that the network isn't told of, each once \(spine1, "):
        tell_of(network, joints, torch.zeros(3, 24, 3))


def test_learns_what_a_joint_does_that_it_was_not_told_of(first: Path, tmp_path: Path) -> None:
    """Shorts that a raised arm lifts."""
    garment = load_garment(GARMENT)

    def by_arm(pose: Tensor) -> Tensor:
        return 0.05 * pose[:, 16, :1, None] * torch.tensor([0.0, 1.0, 0.0]).expand(len(pose), garment.n_vertices, 3)

    write_set(tmp_path / "set", garment, load_body(garment.body), pairs=40, poses=5, spread=0.3, displacement=by_arm)
    how: dict[str, Any] = {"backbone": "mlp", "settings": QUICK, "start": first, "quiet": True}
    told = pretrain(GARMENT, tmp_path / "set", tmp_path / "told", joints=(16,), **how)
    deaf = pretrain(GARMENT, tmp_path / "set", tmp_path / "deaf", **how)
    assert told["figures"]["mpve_mm"] < 0.7 * deaf["figures"]["mpve_mm"]
    stored = load_weights(tmp_path / "told" / "mlp-none")
    assert list(stored.card["config"]["joints"]) == [0, 1, 2, 4, 5, 16]
    backbone_from_weights(stored, garment)
