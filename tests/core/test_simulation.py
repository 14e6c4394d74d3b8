"""Simulated garments: the same every time, free of collisions by three judges, and sets that survive interruption."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import cache, partial
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from loaded import load_script
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

import refu_core
from refu_core._engine import Engine
from refu_core.body import Collider, SmplBody, load_body
from refu_core.errors import BodyError, MeshError
from refu_core.garments import load_garment
from refu_core.mesh import Connectivity
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.simulation import (
    POSTURES,
    Draper,
    GarmentDataset,
    GarmentSample,
    Progress,
    SamplePlan,
    SimulationError,
    SimulationSettings,
    _produce,
    colliders,
    load_clips,
    posture,
    simulate_dataset,
    split_clips,
    summarise,
)
from refu_core.simulation._cloth import ClothTopology
from refu_core.simulation._drape import CANONICAL_POSE, COMFORT_POSES
from refu_core.simulation._plan import TEST, TRAIN
from refu_core.simulation._store import CAUSES, DONE, FORMAT, QUANTUM, TO_DO, Rows, dequantise, locked, quantise
from refu_core.simulation._worker import Selector
from refu_lab.cli import main
from refu_lab.contact_sheet import contact_sheet
from refu_lab.fleet import open_engine
from tests.lab import fleet_tasks

GARMENT = "short-pant-male"
COUNT = 4  # one of a pivot, two that share a canonical drape, and one to test on
TEST_SHARE = 1 / 4


def write_clip(path: Path, rng: np.random.Generator, **replaced: Any) -> None:
    poses = rng.normal(0, 0.15, (5, 72))
    poses[:, :3] = 0
    arrays = {"poses": poses, "trans": np.zeros((5, 3)), "mocap_framerate": np.array(30.0)} | replaced
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("motions")
    rng = np.random.default_rng(0)
    for name in ("walk", "wave"):
        write_clip(folder / f"{name}.npz", rng)
    return folder


def simulate(output: Path, clips: Path, **options: Any) -> dict[str, Any]:
    return simulate_dataset(GARMENT, COUNT, output, motions=clips, **({"test_share": TEST_SHARE} | options))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory, clips: Path) -> Path:
    """A set made by one process."""
    output = tmp_path_factory.mktemp("sets") / "whole"
    simulate(output, clips)
    return output


@pytest.fixture(scope="module")
def dataset(simulated: Path) -> GarmentDataset:
    return GarmentDataset(simulated)


@pytest.fixture(scope="module")
def samples(dataset: GarmentDataset) -> list[GarmentSample]:
    return [dataset.sample(i) for i in range(len(dataset))]


@cache
def body_and_collider() -> tuple[SmplBody, Collider]:
    body = load_body("male")
    return body, Collider(body)


def body_of(sample: GarmentSample) -> NDArray[np.float64]:
    """The collider of the sample's pose, as the pipeline dresses it."""
    body, collider = body_and_collider()
    return colliders(body, collider, sample.pose[None], sample.betas)[0].astype(np.float64)


def fcl_pairs(first: NDArray[Any], first_faces: NDArray[Any], second: NDArray[Any], second_faces: NDArray[Any]) -> Any:
    def model(vertices: NDArray[Any], faces: NDArray[Any]) -> fcl.CollisionObject:
        bvh = fcl.BVHModel()
        bvh.beginModel(len(vertices), len(faces))
        bvh.addSubModel(vertices.astype(np.float64), faces.astype(np.int64))
        bvh.endModel()
        return fcl.CollisionObject(bvh, fcl.Transform())

    request = fcl.CollisionRequest(num_max_contacts=1_000_000, enable_contact=True)
    result = fcl.CollisionResult()
    fcl.collide(model(first, first_faces), model(second, second_faces), request, result)
    return np.array([(contact.b1, contact.b2) for contact in result.contacts], np.int64).reshape(-1, 2)


# What is simulated ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def verifier() -> Any:
    """The script that judges whole sets."""
    return load_script("scripts/verify_dataset.py")


def test_nothing_collides_by_three_judges(verifier: Any, simulated: Path, samples: list[GarmentSample]) -> None:
    """The script's two, fcl and libigl, and the project's own."""
    report = verifier.summary(list(verifier.verdicts(simulated)))
    assert (report["garments"], report["bad"]) == (COUNT, [])
    assert 0 < report["smallest_clearance_mm"] < 4
    garment, checker = load_garment(GARMENT), CollisionChecker(load_body("male").faces)
    for sample in samples:
        checker.update(body_of(sample).astype(np.float32))
        assert checker.check(sample.vertices, garment.faces).is_free


