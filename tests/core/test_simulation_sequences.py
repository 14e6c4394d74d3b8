"""Simulated sequences: continuous, the same every time, each frame judged, and sets that survive interruption."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.body import load_body
from refu_core.garments import load_garment
from refu_core.sdf import exact_sdf
from refu_core.simulation import (
    Clip,
    Draper,
    GarmentDataset,
    GarmentSequence,
    GarmentSequences,
    Progress,
    SequencePlan,
    SimulationError,
    load_clips,
    open_dataset,
    simulate_sequences,
    split_clips,
    summarise,
)
from refu_core.simulation._drape import CANONICAL_POSE
from refu_core.simulation._motions import STEPS, n_steps, recorded_motion, synthetic_motion
from refu_core.simulation._plan import TEST
from refu_core.simulation._sequences import SequenceSettings, SequenceSimulator
from refu_core.simulation._store import CAUSES, FPS, SEQUENCES, TO_DO, Rows, dequantise
from refu_core.simulation._worker import Selector
from refu_core.training._data import TakenAlong, read_samples
from refu_lab.cli import main

GARMENT = "short-pant-male"
SECONDS = 0.3
FRAMES = 9


def write_clip(path: Path, phase: float, *, frames: int = 40) -> None:
    """Somebody runs on the spot and turns about."""
    t = np.arange(frames) / 60
    pose = np.tile(CANONICAL_POSE, (frames, 1, 1)).astype(np.float64)
    pose[:, 0, 1] = 0.8 + 0.5 * t
    pose[:, 1, 0] = -0.5 * np.sin(9 * t + phase)
    pose[:, 2, 0] = 0.5 * np.sin(9 * t + phase)
    transl = np.stack((1.5 * t, 0.9 + 0.02 * np.sin(18 * t), 0 * t), 1)
    np.savez(path, poses=pose.reshape(frames, 72), trans=transl, mocap_framerate=np.array(60.0))


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("motions")
    for name, phase in (("a", 0.0), ("b", 1.0)):
        write_clip(folder / f"{name}.npz", phase)
    return folder


def simulate(output: Path, clips: Path, **options: Any) -> dict[str, Any]:
    return simulate_sequences(GARMENT, 2, output, motions=clips, **({"shapes": 1, "seconds": SECONDS} | options))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory, clips: Path) -> Path:
    """A training and a test sequence."""
    output = tmp_path_factory.mktemp("sets") / "sequences"
    simulate(output, clips)
    return output


@pytest.fixture(scope="module")
def sequences(simulated: Path) -> list[GarmentSequence]:
    found = GarmentSequences(simulated)
    return [found.sequence(i) for i in range(len(found))]


def test_sequences_are_what_was_planned(sequences: list[GarmentSequence], simulated: Path) -> None:
    card = json.loads((simulated / "card.json").read_text())
    assert card["fps"] == FPS
    assert card["plan"] == asdict(SequencePlan(GARMENT, 2, shapes=1, seconds=SECONDS))
    assert [(s.number, s.split, s.clip, s.shape) for s in sequences] == [(0, "train", "a", 0), (1, "test", "b", 0)]
    np.testing.assert_array_equal(sequences[0].betas, sequences[1].betas)
    for sequence in sequences:
        assert len(sequence) == FRAMES
        assert sequence.vertices().shape == (FRAMES, load_garment(GARMENT).n_vertices, 3)
        np.testing.assert_array_equal(sequence.vertices(3), sequence.vertices()[3])
        assert sequence.vertices(np.array([1, 4])).dtype == np.float32
        assert not sequence.style.any()
        # Mirrored or not, it faces forward at first, and goes on from where it is.
        facing = Rotation.from_rotvec(sequence.pose[0, 0]).apply([0, 0, 1])
        np.testing.assert_allclose(facing, [0, 0, 1], atol=1e-5)
        np.testing.assert_allclose(sequence.transl[0, [0, 2]], 0, atol=1e-6)
        turn = Rotation.from_rotvec(sequence.pose[-1, 0]).apply([0, 0, 1])[0]
        assert np.sign(turn) == (-1 if sequence.mirrored else 1)
        way = np.linalg.norm(sequence.transl[-1, [0, 2]])
        assert way == pytest.approx(1.5 * (FRAMES - 1) / FPS, rel=0.01)


def test_training_reads_the_good_frames(simulated: Path, tmp_path: Path) -> None:
    copy = tmp_path / "set"
    shutil.copytree(simulated, copy)
    shard = copy / "shard-0-of-1"
    cause = np.load(shard / "cause.npy")
    cause[np.load(shard / "split.npy") != TEST, 2] = 1
    np.save(shard / "cause.npy", cause)
    found = open_dataset(copy)
    assert isinstance(found, GarmentSequences)
    assert isinstance(open_dataset(simulated), GarmentSequences)
    garment = load_garment(GARMENT)
    body = load_body(garment.body)
    samples = read_samples(found, body, garment, split="train")

    (sequence,) = [found.sequence(i) for i in np.flatnonzero(found.train)]
    good = np.flatnonzero(sequence.kept)
    assert 2 not in good
    assert len(samples) == len(good)
    np.testing.assert_array_equal(samples.pose, sequence.pose[good])
    assert (samples.betas == torch.tensor(sequence.betas)).all()
    assert (samples.pair == sequence.number).all()
    whole = TakenAlong(body, garment).added(1, samples.displacement, samples.betas, samples.pose, samples.style)
    unposed = garment.rest(samples.betas, samples.style) + whole
    posed = garment.pose(unposed, body(samples.pose, samples.betas).transforms)
    np.testing.assert_allclose(posed, sequence.vertices(good), atol=1e-5)


def test_frames_in_the_set_are_free_and_others_are_marked(sequences: list[GarmentSequence], simulated: Path) -> None:
    garment, body = load_garment(GARMENT), load_body("male")
    selector, draper = Selector(body.faces, garment.faces), Draper(garment, body)
    for sequence in sequences:
        assert sequence.kept.mean() > 0.5
        assert all((cause is None) == kept for cause, kept in zip(sequence.cause, sequence.kept, strict=True))
        posed = draper.bodies(sequence.pose, sequence.betas)
        for t in range(len(sequence)):
            found = selector.cause(sequence.vertices(t), posed[t])
            if sequence.kept[t]:
                assert found is None
            elif sequence.cause[t] in ("body_collision", "self_intersection"):
                assert found == sequence.cause[t]
    counts = summarise(simulated)["counts"]
    assert counts["frames"] == 2 * FRAMES
    assert counts["frames_kept"] == sum(int(s.kept.sum()) for s in sequences)


def test_cloth_moves_on_and_lags(sequences: list[GarmentSequence]) -> None:
    """No jumps; and moving cloth isn't the skinned one: dynamics are in it."""
    garment, body = load_garment(GARMENT), load_body("male")
    for sequence in sequences:
        vertices = sequence.vertices()
        step = np.linalg.norm(np.diff(vertices, axis=0), axis=2)
        assert np.median(step[-1]) > 0.001
        assert step.max() < 6.0 / FPS  # [m]: the solver's limit of the speed
        shape = torch.from_numpy(sequence.betas)[None]
        posed = body(sequence.pose, shape)
        rest = garment.rest(shape, torch.from_numpy(sequence.style)[None]).expand(FRAMES, -1, -1)
        beyond = vertices - garment.pose(rest, posed.transforms).numpy()
        assert np.linalg.norm(np.diff(beyond, axis=0), axis=2).max() > 0.003


