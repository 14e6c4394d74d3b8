"""Many garments at once: what a GPU does, on a CPU, where the same kernels run."""

from __future__ import annotations

import multiprocessing
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from refu_core.body import load_body
from refu_core.errors import RefuError
from refu_core.garments import load_garment
from refu_core.simulation import (
    ClothSettings,
    Draper,
    DrapeSettings,
    LaneEngine,
    Progress,
    SelectionSettings,
    SimulationError,
    SimulationSettings,
    simulate_dataset,
    simulate_sequences,
)
from refu_core.simulation._drape import Course, follow
from refu_core.simulation._lanes import ClothLanes
from refu_core.simulation._store import CAUSES, DONE, FORMAT, GIVEN_UP, Rows, dequantise
from refu_lab.cli import main
from tests.core.test_simulation import write_clip

GARMENT = "short-pant-male"
CPU = torch.device("cpu")
QUICK = DrapeSettings(dress_frames=4, lower_frames=8, canonical_frames=12, move_frames=(6, 10), settle_frames=(8, 12))


@pytest.fixture(scope="module")
def draper() -> Draper:
    return Draper(load_garment(GARMENT), load_body("male"), settings=QUICK)


@pytest.fixture(scope="module")
def course(draper: Draper) -> Course:
    return draper.canonical_course(np.zeros(10))


def lanes_of(draper: Draper, n: int, **settings: Any) -> ClothLanes:
    body = draper.body
    return ClothLanes(
        draper.topology,
        body.rest_vertices(torch.zeros(1, 10))[0].numpy(),
        body.faces.numpy(),
        anchored=draper.waist.astype(np.int32),
        lanes=n,
        most_bodies=9,
        device=CPU,
        settings=ClothSettings(**settings),
    )


def test_a_lane_goes_the_way_of_a_single_cloth(draper: Draper, course: Course) -> None:
    """Careful frames too, which look at midpoints of edges; and what another lane does changes nothing."""
    betas, style = np.zeros(10), np.array([1.0, 0, 0, 0])
    cut, start = draper.cut(betas, style), draper.dressed(betas, style, course)
    lanes = lanes_of(draper, 3)
    lanes.load(1, cut, start, course.bodies)
    lanes.load(2, draper.cut(betas, -style), draper.dressed(betas, -style, course), course.bodies)
    draper.begin(cut, start, course.bodies[0])
    steps = list(islice(course.steps(), 12))
    steps.append(type(steps[0])(8, 8, steps[0].gravity, 30.0, is_careful=True))
    apart = []
    for step in steps:
        before, after = course.bodies[step.before], course.bodies[step.after]
        speed = draper.cloth.frame(
            before, after if step.after != step.before else before, gravity=step.gravity, drag=step.drag,
            careful=step.is_careful,
        )  # fmt: skip
        speeds = lanes.frame([None, step, step])
        assert speeds[1] == pytest.approx(speed, rel=0.02)
        assert speeds[2] != pytest.approx(speed, rel=1e-4)
        assert speeds[0] == 0
        apart.append(1e3 * np.linalg.norm(lanes.positions(1) - draper.cloth.positions, axis=1))
    assert apart[0].max() < 0.02  # rounding, before folds make more of it
    assert np.mean(apart[-1]) < 0.5  # while the fastest vertices have gone a long way
    assert np.linalg.norm(draper.cloth.positions - start, axis=1).max() > 0.05


def test_a_lane_that_is_loaded_again_is_as_new(draper: Draper, course: Course) -> None:
    betas, style = np.zeros(10), np.zeros(4)
    cut, start, steps = draper.cut(betas, style), draper.dressed(betas, style, course), list(islice(course.steps(), 6))
    lanes = lanes_of(draper, 1)
    ends = []
    for _ in range(2):
        lanes.load(0, cut, start, course.bodies)
        for step in steps:
            lanes.frame([step])
        ends.append(lanes.positions(0))
    np.testing.assert_array_equal(*ends)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, rng = tmp_path_factory.mktemp("motions"), np.random.default_rng(0)
    for name in ("walk", "wave"):
        write_clip(folder / f"{name}.npz", rng)
    return folder


def rows_of(folder: Path) -> dict[str, Any]:
    return Rows(folder, FORMAT).arrays


