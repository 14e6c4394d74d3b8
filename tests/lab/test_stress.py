"""`refu stress`: that its checks notice what they are for, that worst cases can be tried again, and the command."""

from __future__ import annotations

import json
import mmap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest

from refu_core import GarmentPipeline, SmplFrame
from refu_core.modes import PAPER_GARMENTS
from refu_core.realtime import GarmentMesh, PipelineOutput
from refu_core.weights import _files
from refu_lab.cli import main
from refu_lab.commands.stress import StressOptions
from refu_lab.stress._guarantees import _above
from refu_lab.stress._rounds import CHECKS, _wardrobes, length
from refu_lab.stress._soak import SoakResult, resident_mb, soak
from refu_lab.stress._trial import (
    Check,
    Measurement,
    StressError,
    Subject,
    Tally,
    Trial,
    Wardrobe,
    load_trial,
    save_trial,
)

SHORTS = Wardrobe(garments=("short-pant-male",))
"""The garment of fewest vertices."""
Spoil = Callable[[GarmentMesh, SmplFrame, int], GarmentMesh]


@dataclass(eq=False)
class Spoiled:
    """A pipeline that does something wrong with every garment."""

    pipeline: GarmentPipeline
    spoil: Spoil
    calls: int = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.pipeline, name)

    def __call__(self, frames: SmplFrame | Sequence[SmplFrame]) -> Any:
        if isinstance(frames, SmplFrame):
            return self._wrong(self.pipeline(frames), frames)
        return [self._wrong(out, frame) for out, frame in zip(self.pipeline(frames), frames, strict=True)]

    def _wrong(self, out: PipelineOutput, frame: SmplFrame) -> PipelineOutput:
        self.calls += 1
        meshes = {name: self.spoil(mesh, frame, self.calls) for name, mesh in out.items()}
        return replace(out, garments=meshes)


def moved(mesh: GarmentMesh, by: Any, rows: Any = slice(None)) -> GarmentMesh:
    local = mesh.local.copy()
    local[rows] += by
    return replace(mesh, local=local)


def not_a_number(mesh: GarmentMesh, _frame: SmplFrame, _call: int) -> GarmentMesh:
    return moved(mesh, np.nan, 7)


def imprecise(mesh: GarmentMesh, _frame: SmplFrame, _call: int) -> GarmentMesh:
    return replace(mesh, before=lambda: mesh.raw.astype(np.float16).astype(np.float32))


def shrunk(mesh: GarmentMesh, _frame: SmplFrame, _call: int) -> GarmentMesh:
    return moved(mesh, 0.3 * (mesh.local.mean(0) - mesh.local))


def thrown(mesh: GarmentMesh, _frame: SmplFrame, _call: int) -> GarmentMesh:
    return moved(mesh, (0, 0, 0.11), 7)


def jumping(mesh: GarmentMesh, _frame: SmplFrame, call: int) -> GarmentMesh:
    return moved(mesh, (0, 0.5 * (call % 2), 0))


def stiff(mesh: GarmentMesh, _frame: SmplFrame, _call: int) -> GarmentMesh:
    return moved(mesh, (1e-3, 0, 0))


def far_off(mesh: GarmentMesh, frame: SmplFrame, _call: int) -> GarmentMesh:
    """As if the translation were added in float32."""
    shift = (mesh.local + frame.transl.astype(np.float32)) - frame.transl
    return replace(mesh, local=shift.astype(np.float32))


def remembering(mesh: GarmentMesh, _frame: SmplFrame, call: int) -> GarmentMesh:
    return moved(mesh, 1e-5 * call)