def test_a_hanging_arm_stays_where_it_is() -> None:
    """The skin of arm and flank runs through itself; the sleeve between them is simulated, and is free of both."""
    garment, (body, collider) = load_garment("tshirt-male"), body_and_collider()
    pose = CANONICAL_POSE.copy()
    pose[16, 2], pose[17, 2] = -1.35, 1.35
    zeros = np.zeros(10, np.float32)
    drape = Draper(garment, body).drape(pose, zeros, zeros[:4])
    skin = body(pose[None]).vertices[0].numpy()
    checker = CollisionChecker(body.faces)
    checker.update(colliders(body, collider, pose[None], zeros)[0])
    assert checker.check(drape.vertices, garment.faces).is_free
    checker.update(skin)
    assert checker.check(drape.vertices, garment.faces).n_inside > 20


def test_a_closed_mesh_has_no_waistband() -> None:
    skirt, body = load_garment("skirt-female"), load_body("female")
    closed = replace(skirt, faces=body.faces, weights=body.weights, v_template=body.v_template)
    with pytest.raises(MeshError, match="skirt-female is held at the waist, and its mesh is closed"):
        Draper(closed, body)


def test_vertices_of_no_face_are_refused() -> None:
    with pytest.raises(MeshError, match="1 of a garment's vertices belong to no face: leave them out"):
        ClothTopology.of(Connectivity.of([[0, 1, 2]], 4))


def test_cloth_stretches_little(samples: list[GarmentSample]) -> None:
    """Measured anew: an edge against the longest that it is in the cut and in the poses that the cut has room for."""
    garment, body = load_garment(GARMENT), load_body("male")
    faces = garment.faces.numpy()
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)

    def length(vertices: torch.Tensor | NDArray[Any]) -> NDArray[Any]:
        points = np.asarray(vertices)
        return np.linalg.norm(points[..., edges[:, 0], :] - points[..., edges[:, 1], :], axis=-1)

    for sample in samples:
        shape = torch.from_numpy(sample.betas)[None]
        rest = garment.rest(shape, torch.from_numpy(sample.style)[None])
        comfort = COMFORT_POSES
        transforms = body(comfort, shape).transforms
        eased = length(garment.pose(rest.expand(len(comfort), -1, -1), transforms)).max(0)
        cut = length(rest[0])
        stretch = length(sample.vertices) / np.clip(eased, cut, 1.15 * cut)
        assert np.percentile(stretch, 99.9) <= 1.15
        assert np.percentile(stretch, 50) > 0.9  # nor is it crumpled up


def test_sample_depends_on_nothing_but_its_parameters(samples: list[GarmentSample]) -> None:
    """Draped after another pose, and by another draper: the bytes of the stored one, which came another way."""
    sample = samples[-1]
    draper = Draper(load_garment(GARMENT), load_body("male"))
    other = CANONICAL_POSE.copy()
    other[1, 0] = -0.6
    before = draper.drape(other, sample.betas, sample.style)
    drape = draper.drape(sample.pose, sample.betas, sample.style)
    assert np.abs(before.vertices - drape.vertices).max() > 0.02
    np.testing.assert_array_equal(dequantise(quantise(drape.vertices)), sample.vertices)


def test_selector_names_the_cause(samples: list[GarmentSample]) -> None:
    garment, body = load_garment(GARMENT), load_body("male")
    selector = Selector(body.faces, garment.faces)
    sample = samples[0]
    posed = body_of(sample).astype(np.float32)

    def cause(vertices: NDArray[Any], *, speed: float = 0.0, stretch: float = 1.0) -> str | None:
        vertices = vertices.astype(np.float32)
        return selector.cause(vertices, posed, stretch=stretch, speed=speed)

    assert cause(sample.vertices) is None
    assert cause(sample.vertices + np.array((0.02, 0, 0))) == "body_collision"
    assert cause(sample.vertices, stretch=1.2) == "stretch"
    assert cause(sample.vertices, speed=0.2) == "unsettled"
    through = sample.vertices.copy()
    through[np.argmax(through[:, 0])] = through[np.argmin(through[:, 0])] - [0.05, 0, 0]
    assert cause(through + np.array((5, 0, 0))) == "self_intersection"
    assert {"body_collision", "stretch", "unsettled", "self_intersection"} == set(CAUSES)


