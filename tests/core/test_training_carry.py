"""Networks of few samples: what is carried over from a related garment, and what the samples add."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_set import write_set
from torch import Tensor

from refu_core import GarmentPipeline, RefuError, SmplFrame, load_body, load_garment
from refu_core.backbones import (
    BasisDecoder,
    Controls,
    PoseFeatures,
    WithBeyond,
    load_backbone,
    load_basis,
    style_shape,
)
from refu_core.errors import WeightsError
from refu_core.frames import LAGS, N_PAST
from refu_core.garments import BUILTIN_GARMENTS, save_garment
from refu_core.modes import SdfMode
from refu_core.simulation import SamplePlan, open_dataset
from refu_core.training import BeyondSettings, CarrySettings, LoopSettings, Rehearsal, carry_over, train_beyond
from refu_core.training._carry import Carried, _Remainder, borne_out, own_codes
from refu_core.training._data import displacements, posed_errors, read_samples
from refu_core.weights import load_card, load_weights, weights_folder

pytestmark = pytest.mark.usefixtures("no_curves_in_module")
GARMENT, LIKE = "tshirt-neutral", "tshirt-male"
SMALL = CarrySettings(rank=40, controls=60, hidden=(16,), poses=40, steps=40)
ARMS_DOWN = np.zeros((24, 3))
ARMS_DOWN[16, 2], ARMS_DOWN[17, 2] = -1.2, 1.2
SHIPPED = [name for name in BUILTIN_GARMENTS if (weights_folder(name) / "tailornet-hybrid.json").exists()]
CARRIED = [name for name in SHIPPED if "like" in load_card(weights_folder(name) / "tailornet-hybrid")]


def swelling(pose: Tensor) -> Tensor:
    """A displacement that is a linear function of the pose's matrices near the T-pose, (N, V, 3) [m]."""
    up = load_garment(GARMENT).v_template[:, 1:2] / 10
    return torch.sin(pose[:, 16, 2])[:, None, None] * up * torch.tensor((0.0, 1.0, 1.0))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(
        tmp_path_factory.mktemp("carried") / GARMENT,
        load_garment(GARMENT),
        load_body("neutral"),
        pairs=8,
        poses=4,
        test_pairs=2,
        displacement=swelling,
        plan=asdict(SamplePlan(GARMENT, 32, pivots=4, recorded_share=0.0)),
    )


