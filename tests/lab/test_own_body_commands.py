"""A body of one's own by the commands: replay, info, and the way from simulation to weights that are worn."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from smpl_file import write_smpl

from refu_core import GarmentPipeline, SmplFrame, load_body
from refu_core.body import Registration
from refu_core.modes import FOREIGN_BETAS
from refu_core.simulation import DrapeSettings, GarmentDataset, SelectionSettings, SimulationSettings, simulate_dataset
from refu_lab.cli import main
from refu_lab.commands.replay import ReplayOptions
from refu_lab.replay import replay
from refu_lab.sources import body_warnings, open_source

BAGS = Path(__file__).parents[2] / "bags"
GARMENT = "short-pant-male"
HURRIED = SimulationSettings(
    drape=DrapeSettings(
        dress_frames=3, lower_frames=4, canonical_frames=10, move_frames=(8, 8), settle_frames=(6, 8), careful_frames=4
    ),
    selection=SelectionSettings(stretch=3.0, speed=10.0),
    attempts=12,
)
"""What is checked exactly still is: collisions."""


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_smpl(tmp_path_factory.mktemp("bodies"), "male")


def write_motion(path: Path, **more: object) -> Path:
    poses = np.zeros((3, 72))
    poses[:, 3 * 16 + 2], poses[:, 3 * 17 + 2] = -1.1, 1.1
    np.savez(path, poses=poses, trans=np.zeros((3, 3)), mocap_framerate=30.0, **more)  # type: ignore[arg-type]
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What a command prints."""
    assert main(list(map(str, arguments))) == 0
    return capsys.readouterr().out


@pytest.mark.usefixtures("no_curves")
def test_from_simulation_to_weights_that_are_worn(
    body: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, weights = tmp_path / "data", tmp_path / "weights"
    for name in "ab":
        write_motion(tmp_path / f"{name}.npz")
    simulate_dataset(GARMENT, 3, data, motions=tmp_path, body=body, test_share=1 / 3, settings=HURRIED)
    assert GarmentDataset(data).train.sum() == 2
    common = ["train", GARMENT, "--data", data, "--body", body, "--output", weights / GARMENT, "--quiet"]
    run(capsys, *common, "--mode", "none", "--steps", "3")
    run(capsys, *common, "--mode", "hybrid", "--steps", "1")
    worn = ["replay", BAGS / "walk", "--max-frames", "3", "--garments", GARMENT, "--weights", weights, "--quiet"]
    run(capsys, *worn, "--body", body, "--json", tmp_path / "own.json")
    result = json.loads((tmp_path / "own.json").read_text())
    assert result["garments"][GARMENT]["vfcp_percent"] < 1, "of networks that have seen three steps"
    assert result["body"]["fingerprint"] == load_body(body).fingerprint
    assert main(list(map(str, worn))) == 2  # on the body that it was cut for
    assert "trained on the body" in capsys.readouterr().err
    own = GarmentPipeline.load([GARMENT], body=body, weights=weights)
    assert own.outfit.wearables[GARMENT].betas is None, "its networks know this body's betas"
    assert GarmentPipeline.load([GARMENT], body=body).outfit.wearables[GARMENT].betas is not None


def test_replay_on_an_own_body(body: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No retraining, and nothing cuts the collider."""
    common = ["replay", BAGS / "reach_squat", "--max-frames", "8", "--quiet", "--garments", "tshirt-male"]
    out = run(capsys, *common, "--betas-from", body, "--json", tmp_path / "result.json")
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["garments"]["tshirt-male"]["cfmp_percent"] == 100
    assert result["body"]["fit_mean_mm"] < 1
    assert "warning" not in out


def bare(body: str | None = None) -> GarmentPipeline:
    """Garments that follow the skin, loaded in no time."""
    return GarmentPipeline.load([GARMENT], body=body, backbone="skinned", sdf="none", collider=False)


def warnings_of(path: Path, pipeline: GarmentPipeline, **options: Any) -> list[str]:
    """What a replay warns of."""
    asked = ReplayOptions(input=path, garments=(GARMENT,), backbone="skinned", **options)
    return replay(asked, source=open_source(asked, pipeline)).warnings


def test_betas_of_unknown_meaning_are_warned_of_once(tmp_path: Path) -> None:
    path = write_motion(tmp_path / "amass.npz", betas=np.full(16, 0.5))
    plain = bare()
    assert warnings_of(path, plain) == [FOREIGN_BETAS]
    assert not warnings_of(path, plain, betas_source="builtin")
    assert not warnings_of(path, plain, betas=(0.0,) * 10, betas_source="fixed")
    assert not warnings_of(path, bare("male"))
    assert not warnings_of(write_motion(tmp_path / "mean.npz", betas=np.zeros(16)), plain)
    assert not warnings_of(BAGS / "reach_squat", plain, max_frames=1, output=tmp_path / "out.mcap")  # it says whose
    assert not warnings_of(tmp_path / "out.mcap", plain, max_frames=1)  # and so does what is made of it


def test_a_recording_of_another_gender_is_warned_of(tmp_path: Path, body: Path) -> None:
    def doubts(path: Path, pipeline: GarmentPipeline) -> list[str]:
        return [text for text in warnings_of(path, pipeline) if "is dressed as" in text]

    path = write_motion(tmp_path / "her.npz", gender="female")
    (warning,) = doubts(path, bare())
    assert "of a female body and is dressed as male" in warning
    assert not doubts(path, bare("female"))
    him = write_motion(tmp_path / "him.npz", gender="male")
    assert not doubts(him, bare())
    own = bare(str(body))
    (warning,) = doubts(path, own)
    assert "of a female body and is dressed as SMPL_MALE" in warning
    assert not doubts(him, own)


def test_a_poor_fit_is_warned_of(body: Path) -> None:
    pipeline = bare(str(body))
    assert not body_warnings(pipeline, gender="male")
    found = pipeline.fit.registration
    pipeline.outfit.fit.__dict__["registration"] = Registration(found.vertices, found.place, 0.004, 0.02)
    (warning,) = body_warnings(pipeline)
    assert "4.0 mm on average, 20.0 mm at the 99th percentile, wanted 3 mm at most" in warning


def test_info_says_how_garments_will_fit(body: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = run(capsys, "info", "--body", body)
    assert "watertight  yes" in out
    assert "mm on average" in out
    with np.load(body) as arrays:
        known = dict(arrays)
    np.savez(tmp_path / "holes.npz", **{**known, "f": known["f"][50:]})
    out = run(capsys, "info", "--body", tmp_path / "holes.npz")
    assert "watertight  no\n" in out
    assert "can be worn  no" in out
    assert out.count("open edges") == 1
    small = {key: 0.5 * known[key] for key in ("v_template", "shapedirs", "posedirs")}
    np.savez(tmp_path / "child.npz", **{**known, **small})
    out = run(capsys, "info", "--body", tmp_path / "child.npz")
    assert "built-in mesh on it  0.2 mm on average" in out
    assert "warnings" not in out


def test_out_body_and_garments_are_at_one_place_with_transl(body: Path) -> None:
    pipeline = bare(str(body))
    out = pipeline(SmplFrame(np.zeros((24, 3)), transl=[3.0, 1.0, -2.0]))
    np.testing.assert_array_equal(out[GARMENT].vertices, out[GARMENT].local + out.transl)
    gap = (out.body + out.transl).mean(0) - out[GARMENT].vertices.mean(0)
    assert np.linalg.norm(gap) < 0.8