def test_verifier_finds_every_fault(verifier: Any, simulated: Path, tmp_path: Path) -> None:
    path = shutil.copytree(simulated, tmp_path / "spoilt")
    vertices = Rows(path, FORMAT, mode="r+").arrays["vertices"]
    vertices[0, :, 0] += round(0.02 / QUANTUM)
    vertices[1] = np.rint(vertices[1] * 1.3)
    faces = load_garment(GARMENT).faces.numpy()
    one, other = faces[0], faces[len(faces) // 2]
    vertices[2, one] = vertices[2, other][[1, 2, 0]]
    vertices[2, one[0]] += np.array((40, 90, 70), np.int16)
    vertices[2, one[1]] -= np.array((80, 40, 90), np.int16)
    vertices.flush()
    report = verifier.summary(list(verifier.verdicts(path)))
    assert len(report["bad"]) == 3
    assert report["with_body_pairs"] >= 1
    assert report["with_vertices_inside"] >= 1
    assert report["stretched"] >= 1
    assert report["with_self_intersections"] >= 1


def test_self_intersection_is_that_of_fcl(samples: list[GarmentSample]) -> None:
    faces = load_garment(GARMENT).faces.numpy()
    rng = np.random.default_rng(0)
    rough = samples[0].vertices + rng.normal(0, 0.006, samples[0].vertices.shape).astype(np.float32)
    pairs = fcl_pairs(rough, faces, rough, faces)
    apart = ~(faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None]).any((1, 2))
    wanted = {(min(pair), max(pair)) for pair in pairs[apart].tolist()}
    checker = SheetChecker(faces)
    checker.update(rough)
    found = checker.with_itself()
    mine = ~(faces[found[:, 0]][:, :, None] == faces[found[:, 1]][:, None]).any((1, 2))
    assert len(wanted) > 20
    assert {(min(pair), max(pair)) for pair in found[mine].tolist()} == wanted


# Sets -----------------------------------------------------------------------------------------------------------------


def columns(path: Path) -> dict[str, NDArray[Any]]:
    """All rows by slot; without the seconds, which no two runs share."""
    arrays = Rows(path, FORMAT).arrays
    order = np.argsort(arrays["slot"])
    return {name: array[order] for name, array in arrays.items() if name != "seconds"}


def test_a_set_has_all_slots(simulated: Path) -> None:
    np.testing.assert_array_equal(columns(simulated)["slot"], np.arange(COUNT))
    assert (columns(simulated)["state"] == DONE).all()


def test_interrupted_run_goes_on_to_the_same_samples(simulated: Path, clips: Path, tmp_path: Path) -> None:
    output = tmp_path / "interrupted"

    def stop(state: Progress) -> None:
        if state.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(output, clips, progress=stop)
    shard = Rows(output, FORMAT, mode="r+")
    survivors = np.asarray(shard.arrays["state"] == DONE)
    assert survivors.sum() == 2
    half_written = int(np.flatnonzero(shard.arrays["state"] == TO_DO)[0])
    shard.arrays["vertices"][half_written] = 12345
    del shard

    seen: list[Progress] = []
    card = simulate(output, clips, progress=seen.append)
    assert seen[-1].done == seen[-1].total == COUNT
    assert len(seen) <= COUNT - survivors.sum()
    assert {key: card["counts"][key] for key in ("train", "test", "given_up", "to_do")} == {
        "train": COUNT - 1,
        "test": 1,
        "given_up": 0,
        "to_do": 0,
    }
    resumed, wanted = columns(output), columns(simulated)
    for name, array in wanted.items():
        np.testing.assert_array_equal(resumed[name], array, err_msg=name)

    before = {path.name: path.read_bytes() for path in (output / "shard-0-of-1").glob("*.npy")}
    simulate(output, clips, progress=lambda _: pytest.fail("a finished set has nothing left to simulate"))
    assert {path.name: path.read_bytes() for path in (output / "shard-0-of-1").glob("*.npy")} == before


class Deadly:
    """An engine whose workers die."""

    def __init__(self, engine: Engine, mark: Path) -> None:
        self._engine, self._mark = engine, mark

    def run(self, make: Callable[[], Any], tasks: Any) -> Any:
        return self._engine.run(partial(fleet_tasks.dying, make, self._mark), tasks)


@pytest.fixture
def warm_workers() -> Iterator[None]:
    """Dask's workers are forks of a process that has imported what they do, which takes each of them seconds.

    Those of lab/test_fleet.py begin as a user's do.
    """
    dask = pytest.importorskip("dask")
    pytest.importorskip("distributed")
    multiprocessing.get_context("forkserver").set_forkserver_preload(["distributed.nanny", "refu_core.simulation"])
    forkserver.ensure_running()  # Dask has a list of its own for one that doesn't run yet
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        yield