@pytest.mark.parametrize("is_in_body", [False, True])
def test_cloth_that_got_through_is_brought_back(clips: Path, is_in_body: bool) -> None:
    """Left where it is, it would stay there, and no later frame of the sequence could be taken."""
    plan = SequencePlan(GARMENT, 2, shapes=1, seconds=SECONDS)
    simulator = SequenceSimulator(plan, split_clips(load_clips(clips)), SequenceSettings(), None)
    still = np.zeros(10, np.float32), np.zeros(4, np.float32)
    positions, body = simulator.draper.canonical(*still)
    simulator.draper.begin(simulator.draper.cut(*still), positions, body)
    cloth, ring = simulator.draper.cloth, simulator.garment.mesh.ring
    sdf = exact_sdf(simulator.body)
    sdf.update(torch.from_numpy(body))
    near = sdf.query(torch.from_numpy(positions))
    vertex = int(near.distance.argmin())
    if is_in_body:
        cloth.positions[vertex] -= (near.distance[vertex] + 0.006).item() * near.gradient[vertex].numpy()
    else:  # changes places with a neighbour's neighbour
        around = np.split(ring.items, ring.start[1:-1])
        other = next(v for u in around[vertex] for v in around[u] if v != vertex and v not in around[vertex])
        cloth.positions[[vertex, other]] = positions[[other, vertex]]
    before = cloth.positions.copy()
    assert simulator._selector.cause(before, body) == ("body_collision" if is_in_body else "self_intersection")
    found, stored = simulator._freed(body, np.array([0, -9.81, 0], np.float32))
    assert simulator._selector.cause(cloth.positions, body) is None
    moved = np.linalg.norm(cloth.positions - before, axis=1)
    assert np.median(moved) < 0.002 < moved[vertex]
    # What was smoothed by so much that it would be seen isn't taken.
    assert (found is None) == (is_in_body or moved.max() <= simulator.settings.most_smoothing)
    assert simulator._selector.cause(dequantise(stored), body) == found


