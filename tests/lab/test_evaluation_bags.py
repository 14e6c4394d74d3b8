"""The bags with ground truth: what ships, and the script that makes them from simulated sets."""

from __future__ import annotations

from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loaded import load_script
from rosbags.rosbag2 import Reader as RosbagsReader

import msg_adapters as adapters
from refu_core import load_body, load_garment
from refu_core.body import Collider
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.simulation import GarmentDataset, GarmentSequences, SequencePlan
from refu_core.simulation._drape import colliders
from refu_core.simulation._store import DONE, FORMAT, QUANTUM, SEQUENCES, Rows, quantise, write_card
from refu_lab.truth import GroundTruth

BAGS = Path(__file__).parents[2] / "bags"
SHIPPED = sorted(BAGS.glob("eval_*"))
GARMENT = "short-pant-male"


def garments_of(bag: Path) -> list[str]:
    """From the skin outwards."""
    worn = bag.name.removeprefix("eval_").removesuffix("_sequence").replace("_", "-")
    return worn.split("-over-")[::-1]


def moments(bag: Path) -> tuple[list[Any], GroundTruth]:
    truth = GroundTruth.of_bag(bag, {garment: load_garment(garment).faces.numpy() for garment in garments_of(bag)})
    return [record.frame for record in adapters.open_smpl_bag(bag)], truth


def test_a_bag_ships() -> None:
    assert BAGS / "eval_tshirt_male" in SHIPPED


@pytest.mark.parametrize("bag", SHIPPED, ids=lambda path: path.name)
def test_shipped_truth_is_that_of_its_frames(bag: Path) -> None:
    """Small, rosbag2, standing on the floor, and free of the collider and of the garments below."""
    assert sum(file.stat().st_size for file in bag.iterdir()) < 8e6
    with RosbagsReader(bag) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    garments = [load_garment(name) for name in garments_of(bag)]
    n_truths = counts["/ground_truth"] // len(garments)
    assert counts["/smpl_params"] >= n_truths > 50
    frames, truth = moments(bag)
    assert [len(truth.garments[garment.name]) for garment in garments] == [n_truths] * len(garments)
    body = load_body(garments[0].body)
    checker, collider = CollisionChecker(body.faces), Collider(body)
    with_truth = [frame for frame in frames if truth.of(garments[0].name, frame) is not None]
    for frame in with_truth[:: len(with_truth) // 3]:
        posed = body(frame.pose[None], betas=frame.betas[None]).vertices[0].numpy()
        checker.update(colliders(body, collider, frame.pose[None].copy(), frame.betas.copy())[0])
        worn = [np.asarray(truth.of(garment.name, frame), np.float32) for garment in garments]
        for garment, vertices in zip(garments, worn, strict=True):
            assert checker.check(vertices, garment.faces).is_free
        for (inner, below), (outer, above) in pairwise(zip(garments, worn, strict=True)):
            sheet = SheetChecker(inner.faces)
            sheet.update(below)
            assert not len(sheet.with_other(above, outer.faces))
        if not bag.name.endswith("_sequence"):
            assert posed[:, 1].min() + frame.transl[1] == pytest.approx(0, abs=1e-4)
            assert np.abs(frame.style).max() > 0.1


@pytest.fixture(scope="module")
def script() -> Any:
    return load_script("bags/make_evaluation_bags.py")


def card(kind: str) -> dict[str, Any]:
    clips = {"train": ["a"], "test": ["b"]}
    plan = asdict(SequencePlan(GARMENT, 12, shapes=6)) if kind == SEQUENCES else {"count": 12}
    return {"format": kind, "garment": GARMENT, "quantum_m": QUANTUM, "clips": clips, "plan": plan}


def rows(directory: Path, kind: str, shape: tuple[int, ...], **columns: Any) -> None:
    """A set of 12 rows, made up: the cut of each row's style, all done, half of them for the test."""
    n = 12
    Rows.create(directory, kind, np.arange(n, dtype=np.int32), shape)
    arrays = Rows(directory, kind, mode="r+").arrays
    rng = np.random.default_rng(0)
    arrays["betas"][:] = rng.normal(size=(n, 10))
    arrays["style"][:] = rng.normal(size=(n, 4))
    arrays["vertices"][:] = quantise(load_garment(GARMENT).v_template.numpy())
    arrays["split"][:] = np.arange(n) >= n // 2
    arrays["state"][:] = DONE
    for name, values in columns.items():
        arrays[name][:] = values


def test_samples_are_spread_over_the_test_split(script: Any, tmp_path: Path) -> None:
    directory = tmp_path / "set"
    directory.mkdir()
    write_card(directory, card(FORMAT))
    pose = np.random.default_rng(1).normal(0, 0.1, (12, 24, 3))
    rows(directory, FORMAT, (load_garment(GARMENT).n_vertices, 3), pose=pose, clip=np.tile((0, -1), 6))
    dataset = GarmentDataset(directory)
    for seed in range(5):
        chosen = script.spread_samples(dataset, 4, seed)
        assert len(set(chosen.tolist())) == 4
        assert dataset.test[chosen].all()
        assert 1 <= (dataset.column("clip")[chosen] >= 0).sum() <= 3
    assert sorted(script.spread_samples(dataset, 100, 0)) == list(range(6, 12))
    bag = tmp_path / "eval_short_pant_male"
    assert script.write_bag(bag, dataset.parts, script.sample_moments(dataset, 100, 0)) == (6, 6)
    frames, truth = moments(bag)
    for frame in frames:
        (index,) = np.flatnonzero((dataset.column("betas") == frame.betas).all(1))
        sample = dataset.sample(int(index))
        np.testing.assert_array_equal(frame.pose, sample.pose)
        np.testing.assert_array_equal(frame.style, sample.style)
        np.testing.assert_array_equal(truth.of(GARMENT, frame), sample.vertices)


def test_sequence_has_truth_in_each_third_frame_of_the_set(script: Any, tmp_path: Path) -> None:
    directory = tmp_path / "set"
    directory.mkdir()
    write_card(directory, card(SEQUENCES))
    cause = np.zeros((12, 7), np.uint8)
    cause[:, 3] = 2
    transl = np.linspace(0, 1, 7)[None, :, None] * np.ones((12, 1, 3))
    rows(directory, SEQUENCES, (7, load_garment(GARMENT).n_vertices, 3), cause=cause, transl=transl)
    sequences = GarmentSequences(directory)
    bag = tmp_path / "eval_short_pant_male_sequence"
    assert script.write_bag(bag, sequences.parts, script.sequence_moments(sequences, seconds=0.1)) == (7, 2)
    frames, truth = moments(bag)
    np.testing.assert_allclose([frame.transl[1] for frame in frames], np.linspace(0, 1, 7), atol=QUANTUM)
    assert [truth.of(GARMENT, frame) is not None for frame in frames] == [True, *[False] * 5, True]
    (shown,) = np.flatnonzero((sequences.column("betas") == frames[0].betas).all(1))
    assert sequences.test[shown]
    np.testing.assert_array_equal(truth.of(GARMENT, frames[6]), sequences.sequence(int(shown)).vertices(6))
    several = [frame for frame, _ in script.sequence_moments(sequences, seconds=2 * sequences.card["plan"]["seconds"])]
    assert len(several) == 14
    assert several[7].stamp_ns == several[6].stamp_ns + script.PAUSE_NS