@pytest.mark.usefixtures("warm_workers")
def test_workers_that_are_killed_make_the_same_samples(simulated: Path, clips: Path, tmp_path: Path) -> None:
    with open_engine(2) as engine:
        card = simulate(tmp_path / "set", clips, engine=Deadly(engine, tmp_path / "killed"))
    assert (tmp_path / "killed").exists()
    assert card["counts"]["to_do"] == 0
    made = columns(tmp_path / "set")
    for name, array in columns(simulated).items():
        np.testing.assert_array_equal(made[name], array, err_msg=name)


def test_card_counts_what_is_there(simulated: Path, samples: list[GarmentSample]) -> None:
    card = summarise(simulated)
    stored = columns(simulated)
    assert card["counts"]["train"] + card["counts"]["test"] == len(samples) == COUNT
    assert card["yield"]["simulated"] == COUNT + stored["dropped"].sum()
    assert card["figures"]["stretch_p999_largest"] == pytest.approx(stored["stretch"].max())
    assert card["clips"] == {"train": ["walk"], "test": ["wave"]}
    plan = SamplePlan(GARMENT, COUNT, test_share=TEST_SHARE, postures=list(POSTURES))
    assert card["plan"] == asdict(plan)


def test_dataset_reads_what_was_written(
    dataset: GarmentDataset, samples: list[GarmentSample], simulated: Path, clips: Path
) -> None:
    stored = columns(simulated)
    plan, both = SamplePlan(GARMENT, COUNT, test_share=TEST_SHARE), split_clips(load_clips(clips))
    assert len(dataset) == COUNT
    np.testing.assert_array_equal(dataset.test, ~dataset.train)
    np.testing.assert_array_equal(dataset.column("pose"), stored["pose"])
    for slot, sample in enumerate(samples):
        assert sample.slot == slot
        assert sample.pair == plan.pair_of(slot)
        assert sample.split == ("test" if plan.split_of(slot) == TEST else "train")
        assert dataset.test[slot] == (sample.split == "test")
        betas, style = plan.style_shape(sample.pair)
        np.testing.assert_array_equal(sample.betas, betas)
        np.testing.assert_array_equal(sample.style, style)
        np.testing.assert_array_equal(sample.vertices, stored["vertices"][slot] * np.float32(QUANTUM))
        assert sample.vertices.dtype == np.float32
        pose, clip, frame = plan.pose(slot, int(stored["dropped"][slot].sum()), both[sample.split == "test"])
        np.testing.assert_array_equal(sample.pose, pose)  # no limb is held back
        assert (clip, frame) == (stored["clip"][slot], stored["frame"][slot])
        assert sample.clip in ({"test": "wave", "train": "walk"}[sample.split], None)
        assert (sample.frame is None) == (sample.clip is None)
    with pytest.raises(ValueError, match="read-only"):
        dataset._columns["pose"][0] = 0


def test_unseen_distance_is_to_the_nearest_training_sample(samples: list[GarmentSample]) -> None:
    def parameters(sample: GarmentSample) -> NDArray[np.float32]:
        return np.concatenate((sample.pose.ravel(), sample.betas, sample.style))

    train = [parameters(sample) for sample in samples if sample.split == "train"]
    for sample in samples:
        if sample.split == "train":
            assert np.isnan(sample.unseen)
        else:
            nearest = min(float(np.linalg.norm(parameters(sample) - other)) for other in train)
            assert sample.unseen == pytest.approx(nearest, rel=1e-5)


def test_only_finished_samples_are_read(simulated: Path, samples: list[GarmentSample], tmp_path: Path) -> None:
    path = shutil.copytree(simulated, tmp_path / "partial")
    (path / "unseen.npy").unlink()
    shard = Rows(path, FORMAT, mode="r+")
    missing = int(shard.arrays["slot"][0])
    shard.arrays["state"][0] = TO_DO
    shard.arrays["state"].flush()
    partial = GarmentDataset(path)
    assert [partial.sample(i).slot for i in range(len(partial))] == [s.slot for s in samples if s.slot != missing]
    assert np.isnan(partial.sample(-1).unseen)
    with pytest.raises(SimulationError, match="none of the index"):
        partial.sample(len(partial))
    with pytest.raises(SimulationError, match="columns"):
        partial.column("colour")