@pytest.fixture(scope="module")
def made(data: Path, no_curves_in_module: None, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: ARG001
    folder = tmp_path_factory.mktemp("weights")
    carry_over(GARMENT, data, folder / GARMENT, like=LIKE, settings=SMALL, quiet=True)
    return folder


def carried(like: str, name: str) -> Carried:
    garment = load_garment(name)
    return Carried(load_garment(like), garment, load_body(garment.body), CarrySettings())


def test_on_its_own_garment_nothing_changes() -> None:
    garment = load_garment(LIKE)
    pose = torch.as_tensor(np.random.default_rng(0).normal(0, 0.2, (3, 24, 3)), dtype=torch.float32)
    betas = torch.zeros(3, 10)
    truth = load_backbone("tailornet", garment, mode="hybrid")(betas, pose, None)
    assert truth is not None
    assert torch.allclose(carried(LIKE, LIKE)(betas, pose), truth, atol=1e-5)


def test_cloth_goes_where_the_related_garment_is_though_it_hangs_on_other_joints() -> None:
    """A hem with half the weight on the thighs and one with a third, in the lap of somebody who sits."""
    pose = torch.zeros(1, 24, 3)
    pose[0, 1, 0] = pose[0, 2, 0] = -1.4
    garment, body, betas = load_garment(LIKE), load_body("male"), torch.zeros(1, 10)
    stiff = torch.zeros_like(garment.weights)
    stiff[:, 0] = 1
    other = replace(garment, weights=(garment.weights + stiff) / 2)
    transforms = body(pose, betas).transforms
    moved = carried(LIKE, LIKE)(betas, pose)
    there = garment.pose(garment.rest(betas) + moved, transforms)
    found = Carried(garment, other, body, CarrySettings())(betas, pose)
    assert torch.allclose(other.pose(other.rest(betas) + found, transforms), there, atol=1e-4)
    assert float((found - moved).norm(dim=-1).max()) > 0.02  # added as it is, it would be elsewhere


def test_trousers_do_not_hear_of_shorts_below_their_hem() -> None:
    garment = load_garment("trousers-male")
    moved = carried("short-pant-male", garment.name)(
        torch.zeros(1, 10), torch.as_tensor(ARMS_DOWN[None], dtype=torch.float32)
    )[0].norm(dim=1)
    assert float(moved[garment.v_template[:, 1] < -0.75].max()) < 1e-5
    assert float(moved.max()) > 0.005


def test_only_what_the_samples_bear_out_is_carried_over() -> None:
    """On one half of the cloth the truth varies as what is carried over, on the other the opposite way."""
    garment = load_garment(LIKE)
    left = garment.v_template[:, 0] > 0
    there = torch.randn(12, 1, 3, generator=torch.Generator().manual_seed(0)).expand(-1, garment.n_vertices, -1)
    truth = torch.where(left[:, None], there, -there) + 5
    share = borne_out(there, truth, Controls.spread(garment, 60))
    assert float(share[garment.v_template[:, 0] > 0.15].min()) > 0.85
    assert float(share[garment.v_template[:, 0] < -0.15].max()) < 0.05


def test_what_the_samples_say_is_learnt(data: Path, made: Path) -> None:
    """On poses that the net wasn't shown it is nearer to the simulation than what was carried over."""
    garment, body = load_garment(GARMENT), load_body("neutral")
    test = read_samples(open_dataset(data), body, garment, split="test")

    def error(predicted: Tensor) -> float:
        return float(posed_errors(predicted, test, body, garment).mean())

    learnt = error(displacements(load_backbone("tailornet", garment, folder=made / GARMENT, mode="none"), test))
    before = error(carried(LIKE, GARMENT)(test.betas, test.pose))
    assert learnt < 0.8 * before
    assert load_card(made / GARMENT / "tailornet-none")["simulated"] == 24


def test_between_samples_is_what_a_gaussian_process_says(data: Path) -> None:
    """Against the formula, number by number: at a sample what it says, far from all of them their mean."""
    garment = load_garment(GARMENT)
    samples = read_samples(open_dataset(data), load_body("neutral"), garment, split="train")
    features, settings = PoseFeatures(garment.card.joints, "matrix"), CarrySettings()
    left = torch.randn(len(samples), 2, generator=torch.Generator().manual_seed(0))
    found = _Remainder(features, samples, left, settings)

    def inputs(betas: Tensor, pose: Tensor) -> np.ndarray:
        return np.concatenate((features(pose).numpy(), settings.shape_scale * betas.numpy()), 1).astype(np.float64)

    def kernel(a: np.ndarray, b: np.ndarray) -> float:
        distance = np.sqrt(3) * np.sqrt(((a - b) ** 2).sum()) / settings.length
        return (1 + distance) * np.exp(-distance)

    known, asked = inputs(samples.betas, samples.pose), (samples.betas[:5] + 0.5, samples.pose[:5] * 0.7)
    gram = np.array([[kernel(a, b) for b in known] for a in known]) + settings.ridge * np.eye(len(known))
    mean = left.numpy().mean(0)
    weights = np.linalg.inv(gram) @ (left.numpy() - mean)
    wanted = np.array([[kernel(a, b) for b in known] for a in inputs(*asked)]) @ weights + mean
    np.testing.assert_allclose(found(*asked).numpy(), wanted, atol=1e-5)
    there = _Remainder(features, samples, left, replace(settings, ridge=1e-9))(samples.betas, samples.pose)
    np.testing.assert_allclose(there.numpy(), left.numpy(), atol=1e-3)
    np.testing.assert_allclose(found(samples.betas + 1e4, samples.pose).numpy(), [mean] * len(samples), atol=1e-6)


def test_every_mode_loads(made: Path) -> None:
    for mode in SdfMode:
        out = GarmentPipeline.load([GARMENT], sdf=mode, backbone="tailornet", weights=made)(SmplFrame(pose=ARMS_DOWN))
        assert np.isfinite(out[GARMENT].local).all()
        assert out.stats.garments[GARMENT].n_unresolved == 0 or mode is SdfMode.NONE


def test_a_network_beside_it_is_stored_at_the_same_controls(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / GARMENT, tmp_path / "weights")
    body = load_body("neutral")
    lying = write_set(
        tmp_path / "lying", load_garment(GARMENT), body, pairs=8, spread=0.8, turn=1.3, displacement=swelling
    )
    settings = BeyondSettings(LoopSettings(batch_size=8), steps=2, rank=4)
    train_beyond("lying", GARMENT, lying, tmp_path / "weights", rehearsal=Rehearsal(8), settings=settings, quiet=True)
    both = load_backbone("tailornet", GARMENT, mode="hybrid", folder=tmp_path / "weights")
    assert isinstance(both, WithBeyond)
    decoder = both.beyond[0].decoder
    assert isinstance(decoder, BasisDecoder)
    assert decoder.controls is not None
    stored = load_weights(tmp_path / "weights" / "lying").tensors
    assert torch.equal(stored["basis.controls"], load_weights(made / GARMENT / "basis").tensors["controls"])
    assert not decoder.mean.any()
    assert stored["basis.components"].shape == (4, 3 * SMALL.controls)


def test_codes_are_turned_into_those_of_the_displacement_carried_over() -> None:
    garment, share = load_garment(GARMENT), torch.rand(load_garment(GARMENT).n_vertices, 1)
    over, related = carried(LIKE, GARMENT), load_basis(weights_folder(LIKE), load_garment(LIKE), expect={})[0]
    own, _ = load_basis(weights_folder(GARMENT), garment, expect={})
    code = torch.randn(3, related.size, generator=torch.Generator().manual_seed(0))
    wanted = own.encode(own.mean.view(-1, 3) + share * over.mixed(related(code) - related.mean.view(-1, 3)))
    assert torch.allclose(code @ own_codes(over, share, LIKE, own).T, wanted, atol=1e-4)


def test_what_motion_does_is_carried_over_too(made: Path) -> None:
    related, own = (load_backbone("dynamic", LIKE), load_backbone("dynamic", GARMENT, folder=made / GARMENT))
    draw = torch.Generator().manual_seed(0)
    betas, pose, past = (torch.randn(4, *shape, generator=draw) for shape in ((10,), (24, 3), (len(LAGS), N_PAST)))
    there, here = (one(betas, pose, None, past=past) - one(betas, pose, None) for one in (related, own))
    codes = load_weights(made / GARMENT / "dynamics").tensors["codes"]
    basis, _ = load_basis(weights_folder(LIKE), load_garment(LIKE), expect={})
    wanted = there.flatten(1) @ basis.components.T @ codes.T @ own.decoder.components  # type: ignore[attr-defined]
    assert torch.allclose(here.flatten(1), wanted, atol=2e-5)
    assert float(there.norm()) > 0.1


def test_where_joints_are_that_a_network_is_not_told_of_the_mean_stands_for() -> None:
    """A dress's network doesn't know where the knees are; a skirt's dynamics do."""
    worn = (load_backbone("dynamic", name) for name in ("skirt-female", "dress-female"))
    related, own = (getattr(one, "known", one) for one in worn)
    draw = torch.Generator().manual_seed(0)
    betas, pose, past = (torch.randn(4, *shape, generator=draw) for shape in ((10,), (24, 3), (len(LAGS), N_PAST)))
    x, s = related.still.features(pose), style_shape(betas, None)
    knees = related.still.features.columns_of((4, 5))[3:]
    x[:, knees] = related.dynamics.net.shift[torch.isin(related.dynamics._now, knees).nonzero()[:, 0]]
    wanted = related.dynamics(x, s, past) @ load_weights(weights_folder("dress-female") / "dynamics").tensors["codes"].T
    assert torch.allclose(own.dynamics(own.still.features(pose), s, past), wanted, atol=1e-4)


@pytest.mark.parametrize(
    "change", [{"like": "../tshirt-male"}, {"like": 3}, {"like": "tshirt-female"}, {"like_sha256": "0"}]
)
def test_dynamics_of_another_garment_than_they_were_carried_over_from_are_refused(
    change: dict[str, object], made: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(made / GARMENT, tmp_path / GARMENT)
    load_backbone("dynamic", GARMENT, folder=folder)
    card = json.loads((folder / "dynamics.json").read_text())
    (folder / "dynamics.json").write_text(json.dumps(card | change))
    with pytest.raises(WeightsError, match=r"dynamics\.\w+: |no such weights"):
        load_backbone("dynamic", GARMENT, folder=folder)


def test_bad_asks_are_refused(data: Path, tmp_path: Path) -> None:
    without = save_garment(load_garment(GARMENT), tmp_path / "without.npz")
    with pytest.raises(WeightsError, match="no such weights"):
        carry_over(GARMENT, data, tmp_path, like=str(without), settings=SMALL)
    with pytest.raises(RefuError, match="above zero"):
        CarrySettings(rank=0)


@pytest.mark.parametrize("name", CARRIED)
def test_what_ships_is_nearer_to_the_simulation_than_skinning_and_says_what_it_is_made_of(name: str) -> None:
    card = load_card(weights_folder(name) / "tailornet-hybrid")
    assert card["like"] in SHIPPED
    assert card["figures"]["mpve_mm"] < 0.7 * card["figures"]["skinned_mm"]
    pose = torch.as_tensor(ARMS_DOWN[None], dtype=torch.float32)
    moved = load_backbone("auto", name, mode="hybrid")(torch.zeros(1, 10), pose, None)
    assert moved is not None
    assert 2e-3 < float(moved.norm(dim=-1).mean()) < 1.2e-3 * card["figures"]["skinned_mm"]


def test_every_garment_that_ships_has_networks() -> None:
    assert list(BUILTIN_GARMENTS) == SHIPPED
