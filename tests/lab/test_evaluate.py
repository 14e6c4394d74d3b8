"""`refu evaluate`: tables of a data set from files alone, the figures that are kept, and what it refuses."""

from __future__ import annotations

import json
import pickle
import runpy
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from refu_core import GarmentPipeline, PipelineOutput, RefuError, SmplFrame, load_body, load_garment
from refu_lab.cli import main
from refu_lab.reproduction import OutfitJudge, _motion, _plots, _runs
from refu_lab.reproduction._methods import Library
from refu_lab.reproduction._runs import SampleSet, Study, run_methods
from refu_lab.truth import moments_of

BAGS = Path(__file__).parents[2] / "bags"
GARMENT = "short-pant-male"
QUANTUM = 2.0**-14


def run(*arguments: object) -> int:
    return main([str(argument) for argument in ("evaluate", *arguments, "--quiet")])


def frames(n: int = 4) -> list[SmplFrame]:
    made = []
    for k in range(n):
        pose = np.zeros((24, 3), np.float32)
        pose[1, 0], pose[2, 0], pose[2, 2] = -0.2 + 0.05 * k, 0.1 * k, 0.12
        betas = np.full(10, 0.2 * k, np.float32)
        made.append(SmplFrame(pose, betas, style=np.zeros(4, np.float32), stamp_ns=10**18 + k * 10**9))
    return made