def test_damaged_sets_are_refused(simulated: Path, tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="card"):
        GarmentDataset(tmp_path)
    shutil.copy(simulated / "card.json", tmp_path)
    with pytest.raises(SimulationError, match="no shard"):
        GarmentDataset(tmp_path)
    for damage in ("missing", "shape", "unseen", "betas", "unit"):
        path = shutil.copytree(simulated, tmp_path / damage)
        if damage == "missing":
            (path / "shard-0-of-1" / "betas.npy").unlink()
        elif damage in ("shape", "betas"):
            values = np.zeros((COUNT, 9), np.float32) if damage == "shape" else np.full((COUNT, 10), np.nan, np.float32)
            np.save(path / "shard-0-of-1" / "betas.npy", values)
        elif damage == "unit":
            card = json.loads((path / "card.json").read_text())
            (path / "card.json").write_text(json.dumps(card | {"quantum_m": 1.0}))
        else:
            (path / "unseen.npy").write_bytes(b"not an array")
        with pytest.raises(SimulationError, match=r"betas|unseen|wanted positions in units of 6.1"):
            GarmentDataset(path)
    (tmp_path / "card.json").write_text('{"format": "other"}')
    with pytest.raises(SimulationError, match="format"):
        GarmentDataset(tmp_path)


@pytest.mark.usefixtures("little_light")
def test_contact_sheet_shows_each_sample_twice(dataset: GarmentDataset) -> None:
    sheet = contact_sheet(dataset, count=2)
    assert sheet.dtype == np.uint8
    views = np.split(sheet, 4, axis=1)
    assert all(view.std() > 10 for view in views)
    assert len({view.tobytes() for view in views}) == 4
    with pytest.raises(SimulationError, match="body"):
        contact_sheet(dataset, body="female")


# The plan and the files -----------------------------------------------------------------------------------------------

plans = st.builds(
    SamplePlan,
    st.just(GARMENT),
    st.integers(1, 400),
    seed=st.integers(0, 5),
    test_share=st.floats(0, 0.9),
    pivots=st.integers(1, 30),
    poses_per_pair=st.integers(1, 9),
    block=st.integers(1, 15),
)


@given(plans)
def test_blocks_cover_each_slot_once(plan: SamplePlan) -> None:
    blocks = plan.blocks()
    assert sorted(slot for block in blocks for slot in block) == list(range(plan.count))
    assert all(1 <= len(block) <= plan.block for block in blocks)
    assert all(len({plan.pair_of(slot) for slot in block}) == 1 for block in blocks)


@given(plans)
def test_train_and_test_share_no_pair(plan: SamplePlan) -> None:
    pairs = {
        split: {plan.pair_of(s) for s in range(plan.count) if plan.split_of(s) == split} for split in (TRAIN, TEST)
    }
    assert not pairs[TRAIN] & pairs[TEST]
    assert all(pair >= plan.pivots for pair in pairs[TEST])
    assert sum(plan.split_of(slot) == TEST for slot in range(plan.count)) == plan.n_test


@given(plans)
def test_pivots_share_half_of_the_training(plan: SamplePlan) -> None:
    poses = np.bincount([plan.pair_of(slot) for slot in range(plan.n_pivot)], minlength=plan.pivots)
    assert poses.sum() == plan.n_pivot == (plan.count - plan.n_test) // 2
    assert len(poses) == plan.pivots
    assert poses.max() - poses.min() <= 1
    others = np.bincount([plan.pair_of(slot) for slot in range(plan.n_pivot, plan.count)], minlength=1)
    assert others.max(initial=0) <= plan.poses_per_pair
    assert not others[: plan.pivots].any()


@settings(max_examples=20)
@given(plans, st.integers(0, 60))
def test_style_shapes_are_within_two_deviations(plan: SamplePlan, pair: int) -> None:
    betas, style = plan.style_shape(pair)
    assert betas.shape == (10,)
    assert style.shape == (4,)
    assert np.abs(np.concatenate((betas, style))).max() <= 2
    again = SamplePlan(GARMENT, plan.count + 7, seed=plan.seed, pivots=plan.pivots).style_shape(pair)
    np.testing.assert_array_equal(np.concatenate(again), np.concatenate((betas, style)))


def test_pivots_are_spread_over_each_coordinate() -> None:
    plan = SamplePlan(GARMENT, 100)
    values = np.stack([np.concatenate(plan.style_shape(pair)) for pair in range(plan.pivots)])
    ranks = values.argsort(0).argsort(0)
    assert all(len(set(column)) == plan.pivots for column in ranks.T)
    # One in each of twenty equally likely cells: mean and spread are those of the cut normal distribution.
    np.testing.assert_allclose(values.mean(0), 0, atol=0.1)
    np.testing.assert_allclose(values.std(0), 0.97, atol=0.1)


