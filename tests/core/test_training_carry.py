"""Networks of few samples: what is carried over from a related garment, and what the samples add."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from small_set import write_set
from torch import Tensor

from refu_core import GarmentPipeline, RefuError, SmplFrame, load_body, load_garment
from refu_core.backbones import load_backbone
from refu_core.errors import WeightsError
from refu_core.garments import BUILTIN_GARMENTS
from refu_core.modes import SdfMode
from refu_core.simulation import open_dataset
from refu_core.training import CarrySettings, carry_over, displacements, posed_errors, read_samples
from refu_core.training._carry import Carried
from refu_core.weights import load_card, weights_folder

GARMENT, LIKE = "tshirt-neutral", "tshirt-male"
SMALL = CarrySettings(rank=40, hidden=(16,), poses=40, steps=40)
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
    )


@pytest.fixture(scope="module")
def made(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    carry_over(GARMENT, data, folder / GARMENT, like=LIKE, settings=SMALL, quiet=True)
    return folder


def test_on_its_own_garment_nothing_changes() -> None:
    garment = load_garment(LIKE)
    carried = Carried(garment, garment, CarrySettings())
    pose = torch.as_tensor(np.random.default_rng(0).normal(0, 0.2, (3, 24, 3)), dtype=torch.float32)
    betas = torch.zeros(3, 10)
    truth = load_backbone("tailornet", garment)(betas, pose, None).displacement
    assert truth is not None
    assert torch.allclose(carried(betas, pose), truth, atol=1e-6)


def test_trousers_do_not_hear_of_shorts_below_their_hem() -> None:
    garment = load_garment("trousers-male")
    moved = Carried(load_garment("short-pant-male"), garment, CarrySettings())(
        torch.zeros(1, 10), torch.as_tensor(ARMS_DOWN[None], dtype=torch.float32)
    )[0].norm(dim=1)
    assert (moved[garment.v_template[:, 1] < -0.75] == 0).all()
    assert float(moved.max()) > 0.005


def test_what_the_samples_say_is_learnt(data: Path, made: Path) -> None:
    """The least squares of its own code, on poses that it wasn't shown: nearer to them than what was carried over."""
    garment, body = load_garment(GARMENT), load_body("neutral")
    test = read_samples(open_dataset(data), body, garment, split="test")

    def error(predicted: Tensor) -> float:
        return float(posed_errors(predicted, test, body, garment).mean())

    learnt = error(displacements(load_backbone("tailornet", garment, folder=made / GARMENT, mode="none"), test))
    before = error(Carried(load_garment(LIKE), garment, SMALL)(test.betas, test.pose))
    assert learnt < 0.8 * before
    assert load_card(made / GARMENT / "tailornet-none")["simulated"] == 24


def test_every_mode_loads(made: Path) -> None:
    for mode in SdfMode:
        out = GarmentPipeline.load([GARMENT], sdf=mode, backbone="tailornet", weights=made)(SmplFrame(pose=ARMS_DOWN))
        assert np.isfinite(out[GARMENT].local).all()
        assert out.stats.garments[GARMENT].n_unresolved == 0 or mode is SdfMode.NONE


def test_bad_asks_are_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no such weights"):
        carry_over(GARMENT, data, tmp_path, like="dress-female", settings=SMALL)
    with pytest.raises(RefuError, match="above zero"):
        CarrySettings(rank=0)


@pytest.mark.parametrize("name", CARRIED)
def test_what_ships_is_nearer_to_the_simulation_than_skinning_and_says_what_it_is_made_of(name: str) -> None:
    card = load_card(weights_folder(name) / "tailornet-hybrid")
    assert card["like"] in SHIPPED
    assert card["figures"]["mpve_mm"] < 0.7 * card["figures"]["skinned_mm"]
    pipelines = [GarmentPipeline.load([name], backbone=backbone) for backbone in ("auto", "skinned")]
    assert pipelines[0].untrained == ()
    worn, skinned = (pipeline(SmplFrame(pose=ARMS_DOWN))[name].local for pipeline in pipelines)
    assert 2e-3 < np.linalg.norm(worn - skinned, axis=1).mean() < 0.03