def truth_of(frame: SmplFrame) -> np.ndarray[Any, Any]:
    """Where the skinned template is, 3 mm up."""
    garment, body = load_garment(GARMENT), load_body("male")
    betas = torch.tensor(frame.betas)[None]
    posed = body(torch.tensor(frame.pose)[None], betas)
    vertices: np.ndarray[Any, Any] = garment.pose(garment.rest(betas), posed.transforms)[0].numpy()
    return vertices + np.array([0, 0.003, 0], np.float32)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set as docs/guide/data.md describes its files, written without the code that reads it: one in two is a test."""
    path = tmp_path_factory.mktemp("set")
    shard = path / "shard-0-of-1"
    shard.mkdir()
    made = frames()
    n = len(made)
    columns: dict[str, Any] = {
        "slot": np.arange(n, dtype=np.int32),
        "state": np.ones(n, np.uint8),
        "vertices": np.round(np.stack([truth_of(f) for f in made]) / QUANTUM).astype(np.int16),
        "pose": np.stack([f.pose for f in made]),
        "betas": np.stack([f.betas for f in made]),
        "style": np.zeros((n, 4), np.float32),
        "pair": np.arange(n, dtype=np.int32),
        "clip": np.full(n, -1, np.int32),
        "frame": np.full(n, -1, np.int32),
        "split": (np.arange(n) % 2).astype(np.uint8),
        "dropped": np.zeros((n, 4), np.uint8),
        **{name: np.ones(n, np.float32) for name in ("stretch", "speed", "seconds")},
    }
    for name, values in columns.items():
        np.save(shard / f"{name}.npy", values)
    np.save(path / "unseen.npy", np.where(np.arange(n) % 2, 1.5, np.nan).astype(np.float32))
    body = load_body("male")
    card = {
        "format": "refu-garments-2",
        "garment": GARMENT,
        "body": "male",
        "body_fingerprint": body.fingerprint,
        "quantum_m": QUANTUM,
        "plan": {"count": n},
        "clips": {"train": [], "test": []},
    }
    (path / "card.json").write_text(json.dumps(card), encoding="utf-8")
    return path


@pytest.mark.usefixtures("little_light")
def test_tables_of_a_data_set(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_plots, "_SHOT", (60, 80))
    out, file = tmp_path / "results", tmp_path / "rows.json"
    assert run("--data", dataset, "--table", "comparison", "--output", out, "--json", file) == 0
    printed = capsys.readouterr().out
    assert "skinned template" in printed
    data = json.loads(file.read_text(encoding="utf-8"))
    rows = {(r["garment"], r["method"], r["metric"]): r for r in data["rows"]}
    assert {tuple(row) for row in data["rows"]} == {("table", "garment", "method", "metric", "value", "paper")}
    # The truth is the template, 3 mm off, rounded to the file's unit.
    assert rows[GARMENT, "skinned", "mpve_mm"]["value"] == pytest.approx(3, abs=0.05)
    assert rows[GARMENT, "node-skinned", "vfcp_percent"]["value"] == 0
    assert rows[GARMENT, "refu-hybrid", "cfmp_percent"]["paper"] == 76.89
    page = (out / "comparison.md").read_text(encoding="utf-8")
    assert f"over these numbers of test samples: {GARMENT} 2." in page
    assert {path.name for path in out.iterdir()} >= {"comparison.md", "comparison.json", "README.md", f"{GARMENT}.png"}


class Elsewhere:
    """An engine as one of other machines: all is sent, and the last task is done first."""

    def run(self, make: Any, tasks: Any) -> Any:
        function = pickle.loads(pickle.dumps(make))()
        for index in reversed(range(len(tasks))):
            yield index, pickle.loads(pickle.dumps(function(pickle.loads(pickle.dumps(tasks[index])))))


def test_figures_are_the_same_whoever_runs_the_samples(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_runs, "_BLOCK", 1)
    samples, found = SampleSet.open(dataset), []
    assert len(samples) == 2
    for engine in (None, Elsewhere()):
        study = Study()
        run_methods(study, samples, ["skinned-naive", "node-skinned"], library=Library(), engine=engine)
        found.append(
            {
                name: [(asdict(one.figures), one.unseen, sorted(one.ms), one.scales.tolist()) for one in run.samples]
                for name, run in study.runs.items()
            }
        )
    assert found[0] == found[1]
    assert all(len(samples) == 2 for samples in found[0].values())


def test_motion_of_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_motion, "OUTFITS", _motion.OUTFITS[::2])  # all are in test_reproduction.py
    poses = np.zeros((5, 72))
    poses[:, 3] = np.linspace(0, 0.3, 5)
    np.savez(tmp_path / "swing.npz", poses=poses, trans=np.zeros((5, 3)), betas=np.zeros(10), mocap_framerate=30.0)
    file = tmp_path / "rows.json"
    arguments = ("--motions", tmp_path, "--table", "motion", "--motion-every", 2, "--output", tmp_path / "out")
    assert run(*arguments, "--json", file) == 0
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    assert {f"{GARMENT}, swing", "skirt-female, all clips"} <= {row["garment"] for row in rows}
    metrics = {row["metric"] for row in rows}
    assert {"skin_cfmp_percent", "jump_20_percent", "leap_20_percent", "shift_max_mm"} <= metrics
    assert "skin to collider" in (tmp_path / "out" / "motion.md").read_text(encoding="utf-8")


def test_cloth_that_hangs_still_beside_a_swinging_leg_jumps_and_does_not_leap() -> None:
    skinned = GarmentPipeline.load([GARMENT], backbone="skinned", sdf="none", collider=False)
    pose = np.zeros((2, 24, 3))
    pose[1, 0, 1] = 0.1  # the garment turns with the root
    still, turned = (SmplFrame(pose=one) for one in pose)
    standing = skinned([still, still])
    as_skinned = OutfitJudge([GARMENT], {"as skinned": skinned})
    hanging = OutfitJudge([GARMENT], {"hanging": cast("GarmentPipeline", Hanging(skinned, standing))})
    found = [next(iter(one.judge([still, turned])[0].values())) for one in (as_skinned, hanging)]
    assert found[0].jump_mm == found[0].leap_mm == 0
    assert found[1].jump_mm > 10
    assert found[1].leap_mm <= 0


class Hanging:
    """A pipeline whose garments stay where they are."""

    def __init__(self, like: GarmentPipeline, outputs: list[PipelineOutput]) -> None:
        self.body, self._outputs = like.body, outputs

    def __call__(self, _frames: object) -> list[PipelineOutput]:
        return self._outputs


# ---- the figures that are kept ---------------------------------------------------------------------------------------

SCRIPT = runpy.run_path(str(BAGS.parent / "scripts" / "check_figures.py"))


@pytest.mark.parametrize("bag", SCRIPT["bags"](), ids=lambda bag: bag.name)
def test_no_figure_of_a_shipped_bag_has_fallen(bag: Path) -> None:
    known = {key: value for key, value in SCRIPT["read"]().items() if key[0] == bag.name}
    assert {key[2] for key in known} >= {"auto", "node, auto, hybrid", "node, skinned, accurate"}
    assert SCRIPT["fallen"](SCRIPT["figures_of"](bag), known) == []


def test_a_figure_has_fallen_when_it_is_worse_by_more_than_its_tolerance_or_gone() -> None:
    def lines(value: float, reference: float, metric: str) -> list[str]:
        key = ("bag", GARMENT, "skinned", metric)
        found: list[str] = SCRIPT["fallen"]({key: value}, {key: reference})
        return found

    assert lines(86.1, 93.0, "cfmp_percent") == []
    assert lines(85.9, 93.0, "cfmp_percent") != []
    assert lines(93.0, 50.0, "cfmp_percent") == []
    assert lines(9.2, 9.0, "mpve_mm") == []
    assert lines(9.4, 9.0, "mpve_mm") != []
    assert SCRIPT["fallen"]({}, {("bag", GARMENT, "gone", "mpve_mm"): 9.0}) != []


# ---- what it refuses -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the table all needs --data DIR"),
        (["--table", "motion"], "needs --motions DIR"),
        (["--table", "sdf", "--motions", "."], "needs --data DIR"),
        (["--data", "nowhere"], "nowhere"),
        (["--table", "beauty"], "invalid choice"),
        (["--data", "x", "--motion-every", "0"], "above zero"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = run(*arguments)
    except SystemExit as stop:
        code = int(stop.code or 0)
    assert code == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1


def test_a_bag_with_ground_truth_is_a_set_of_samples() -> None:
    bag = BAGS / "eval_short_pant_male"
    samples = SampleSet.open(bag)
    moments = moments_of(bag, load_garment(GARMENT))
    assert (samples.garment, samples.count, samples.shapes) == (GARMENT, len(moments), None)
    for number in (0, samples.count - 1):
        sample, (frame, truth, _) = samples.read(number), moments[number]
        np.testing.assert_array_equal(sample.pose, frame.pose)
        np.testing.assert_array_equal(sample.betas, frame.betas)
        np.testing.assert_array_equal(sample.style, frame.style)
        np.testing.assert_allclose(sample.vertices, truth, atol=1e-6)


@pytest.mark.parametrize(("bag", "got"), [("walk", "none"), ("eval_tshirt_male_over_short_pant_male", GARMENT + ", ")])
def test_a_bag_without_truth_or_with_that_of_several_garments_is_refused(bag: str, got: str) -> None:
    wanted = f"{bag}: wanted the ground truth of one garment, got {got}.*refu simulate makes it"
    with pytest.raises(RefuError, match=wanted):
        SampleSet.open(BAGS / bag)


def test_a_page_of_somebody_else_stays(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "README.md").write_text("# My robot\n")
    assert run("--data", dataset, "--table", "postures", "--output", tmp_path) == 2
    assert "is there already, and no page of refu evaluate" in capsys.readouterr().err
    assert (tmp_path / "README.md").read_text() == "# My robot\n"


def test_sets_of_one_garment_are_evaluated_as_one(dataset: Path) -> None:
    alone, bag = SampleSet.open(dataset), SampleSet.open(BAGS / "eval_skirt_female")
    (both, other) = SampleSet.joined([alone, bag, alone])
    assert (both.garment, len(both), len(other)) == (alone.garment, 2 * len(alone), len(bag))
    for row in range(len(both)):
        np.testing.assert_array_equal(both.read(row).vertices, alone.read(row % len(alone)).vertices)


def test_a_table_without_samples_of_its_kind_is_refused(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--data", dataset, "--table", "sequence", "--output", tmp_path / "out") == 2
    assert "needs a data set of sequences" in capsys.readouterr().err