def test_recorded_and_drawn_poses_are_mixed(clips: Path) -> None:
    train, _ = split_clips(load_clips(clips))
    plan = SamplePlan(GARMENT, 400)
    recorded = np.mean([plan.pose(slot, 0, train)[1] >= 0 for slot in range(400)])
    assert recorded == pytest.approx(plan.recorded_share, abs=0.1)
    first, second = (plan.pose(3, attempt, train)[0] for attempt in (0, 1))
    assert np.abs(first - second).max() > 0.01
    np.testing.assert_array_equal(first, plan.pose(3, 0, train)[0])


def test_postures_have_their_share_and_are_held_as_others_would() -> None:
    plan = SamplePlan(GARMENT, 400, posture_share=0.4, postures=tuple(POSTURES))
    drawn = [plan.pose(slot, 0, []) for slot in range(400)]
    numbers = np.array([frame for _, _, frame in drawn])
    assert {clip for _, clip, _ in drawn} == {-1}
    assert np.mean(numbers >= 0) == pytest.approx(plan.posture_share, abs=0.1)
    assert set(numbers) == {-1, *range(len(POSTURES))}
    elbows, names = [18, 19], tuple(POSTURES)
    for pose, _, number in drawn:
        forward = Rotation.from_rotvec(pose[0]).apply([0.0, 0.0, 1.0])
        assert number < 0 or abs(forward[0]) < 1e-5 or abs(forward[2]) < 0.1  # it has no heading, or lies
        if number >= 0:
            wanted = np.linalg.norm(posture(names[number])[elbows], axis=1)
            bent = np.linalg.norm(pose[elbows], axis=1)
            assert min(np.abs(bent - wanted).max(), np.abs(bent[::-1] - wanted).max()) < np.radians(45)


def test_acrobats_tilt_in_all_directions_and_spread_their_legs() -> None:
    """As far as hips and knees go, not farther, and never head down."""
    plan = SamplePlan(GARMENT, 400, recorded_share=0.0, acrobatic_share=1.0)
    poses = np.array([plan.pose(slot, 0, [])[0] for slot in range(400)])
    up = Rotation.from_rotvec(poses[:, 0]).inv().apply([0.0, 1.0, 0.0])
    assert up[:, 1].min() >= -0.5 - 1e-5
    assert min(-up[:, [0, 2]].min(), up[:, [0, 2]].max(), up[:, 1].max()) > 0.95, "belly, back, both sides, upright"
    left, right = poses[:, 1], poses[:, 2] * [1, -1, -1]
    for hip in (left, right):
        assert np.all(hip >= np.radians([-125, -25, -15]) - 1e-6)
        assert np.all(hip <= np.radians([40, 60, 65]) + 1e-6)
        assert np.ptp(hip[:, 0]) > np.radians(140)
    mixed = SamplePlan(GARMENT, 400, recorded_share=0.0, posture_share=0.3, acrobatic_share=0.4)
    acrobats = [np.array_equal(mixed.pose(slot, 0, [])[0][[1, 2]], poses[slot][[1, 2]]) for slot in range(400)]
    assert not any(acrobats[slot] for slot in range(400) if mixed.pose(slot, 0, [])[2] >= 0)
    assert np.mean(acrobats) == pytest.approx(0.4, abs=0.1)


def test_a_plan_without_postures_is_as_it_was() -> None:
    """Weights say which plan they were trained on: its samples can be simulated again."""
    old, new = SamplePlan(GARMENT, 30), SamplePlan(GARMENT, 30, posture_share=0.0)
    assert all(np.array_equal(old.pose(slot, 0, [])[0], new.pose(slot, 0, [])[0]) for slot in range(30))
    assert old.pose(3, 0, [])[0][18, 1] == pytest.approx(-0.8027, abs=1e-3)


def test_a_plan_draws_the_postures_that_it_names() -> None:
    named = "straddle", "squat"
    plan = SamplePlan(GARMENT, 40, recorded_share=0.0, posture_share=1.0, postures=named)
    numbers = {plan.pose(slot, 0, [])[2] for slot in range(40)}
    assert numbers == {list(POSTURES).index(name) for name in named}


def test_plans_that_name_no_postures_draw_the_first_ones() -> None:
    """Cards of sets that were made before there were others don't name any."""
    plan = SamplePlan(GARMENT, 300, recorded_share=0.0, posture_share=1.0)
    assert {plan.pose(slot, 0, [])[2] for slot in range(300)} == set(range(18))