def test_caught_cloth_is_draped_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "ab":
        write_clip(tmp_path / f"{name}.npz", 0.0, frames=70)
    plan = SequencePlan(GARMENT, 2, shapes=1, seconds=1.0)
    simulator = SequenceSimulator(plan, split_clips(load_clips(tmp_path)), SequenceSettings(), None)
    freed, most, bodies = simulator._freed, simulator.settings.most_caught, []

    def caught_at_first(body: NDArray[np.float32], gravity: NDArray[np.float32]) -> tuple[str | None, Any]:
        found, stored = freed(body, gravity)
        bodies.append(body)
        return ("body_collision" if len(bodies) <= most else found), stored

    monkeypatch.setattr(simulator, "_freed", caught_at_first)
    row = simulator.simulate(0)
    cause = np.array(row["cause"])
    settling = slice(most, most + 16)  # 8/15 s, as far as networks look back
    assert (cause[:most] == 1 + CAUSES.index("body_collision")).all()
    assert (cause[settling] == 1 + CAUSES.index("unsettled")).all()
    assert (cause[settling.stop :] == 0).all()
    # Caught cloth goes on from the drape of its body's pose.
    drape = simulator.draper.drape(row["pose"][most - 1], row["betas"], row["style"])
    after, before = (dequantise(row["vertices"][t]) for t in (most, most - 1))
    assert np.abs(after - drape.vertices).mean() < np.abs(after - before).mean()


def arrays(path: Path) -> dict[str, NDArray[Any]]:
    found = Rows(path, SEQUENCES).arrays
    order = np.argsort(found["slot"])
    return {name: array[order] for name, array in found.items() if name != "seconds"}