WRONG: list[tuple[str, Spoil]] = [
    ("numbers: everyday", not_a_number),
    ("numbers: everyday", imprecise),
    ("numbers: denormals", imprecise),
    ("guarantees: nothing inside", shrunk),
    ("guarantees: whatever is inside is counted", shrunk),
    ("guarantees: no vertex thrown out", thrown),
    ("guarantees: no vertex thrown out", not_a_number),
    ("guarantees: displacement bounded in any pose", thrown),
    ("guarantees: no jumps in smooth motion", jumping),
    ("guarantees: no jumps in smooth motion", lambda mesh, _, call: moved(mesh, (0.08 * (call % 2), 0, 0), 7)),
    ("guarantees: no jumps in smooth motion, worn together", jumping),
    ("guarantees: bounded jumps through self-contact", jumping),
    ("invariance: the person turned", stiff),
    ("invariance: the person 100 km away", far_off),
    ("invariance: left and right exchanged", lambda mesh, *_: moved(mesh, (0.03, 0, 0))),
    ("invariance: what came before", remembering),
    (
        "invariance: a batch of 64, predicted",
        lambda mesh, _, call: replace(mesh, before=lambda: mesh.raw + 1e-5 * call),
    ),
    ("invariance: a batch of 64, resolved", remembering),
]


@pytest.fixture(scope="module")
def subject() -> Subject:
    return Subject(SHORTS)


@pytest.fixture
def short_motions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Soaks begin with a whole motion that isn't counted: here it has 24 frames, not 200."""
    monkeypatch.setattr("refu_lab.stress._soak._STEPS", 3)