@pytest.mark.parametrize("named", [(), ("headstand",), "squat", ("squat", 3), None])
def test_postures_that_are_none_are_refused(named: object) -> None:
    with pytest.raises(SimulationError, match="wanted names of postures"):
        SamplePlan(GARMENT, 10, postures=named)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "shares", [{"posture_share": -0.1}, {"recorded_share": 0.7, "posture_share": 0.4}, {"acrobatic_share": 0.5}]
)
def test_shares_that_are_no_shares_are_refused(shares: dict[str, float]) -> None:
    with pytest.raises(SimulationError, match="shares"):
        SamplePlan(GARMENT, 10, **shares)  # type: ignore[arg-type]


@given(st.lists(st.floats(-1.99, 1.99), min_size=3, max_size=30))
def test_rounding_moves_a_vertex_by_half_a_quantum(values: list[float]) -> None:
    vertices = np.array(values[: len(values) // 3 * 3]).reshape(-1, 3)
    stored = quantise(vertices)
    assert stored.dtype == np.int16
    assert np.abs(dequantise(stored) - vertices).max() <= QUANTUM / 2
    np.testing.assert_array_equal(quantise(dequantise(stored)), stored)


def test_far_vertices_dont_fit() -> None:
    with pytest.raises(SimulationError, match="2 m"):
        quantise(np.array([[0, -2.1, 0]]))
    with pytest.raises(SimulationError, match="2 m"):
        quantise(np.array([[0, np.nan, 0]]))


# What is refused ------------------------------------------------------------------------------------------------------


def test_body_with_a_hole_is_refused(clips: Path, tmp_path: Path) -> None:
    with np.load(Path(refu_core.__file__).parent / "assets" / "body_male.npz", allow_pickle=False) as data:
        arrays = {key: data[key] for key in data.files}
    arrays["f"] = arrays["f"][1:]
    np.savez(tmp_path / "open.npz", **arrays)
    with pytest.raises(BodyError, match="watertight"):
        simulate(tmp_path / "set", clips, body=tmp_path / "open.npz")
    assert not (tmp_path / "set").exists()


def test_set_without_motions_has_drawn_poses(tmp_path: Path) -> None:
    def nothing_is_simulated(*_: Any) -> Any:
        return iter(())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_produce.InProcess, "run", nothing_is_simulated)
        card = simulate_dataset(GARMENT, 7, tmp_path / "set")
    assert card["plan"]["recorded_share"] == 0
    assert card["clips"] == {"train": [], "test": []}
    assert card["counts"]["to_do"] == 7
    plan = SamplePlan(**card["plan"])
    assert {plan.pose(slot, 0, [])[1:] for slot in range(7)} == {(-1, -1)}
    assert plan.n_test == 1


def test_the_command_takes_the_share_of_postures_from_both_other_kinds(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_produce.InProcess, "run", lambda *_: iter(()))
    output = ["--output", str(tmp_path / "set"), "--motions", str(clips), "--quiet"]
    assert main(["simulate", GARMENT, "--count", "7", "--postures", "0.5", *output]) == 0
    plan = json.loads((tmp_path / "set" / "card.json").read_text())["plan"]
    assert (plan["posture_share"], plan["recorded_share"]) == (0.5, SamplePlan.recorded_share / 2)


@pytest.mark.parametrize("typed", ["kilt.npz", "./here/kilt.npz", "/there/garment_kilt.npz"])
def test_draws_depend_on_a_garments_name_and_not_on_the_way_to_its_file(typed: str) -> None:
    plan, other = SamplePlan("kilt", 7), SamplePlan("gown", 7)
    for slot in range(7):
        assert (SamplePlan(typed, 7).pose(slot, 0, [])[0] == plan.pose(slot, 0, [])[0]).all()
        assert (other.pose(slot, 0, [])[0] != plan.pose(slot, 0, [])[0]).any()


def test_folder_without_motions_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match="found none"):
        simulate(tmp_path / "set", tmp_path)
    write_clip(tmp_path / "only.npz", np.random.default_rng(0))
    with pytest.raises(SimulationError, match="two motions"):
        simulate(tmp_path / "set", tmp_path)


def test_motions_lie_in_folders_of_subjects_beside_their_shapes(tmp_path: Path) -> None:
    for subject in ("01", "02"):
        (tmp_path / subject).mkdir()
        write_clip(tmp_path / subject / "walk_poses.npz", np.random.default_rng(0))
        np.savez(tmp_path / subject / "shape.npz", betas=np.zeros(16))
        np.savez(tmp_path / subject / "walk_stagei.npz", betas=np.zeros(16))
        (tmp_path / subject / "._walk_poses.npz").write_bytes(b"macOS leaves these")
    assert [clip.name for clip in load_clips(tmp_path)] == ["01/walk_poses", "02/walk_poses"]
    assert load_clips(tmp_path / "01" / "walk_poses.npz")[0].name == "walk_poses"