def test_interrupted_run_goes_on_to_the_same_bytes(simulated: Path, clips: Path, tmp_path: Path) -> None:
    """A whole set, stopped after a sequence; its other one begun and not finished."""
    output = tmp_path / "again"

    def stop(_: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(output, clips, progress=stop)
    shard = Rows(output, SEQUENCES, mode="r+")
    half_written = int(np.flatnonzero(shard.arrays["state"] == TO_DO)[0])
    shard.arrays["vertices"][half_written, :3] = 12345
    del shard
    assert len(GarmentSequences(output)) == 1
    seen: list[Progress] = []
    card = simulate(output, clips, progress=seen.append)
    assert [p.done for p in seen] == [2]
    assert {key: card["counts"][key] for key in ("train", "test", "to_do")} == {"train": 1, "test": 1, "to_do": 0}
    found, wanted = arrays(output), arrays(simulated)
    for name, column in wanted.items():
        np.testing.assert_array_equal(found[name], column, err_msg=name)
    simulate(output, clips, progress=lambda _: pytest.fail("a finished set has nothing left to simulate"))


def test_command_accepts_the_finished_set(
    simulated: Path, clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = ["--count", "2", "--sequences", "--shapes", "1", "--seconds", str(SECONDS)]
    paths = ["--output", str(simulated), "--motions", str(clips), "--json", str(tmp_path / "card.json")]
    before = arrays(simulated)
    assert main(["simulate", GARMENT, *plan, *paths, "--quiet"]) == 0
    assert "frames kept" in capsys.readouterr().out
    assert json.loads((tmp_path / "card.json").read_text()) == json.loads((simulated / "card.json").read_text())
    for name, column in arrays(simulated).items():
        np.testing.assert_array_equal(column, before[name])


def test_other_kinds_of_set_are_refused(simulated: Path, clips: Path, tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="refu-garments-2"):
        GarmentDataset(simulated)
    with pytest.raises(SimulationError, match="plan"):
        simulate(simulated, clips, seconds=0.2)
    with pytest.raises(SimulationError, match="none of the index"):
        GarmentSequences(simulated).sequence(2)
    with pytest.raises(SimulationError, match="columns"):
        GarmentSequences(simulated).column("pair")
    with pytest.raises(SimulationError, match="card"):
        GarmentSequences(tmp_path)


def test_motions_must_be_there_and_long_enough(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SimulationError, match=r"5 s at least.*0\.7 s"):
        simulate(tmp_path / "set", clips, seconds=5.0)
    options = ["--count", "2", "--output", str(tmp_path / "set"), "--sequences", "--quiet"]
    assert main(["simulate", GARMENT, *options]) == 2
    assert "sequences need recorded motion" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    "numbers", [{"count": 0}, {"shapes": 0}, {"seconds": 0.03}, {"test_share": 1.0}, {"spread": 0.0}]
)
def test_impossible_plans_are_refused(numbers: dict[str, Any]) -> None:
    with pytest.raises(SimulationError, match="got"):
        SequencePlan(**({"garment": GARMENT, "count": 10} | numbers))


@given(st.integers(1, 60), st.integers(1, 20), st.integers(0, 3))
def test_plan_keeps_whole_clips_apart_and_shapes_together(count: int, shapes: int, seed: int) -> None:
    plan = SequencePlan(GARMENT, count, shapes=shapes, seed=seed)
    assert sorted(slot for block in plan.blocks() for slot in block) == list(range(count))
    splits = [plan.split_of(slot) for slot in range(count)]
    assert splits == sorted(splits)
    assert splits[0] != TEST
    assert (TEST in splits) == (count > shapes)
    larger = SequencePlan(GARMENT, count, shapes=shapes + 3, seed=seed)
    for shape in range(min(shapes, 3)):
        np.testing.assert_array_equal(plan.style_shape(shape)[0], larger.style_shape(shape)[0])
        assert np.abs(plan.style_shape(shape)[0]).max() <= 2


def test_stretches_are_those_of_the_clip(clips: Path) -> None:
    train, _ = split_clips(load_clips(clips))
    for seed in range(6):
        motion = recorded_motion(train, FRAMES, np.random.default_rng(seed))
        n = n_steps(FRAMES)
        assert motion.poses.shape == (n, 24, 3)
        first = round(motion.start * FPS * STEPS)
        side = 2 if motion.mirrored else 1
        np.testing.assert_allclose(motion.poses[:, side, 0], train[0].poses[first : first + n, 1, 0], atol=1e-5)


def test_a_synthetic_motion_is_smooth_and_none_is_like_another(clips: Path) -> None:
    train, _ = split_clips(load_clips(clips))
    first, again, other = (synthetic_motion(train, 90, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.poses, again.poses)
    assert np.abs(first.poses - other.poses).max() > 0.1
    for motion in (first, other):
        n = n_steps(90)
        assert motion.poses.shape == (n, 24, 3)
        assert motion.clip == -1
        np.testing.assert_allclose(motion.transl[0, [0, 2]], 0, atol=1e-9)
        forward = Rotation.from_rotvec(motion.poses[0, 0]).apply((0, 0, 1))
        assert forward[2] > abs(forward[0])
        turns = [
            Rotation.from_rotvec(joint[:-1]).inv() * Rotation.from_rotvec(joint[1:])
            for joint in motion.poses.swapaxes(0, 1)
        ]
        rates = np.stack([turn.as_rotvec() for turn in turns], 1) * FPS * STEPS
        assert 1 < np.abs(rates).max() < 30
        # A corner would be a change of several rad/s within one frame.
        assert np.linalg.norm(np.diff(rates, axis=0), axis=-1).max() < 3.5
        assert np.linalg.norm(motion.acceleration(), axis=1).max() < 15


def test_tests_and_half_of_what_is_learnt_are_recorded(clips: Path) -> None:
    split = split_clips(load_clips(clips))
    plan = SequencePlan(GARMENT, 60, shapes=5, seconds=SECONDS, synthetic_share=0.5)
    found = [(plan.split_of(slot), plan.motion(slot, split[plan.split_of(slot)]).clip) for slot in range(60)]
    assert all(clip >= 0 for which, clip in found if which == TEST)
    assert 0.3 < np.mean([clip < 0 for which, clip in found if which != TEST]) < 0.7
    wholly = SequencePlan(GARMENT, 60, shapes=5, seconds=SECONDS)
    for slot in (0, 1, 59):
        assert wholly.motion(slot, split[wholly.split_of(slot)]).clip >= 0


def test_short_motions_are_refused_at_once_whatever_the_first_and_last_show(clips: Path, tmp_path: Path) -> None:
    plan: dict[str, Any] = {"shapes": 1, "seconds": 5.0, "test_share": 0.0, "synthetic_share": 0.5}
    plans = {seed: SequencePlan(GARMENT, 9, seed=seed, **plan) for seed in range(30)}
    seed = next(seed for seed, one in plans.items() if one.is_synthetic(0) and one.is_synthetic(8))
    with pytest.raises(SimulationError, match="the longest has"):
        simulate_sequences(GARMENT, 9, tmp_path / "set", motions=clips, seed=seed, **plan)
    assert not (tmp_path / "set").exists()


def test_acceleration_is_that_of_the_way() -> None:
    t = np.arange(120) / (FPS * STEPS)
    way = np.stack((2.0 * t**2, 0 * t, 0 * t), 1)
    clip = Clip("fall", np.zeros((120, 24, 3), np.float32), way, FPS * STEPS)
    motion = recorded_motion([clip], 60, np.random.default_rng(1))
    inner = motion.acceleration()[10:-10]
    np.testing.assert_allclose(np.abs(inner[:, 0]), 4.0, rtol=1e-3)
    np.testing.assert_allclose(inner[:, 1:], 0, atol=1e-6)