def test_an_engine_of_lanes_makes_the_set_of_a_single_process(clips: Path, tmp_path: Path) -> None:
    """And goes on where it was when a helping process was killed."""
    lenient = SimulationSettings(drape=QUICK, selection=SelectionSettings(stretch=2, speed=10))

    def make(name: str, **options: Any) -> dict[str, Any]:
        given = {"motions": clips, "test_share": 0.5, "recorded_share": 1.0, "settings": lenient}
        return simulate_dataset(GARMENT, 2, tmp_path / name, **given, **options)

    make("single")

    def kill(progress: Progress) -> None:
        assert progress.done == 1
        for child in multiprocessing.active_children():
            child.kill()

    engine = LaneEngine("cpu", lanes=1, jobs=1)
    with pytest.raises(SimulationError, match="a helping process was killed"):
        make("lanes", engine=engine, progress=kill)
    assert (rows_of(tmp_path / "lanes")["state"] == DONE).sum() == 1
    card = make("lanes", engine=engine)
    assert card["counts"] == {"train": 1, "test": 1, "given_up": 0, "to_do": 0}
    one, many = rows_of(tmp_path / "single"), rows_of(tmp_path / "lanes")
    for name in ("slot", "pair", "split", "pose", "betas", "style", "clip", "frame", "dropped"):
        np.testing.assert_array_equal(many[name], one[name])
    apart = np.linalg.norm(dequantise(many["vertices"]) - dequantise(one["vertices"]), axis=2)
    assert apart.mean() < 4e-3  # [m]: turned by 1°, a pose's cloth is as far from its own
    np.testing.assert_allclose(many["stretch"], one["stretch"], atol=0.05)
    assert (many["seconds"] > 0).all()


def test_slots_are_tried_again_and_given_up(clips: Path, tmp_path: Path) -> None:
    strict = SimulationSettings(drape=QUICK, selection=SelectionSettings(stretch=0.5), attempts=2)
    engine = LaneEngine("cpu", lanes=2, jobs=1)
    simulate_dataset(GARMENT, 1, tmp_path, motions=clips, test_share=0.0, settings=strict, engine=engine)
    rows = rows_of(tmp_path)
    assert rows["state"].tolist() == [GIVEN_UP]
    assert rows["dropped"][0, CAUSES.index("stretch")] == 2


def test_what_lanes_cannot_do_is_said(draper: Draper, clips: Path, tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match=r"one sweep in a time step, .*got 2"):
        lanes_of(draper, 1, iterations=2)
    with pytest.raises(SimulationError, match="got 1, and a search every 12 of 40 steps"):
        lanes_of(draper, 1, refresh=12)
    with pytest.raises(SimulationError, match="a GPU simulates garments at rest, got SequenceSimulator"):
        simulate_sequences(
            GARMENT, 1, tmp_path / "a", motions=clips, engine=LaneEngine("cpu", jobs=1), shapes=1, seconds=0.1
        )
    with pytest.raises(RefuError, match="no device 'tpu'"):
        LaneEngine("tpu")


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("--device tpu", "no device 'tpu': wanted cpu or cuda"),
        ("--device cuda --sequences", "a GPU simulates poses at rest alone"),
        ("--device cuda --scheduler tcp://there:1", "a GPU is this machine's"),
    ],
)
def test_the_command_says_which_devices_there_are(
    words: str, wanted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["simulate", GARMENT, "--count", "1", "--output", str(tmp_path), *words.split()]
    assert main(given) != 0
    assert wanted in capsys.readouterr().err


def test_a_course_ends_when_cloth_rests(course: Course) -> None:
    steps, seen = course.steps(), []
    step = next(steps, None)
    while step is not None:
        seen.append((step.before, step.after))
        try:
            step = steps.send(0.0)
        except StopIteration:
            step = None
    assert seen == [(0, 0)] * QUICK.dress_frames + [(k, k + 1) for k in range(8)] + [(8, 8)] * 10


def test_follow_goes_the_whole_course(draper: Draper, course: Course) -> None:
    betas, style = np.zeros(10), np.zeros(4)
    draper.begin(draper.cut(betas, style), draper.dressed(betas, style, course), course.bodies[0])
    assert 0 < follow(draper.cloth, course) < 0.1