def trial_of(check: Check, seed: int = 0) -> Trial:
    return check.trial(np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("name", "spoil"), WRONG, ids=[f"{name.split(': ')[1]}-{i}" for i, (name, _) in enumerate(WRONG)]
)
def test_checks_notice(name: str, spoil: Spoil, subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    check = CHECKS[name]
    trial = trial_of(check)
    sound = check.run(subject, trial)
    assert not sound.is_failure, sound
    for one in (subject, subject.on_skin):
        monkeypatch.setattr(one, "pipeline", Spoiled(one.pipeline, spoil))
    assert check.run(subject, trial).is_failure


@pytest.mark.parametrize("kind", [name for name in CHECKS if name.startswith("numbers: distance")])
def test_wrong_distances_are_noticed(kind: str, subject: Subject, monkeypatch: pytest.MonkeyPatch) -> None:
    check, trial = CHECKS[kind], trial_of(CHECKS[kind])
    sound = check.run(subject, trial)
    assert not sound.is_failure, sound
    exact = subject.distances["exact"]
    query = exact.query
    monkeypatch.setattr(
        exact, "query", lambda *a, **k: (s := query(*a, **k))._replace(distance=s.distance * 1.001 + 1e-5)
    )
    assert check.run(subject, trial).is_failure
    monkeypatch.setattr(exact, "query", lambda *a, **k: (s := query(*a, **k))._replace(gradient=s.gradient * 0.5))
    assert "gradient" in check.run(subject, trial).faults[0]


def test_errors_of_other_kinds_are_failures_and_refusals_are_not(subject: Subject) -> None:
    def refuse(_subject: Subject, _trial: Trial) -> Measurement:
        raise StressError("too far")

    def break_down(_subject: Subject, _trial: Trial) -> Measurement:
        raise ZeroDivisionError

    check, trial = CHECKS["numbers: everyday"], trial_of(CHECKS["numbers: everyday"])
    refused, broken = (replace(check, measure=measure).run(subject, trial) for measure in (refuse, break_down))
    assert (refused.refused, refused.is_failure) == (len(trial.frames), False)
    assert broken.is_failure
    assert "ZeroDivisionError" in broken.faults[0]


def test_tallies_keep_the_worst() -> None:
    check = CHECKS["numbers: everyday"]
    trials = [trial_of(check, seed) for seed in range(3)]
    tally = Tally("x", "y")
    for trial, deviation, limit in zip(trials, (1.0, 2.0, 3.0), (2.0, 1.0, 9.0), strict=True):
        tally.add(SHORTS, trial, Measurement(deviation=deviation, limit=limit))
    row = tally.as_dict()
    assert (row["runs"], row["failures"], row["max_deviation_m"]) == (3, 1, 3.0)
    assert (row["deviation_m"], row["limit_m"]) == (2.0, 1.0)
    assert tally.worst_trial is not None
    assert tally.worst_trial[1] is trials[1]


def test_a_saved_trial_is_the_same_trial(tmp_path: Path) -> None:
    check = CHECKS["invariance: what came before"]
    trial = trial_of(check)
    path = save_trial(tmp_path / "worst.npz", check.name, SHORTS, trial)
    name, wardrobe, again = load_trial(path)
    assert (name, wardrobe, again.seed, len(again.frames)) == (check.name, SHORTS, trial.seed, len(trial.frames))
    for one, two in zip(trial.frames, again.frames, strict=True):
        for key in ("pose", "betas", "transl", "past"):
            np.testing.assert_array_equal(getattr(one, key), getattr(two, key))
        assert (one.style is None) == (two.style is None)


@pytest.mark.parametrize(
    ("content", "wanted"), [(None, "No such file"), (b"PK\3\4 no zip", "trial.npz"), ("lacks", "lacks check, garments")]
)
def test_files_that_are_no_trials_are_refused(content: Any, wanted: str, tmp_path: Path) -> None:
    path = tmp_path / "trial.npz"
    if content == "lacks":
        np.savez(path, pose=np.zeros((1, 24, 3)))
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises((StressError, FileNotFoundError), match=wanted):
        load_trial(path)


@pytest.mark.usefixtures("short_motions")
def test_soaks_judge_memory_at_once_and_latency_of_many_frames(subject: Subject) -> None:
    ticked: list[int] = []
    done = soak(subject.pipeline, mode="here", frames=40, persons=2, tick=ticked.append)
    assert (done.frames, done.nan, sum(ticked)) == (40, 0, 40)
    assert [len(tenths) for tenths in done.tenths.values()] == [10] * 4
    assert all(0 < mb < 1e5 for mb in done.tenths["mb"])
    with pytest.raises(StressError, match="10 frames or more of each person, got 9"):
        soak(subject.pipeline, mode="here", frames=18, persons=2)


@pytest.mark.parametrize(
    ("memory", "ours", "yardstick", "frames", "failures"),
    [
        (104, 2.0, 1.0, 39_000, 0),  # latencies of few calls are luck
        (104, 2.0, 1.0, 40_000, 1),
        (104, 2.0, 2.0, 40_000, 0),  # everything takes longer: that's the machine
        (104, 1.04, 0.5, 40_000, 0),
        (106, 1.0, 1.0, 39_000, 1),
        (106, 2.0, 1.5, 40_000, 2),
    ],
)
def test_a_soak_fails_by_memory_or_by_latency(
    memory: float, ours: float, yardstick: float, frames: int, failures: int
) -> None:
    others = (1.0,) * 8
    result = SoakResult(
        mode="x",
        frames=frames,
        persons=2,
        nan=0,
        seconds=1.0,
        tenths={
            "mb": (100, *others, memory),
            "ms": (1.0, *others, ours),
            "wall_ms": (1.0, *others, 9.0),
            "yardstick_ms": (1.0, *others, yardstick),
        },
    )
    assert result.failures == failures


@pytest.mark.usefixtures("short_motions")
def test_an_interrupted_soak_has_its_row(subject: Subject) -> None:
    ticked: list[int] = []

    def tick(count: int) -> None:
        ticked.append(count)
        if len(ticked) == 12:
            raise KeyboardInterrupt

    assert soak(subject.pipeline, mode="here", frames=100, tick=tick).frames == 12
    ticked[:] = [0] * 3
    with pytest.raises(KeyboardInterrupt):  # nine calls have no tenths
        soak(subject.pipeline, mode="here", frames=100, tick=tick)


def test_resident_memory_is_this_process() -> None:
    before = resident_mb()
    held = np.frombuffer(mmap.mmap(-1, 200_000_000), np.uint8)  # and no memory that other tests have left
    held[:] = 1
    assert 190 < resident_mb() - before < 220


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0, "0"), (3.2e-10, "320 pm"), (5e-7, "500 nm"), (0.0123, "12.3 mm"), (4, "4 m"), (np.inf, "-")],
)
def test_lengths_are_readable(metres: float, text: str) -> None:
    assert length(metres) == text