def test_all_motions_that_can_not_be_used_are_named_at_once(tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d", "e", "f"):
        write_clip(tmp_path / f"{name}.npz", np.random.default_rng(0))
    (tmp_path / "b.npz").write_bytes(b"cut off")
    with pytest.raises(SimulationError, match=r"b\.npz: (?!.*nor)"):
        load_clips(tmp_path)
    np.savez(tmp_path / "d.npz", poses=np.full((5, 72), np.nan), trans=np.zeros((5, 3)))
    with pytest.raises(SimulationError, match=r"b\.npz: .*; nor can these be used: d\.npz$"):
        load_clips(tmp_path)
    for name in "cef":
        (tmp_path / f"{name}.npz").write_bytes(b"")
    with pytest.raises(SimulationError, match=r"; nor can these be used: c\.npz, d\.npz, e\.npz, …$"):
        load_clips(tmp_path)
    for name in ("01/walk.npz", "02/walk.npz"):
        (tmp_path / "subjects" / name).parent.mkdir(parents=True)
        (tmp_path / "subjects" / name).write_bytes(b"")
    with pytest.raises(SimulationError, match=r"01/walk\.npz: .*; nor can these be used: 02/walk\.npz$"):
        load_clips(tmp_path / "subjects")


@pytest.mark.parametrize(
    ("replaced", "match"),
    [
        ({"poses": np.zeros((5, 70))}, r"got \(5, 70\)"),
        ({"poses": np.zeros((5, 72), int)}, "with a fraction"),
        ({"poses": None}, "no poses"),
        ({"poses": np.full((5, 72), np.nan)}, "finite"),
        ({"trans": np.zeros((4, 3))}, "trans"),
        ({"mocap_framerate": None}, "frame rate"),
        ({"mocap_framerate": np.array(0.0)}, "frame rate"),
    ],
)
def test_motions_of_another_layout_are_refused(replaced: dict[str, Any], match: str, tmp_path: Path) -> None:
    write_clip(tmp_path / "bad.npz", np.random.default_rng(0), **replaced)
    with pytest.raises(SimulationError, match=match) as caught:
        load_clips(tmp_path)
    assert "bad.npz" in str(caught.value)


def test_other_set_in_the_directory_is_left_alone(simulated: Path, clips: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in simulated.rglob("*.npy")}
    with pytest.raises(SimulationError, match=r"another set.*plan"):
        simulate(simulated, clips, seed=1)
    with pytest.raises(SimulationError, match=r"another set.*settings"):
        simulate(simulated, clips, settings=SimulationSettings(attempts=3))
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(SimulationError, match="neither empty"):
        simulate(tmp_path, clips)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    assert {path: path.read_bytes() for path in simulated.rglob("*.npy")} == before


def test_set_is_written_by_one_run_at_a_time(simulated: Path, clips: Path) -> None:
    with locked(simulated), pytest.raises(SimulationError, match="another run"):
        simulate(simulated, clips)
    simulate(simulated, clips)  # free again


def test_full_disk_is_said_before_anything_is_simulated(
    clips: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", no_room)
    with pytest.raises(SimulationError, match=f"no room for {COUNT} samples"):
        simulate(tmp_path / "set", clips)
    assert not list((tmp_path / "set").glob("shard-*"))


@pytest.mark.parametrize(
    "numbers",
    [
        *({"count": 0}, {"pivots": 0}, {"block": 0}, {"test_share": 1.0}, {"spread": 0.0}),
        *({"count": "10"}, {"count": 10.5}, {"count": 10**12}, {"seed": -1}, {"seed": "x"}, {"recorded_share": "0.5"}),
        *({"pivots": None}, {"spread": None}),
    ],
)
def test_impossible_plans_are_refused(numbers: dict[str, Any]) -> None:
    with pytest.raises(SimulationError, match="got"):
        SamplePlan(GARMENT, **({"count": 10} | numbers))


@pytest.mark.usefixtures("little_light")
def test_command_makes_a_set_and_its_picture(clips: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["simulate", GARMENT, "--count", "2", "--motions", str(clips), "--output", str(tmp_path / "set")]
    assert main([*arguments, "--quiet", "--json", str(tmp_path / "card.json")]) == 0
    assert "yield" in capsys.readouterr().out
    card = json.loads((tmp_path / "card.json").read_text())
    assert card["counts"]["train"] + card["counts"]["test"] == 2
    picture = np.asarray(Image.open(tmp_path / "set" / "samples.png"))
    assert picture.std() > 10
