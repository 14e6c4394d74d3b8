"""`refu train`: from a data set to weights that the pipeline loads."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from small_set import write_set

from refu_core import GarmentPipeline, RefuError, SmplFrame, load_body, load_garment
from refu_core._files import exclusive
from refu_lab.cli import main

pytestmark = pytest.mark.usefixtures("no_curves_in_module")
GARMENT = "short-pant-male"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(
        tmp_path_factory.mktemp("data") / GARMENT, load_garment(GARMENT), load_body("male"), pairs=12, poses=3
    )


@pytest.fixture(scope="module")
def weights(data: Path, no_curves_in_module: None, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: ARG001
    """A backbone and three modes of it, hardly trained."""
    folder = tmp_path_factory.mktemp("weights")
    common = ["train", GARMENT, "--data", str(data), "--output", str(folder / GARMENT), "--quiet"]
    assert main([*common, "--mode", "none", "--steps", "20", "--json", str(folder / "none.json")]) == 0
    for mode in ("hybrid", "approx", "accurate"):
        assert main([*common, "--mode", mode, "--steps", "1", "--json", str(folder / f"{mode}.json")]) == 0
    return folder


def test_what_is_trained_is_loaded(weights: Path) -> None:
    frame = SmplFrame(pose=np.random.default_rng(0).normal(0, 0.1, (24, 3)))
    skinned = GarmentPipeline.load([GARMENT], sdf="none", backbone="skinned")(frame)[GARMENT]
    for mode in ("none", "hybrid", "approx", "accurate"):
        card = json.loads((weights / f"{mode}.json").read_text())
        assert (card["mode"], card["garment"]) == (mode, GARMENT)
        out = GarmentPipeline.load([GARMENT], sdf=mode, backbone="tailornet", weights=weights)(frame)
        assert np.isfinite(out[GARMENT].local).all()
        assert np.abs(out[GARMENT].raw - skinned.local).max() > 1e-5, "the backbone says something"
        assert out.stats.garments[GARMENT].n_unresolved == 0


def test_the_figures_are_printed(weights: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["train", GARMENT, "--data", str(data), "--output", str(weights / "again"), "--mode", "none"]
    assert main([*arguments, "--backbone", "mlp", "--steps", "2", "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "mpve mm" in out
    assert "backbone" in out
    assert all(re.search(rf"{split} samples +\d+\n", out) for split in ("training", "test"))


def test_variants(data: Path, weights: Path) -> None:
    common = ["train", GARMENT, "--data", str(data), "--output", str(weights / GARMENT), "--quiet", "--steps", "1"]
    for k, extra in enumerate((["--scale", "fixed"], ["--scale", "shared"], ["--margin", "0", "--unblended"])):
        folder = weights / f"variant{k}"
        assert main([*common[:5], str(folder), *common[6:], "--mode", "approx", *extra]) == 0
        assert (folder / "tailornet-none.json").exists()  # trained before, in as few steps
    cards = [json.loads((weights / f"variant{k}" / "tailornet-approx.json").read_text())["refu"] for k in range(3)]
    assert cards[0]["scale"] is None
    assert cards[1]["scale"]["kind"] == "shared"
    assert cards[2]["margin"] == 0


def test_weights_that_are_not_there_are_refused(tmp_path: Path) -> None:
    from refu_core import WeightsError

    with pytest.raises(WeightsError, match=r"no such weights.*refu train"):
        GarmentPipeline.load([GARMENT], sdf="hybrid", backbone="tailornet", weights=tmp_path)


def test_two_trainings_do_not_share_a_folder(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["train", GARMENT, "--data", str(data), "--mode", "none", "--steps", "1", "--quiet"]
    with exclusive(tmp_path / "lock", error=RefuError("taken")):
        assert main([*arguments, "--output", str(tmp_path)]) == 2
    assert "another training writes here" in capsys.readouterr().err
    assert not (tmp_path / "tailornet-none.json").exists()


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["kilt"], "no garment 'kilt'"),
        (["tshirt-male"], "wanted a set whose garment is tshirt-male"),
        ([GARMENT, "--mode", "best"], "--mode: invalid choice: 'best' (choose from"),
        ([GARMENT, "--preset", "huge"], "no preset 'huge'"),
        ([GARMENT, "--like", "tshirt-male", "--backbone", "mlp"], "--like makes a tailornet"),
        ([GARMENT, "--like", "kilt", "--steps", "1"], "no garment 'kilt'"),
        ([GARMENT, "--scale", "huge"], "--scale: invalid choice: 'huge'"),
        ([GARMENT, "--network", "gan"], "--network: invalid choice: 'gan'"),
        ([GARMENT, "--backbone", "resnet"], "resnet"),
        ([GARMENT, "--margin", "-1"], "margin"),
        ([GARMENT, "--steps", "0"], "above zero"),
        ([GARMENT, "--device", "quantum"], "quantum"),
        ([GARMENT, "--start", ".", "--margin", "0.01"], "goes on with networks as they are: leave --scale, --margin"),
        ([GARMENT, "--start", ".", "--network", "sdf"], "goes on with networks as they are"),
        ([GARMENT, "--start", ".", "--joints", "spine1,thumb"], "no joint thumb: wanted some of pelvis, left_hip"),
        ([GARMENT, "--joints", "spine1"], "--start"),
    ],
)
def test_bad_options_are_one_line(
    arguments: list[str], wanted: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = ["--output", str(tmp_path), "--quiet"]
    try:
        code = main(["train", *arguments, "--data", str(data), *output])
    except SystemExit as stop:  # argparse's own
        code = int(stop.code or 0)
    assert code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert wanted in error


@pytest.mark.parametrize(("rate", "wanted"), [([], "no frame rate"), (["--fps", "30"], "no such weights")])
def test_motions_are_read_as_they_were_simulated(
    rate: list[str], wanted: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", np.zeros((9, 72)))
    further = ["--start", str(tmp_path), "--rehearse", "5", "--motions", str(tmp_path), *rate]
    assert main(["train", GARMENT, "--data", str(data), "--output", str(tmp_path / "w"), "--quiet", *further]) == 2
    assert wanted in capsys.readouterr().err


def test_a_set_or_weights_to_learn_from_are_wanted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for further in ([], ["--start", str(tmp_path)], ["--network", "dynamics"]):
        assert main(["train", GARMENT, "--output", str(tmp_path / "w"), "--quiet", *further]) == 2
        assert "give --data, a set of refu simulate" in capsys.readouterr().err


def test_the_networks_of_distances_learn_from_one_set(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = ["--data", str(data), str(data), "--output", str(tmp_path), "--network", "sdf", "--quiet"]
    assert main(["train", GARMENT, *both]) == 2
    assert "one set" in capsys.readouterr().err


def test_a_folder_without_a_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", GARMENT, "--data", str(tmp_path), "--quiet"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_distance_network(data: Path, tmp_path: Path) -> None:
    arguments = ["train", GARMENT, "--data", str(data), "--network", "sdf", "--preset", "tiny", "--steps", "1"]
    assert main([*arguments, "--output", str(tmp_path), "--quiet"]) == 0
    assert (tmp_path / "sdf-tiny.safetensors").exists()