@pytest.mark.usefixtures("short_motions")
def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    worst = tmp_path / "worst"
    common = ["stress", "--garments", "short-pant-male", "--backbone", "skinned", "--quiet"]
    json_file = tmp_path / "stress.json"
    made = ["--rounds", "1", "--frames", "20", "--persons", "2", "--parts", "invariance,soak"]
    assert main([*common, *made, "--json", str(json_file), "--output", str(worst)]) == 0
    printed = capsys.readouterr().out
    assert "nothing failed" in printed
    rows = json.loads(json_file.read_text())["rows"]
    assert {"case", "runs", "failures", "nan", "max_deviation_m"} <= set.intersection(*(set(row) for row in rows))
    wanted = {name for name in CHECKS if name.startswith("invariance")} | {"soak: pipeline"}
    assert {row["case"] for row in rows} == wanted
    (row,) = (row for row in rows if row["case"] == "invariance: the person turned")
    (file,) = worst.glob("invariance-the-person-turned-*.npz")
    assert main([*common, "--replay", str(file), "--json", str(json_file)]) == 0
    (again,) = json.loads(json_file.read_text())["rows"]
    assert again["max_deviation_m"] == pytest.approx(row["worst_share_of_limit"] * row["limit_m"])


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["--parts", "luck"], "no part 'luck': wanted numbers, guarantees, invariance, soak"),
        (["--hours", "0"], "hours must be above zero, got 0"),
        (["--garments", "kilt"], "no garment 'kilt'"),
        (["--backbone", "tailornet", "--weights", "/nowhere"], "no weights of tailornet hybrid"),
        (["--replay", "/nowhere/trial.npz"], "/nowhere/trial.npz"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], wanted: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stress", *arguments]) == 2
    error = capsys.readouterr().err
    assert wanted in error
    assert error.count("\n") == 1


def test_only_pipelines_open_the_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    opened: list[Path] = []
    monkeypatch.setattr(_files, "_read_tensors", lambda path, _: opened.append(path) or {})
    wardrobes, left_out = _wardrobes(StressOptions())
    assert {name for one in wardrobes for name in one.garments} == set(PAPER_GARMENTS)
    assert (opened, left_out) == ([], [])
    with pytest.raises(StressError, match="no such weights"):
        _wardrobes(StressOptions(weights=tmp_path, backbone="tailornet"))


def test_the_closest_points_of_a_sheet() -> None:
    rng = np.random.default_rng(3)
    vertices = rng.normal(size=(60, 3)).astype(np.float32)
    faces = np.stack([rng.choice(60, 3, replace=False) for _ in range(40)])
    points = 2 * rng.normal(size=(50, 3)).astype(np.float32)
    closest, height = _above(points, GarmentMesh(vertices, lambda: vertices, faces, np.zeros(3)))
    squared, face, wanted = igl.point_mesh_squared_distance(points.astype(float), vertices.astype(float), faces)[:3]
    np.testing.assert_allclose(closest, wanted, atol=1e-5)
    a, b, c = vertices[faces[face]].transpose(1, 0, 2)
    up = np.cross(b - a, c - a)
    along = ((points - wanted) * up).sum(1) / np.linalg.norm(up, axis=1)
    is_above_one = np.abs(along) > 0.999 * np.sqrt(squared)  # at an edge it is the height above either face
    np.testing.assert_allclose(height[is_above_one], along[is_above_one], atol=1e-5)
    assert is_above_one.sum() > 5
    assert (np.abs(height) <= np.sqrt(squared) + 1e-5).all()
