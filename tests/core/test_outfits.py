"""Garments simulated together: layers that never cross, sets that hold several garments, training on one of them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from refu_core.body import Collider, load_body
from refu_core.errors import RefuError
from refu_core.garments import load_garment
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.sdf import ExactSdf, body_frame
from refu_core.simulation import GarmentDataset, SimulationError, colliders, simulate_dataset
from refu_core.simulation._joined import JoinedGarments
from refu_core.simulation._plan import names_of
from refu_core.simulation._store import FORMAT, read_card, write_card
from refu_core.training._data import TrainingSet
from refu_core.training._sdf import SdfSampler

NAMES = ("tshirt-male", "short-pant-male")
JOINED = "short-pant-male+tshirt-male"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("sets") / "outfit"
    simulate_dataset(NAMES, 2, output, test_share=1 / 2)
    return output


@pytest.fixture(scope="module")
def dataset(simulated: Path) -> GarmentDataset:
    return GarmentDataset(simulated)


@pytest.fixture(scope="module")
def outfit() -> JoinedGarments:
    return JoinedGarments([load_garment(name) for name in NAMES])


def test_layers_never_cross(dataset: GarmentDataset) -> None:
    shorts, shirt = load_garment("short-pant-male"), load_garment("tshirt-male")
    body = load_body("male")
    collider, checker, below = Collider(body), CollisionChecker(body.faces), SheetChecker(shorts.faces)
    assert list(dataset.parts) == [shorts.name, shirt.name]
    assert len(dataset) == 2
    sdf = ExactSdf(body.faces)
    for index in range(len(dataset)):
        sample = dataset.sample(index)
        inner, outer = (sample.vertices[part] for part in dataset.parts.values())
        (skin,) = colliders(body, collider, sample.pose[None], sample.betas)
        checker.update(skin)
        assert checker.check(inner, shorts.faces).is_free
        assert checker.check(outer, shirt.faces).is_free
        below.update(inner)
        assert not len(below.with_other(outer, shirt.faces))
        # Over it, and not beside: where the T-shirt covers the shorts' waistband, it is the farther one from the skin.
        sdf.update(torch.from_numpy(skin))
        band = inner[shorts.v_template[:, 1].numpy() > float(shorts.v_template[:, 1].max()) - 0.03]
        near = outer[np.linalg.norm(outer[:, None] - band[None], axis=2).min(1) < 0.01]
        assert len(near) > 20
        heights = [sdf.query(torch.from_numpy(points)).distance.numpy() for points in (near, band)]
        assert np.median(heights[0]) > np.median(heights[1]) + 0.002


def test_start_is_over_what_is_below_and_moves_nothing_else(outfit: JoinedGarments) -> None:
    body = load_body("male")
    skin = body.rest_vertices(torch.zeros(1, 10))[0]
    sdf = ExactSdf(body.faces)
    sdf.update(skin)
    rest = outfit.joined.v_template.numpy().copy()
    rest[outfit.parts["tshirt-male"], 2] -= 0.03  # backwards: through the front of the shorts
    layered = outfit.layered(rest, skin.numpy(), sdf)
    inner, outer = outfit.parts.values()
    np.testing.assert_array_equal(layered[inner], rest[inner])
    distance = np.linalg.norm(rest[outer][:, None] - rest[inner][None], axis=2).min(1)
    np.testing.assert_array_equal(layered[outer][distance > 0.025], rest[outer][distance > 0.025])
    assert np.linalg.norm(layered - rest, axis=1).max() > 0.004
    checker = SheetChecker(outfit.garments[0].faces)
    checker.update(layered[inner])
    assert len(checker.with_other(rest[outer], outfit.garments[1].faces)) > 100
    assert not len(checker.with_other(layered[outer], outfit.garments[1].faces))


def test_one_garment_is_its_own_outfit() -> None:
    garment = load_garment("tshirt-male")
    assert JoinedGarments([garment]).joined is garment
    assert JoinedGarments([garment]).parts == {"tshirt-male": slice(0, garment.n_vertices)}


def test_an_outfit_depends_on_no_order(outfit: JoinedGarments) -> None:
    other = JoinedGarments([load_garment(name) for name in reversed(NAMES)])
    assert other.joined.name == outfit.joined.name == JOINED
    torch.testing.assert_close(other.joined.v_template, outfit.joined.v_template, rtol=0, atol=0)
    assert names_of(NAMES) == names_of(NAMES[::-1]) == JOINED
    assert names_of("here/garment_kilt.npz") == "kilt"
    assert names_of("trousers-male+shirt-male") == names_of(["shirt-male", "trousers-male"]), "as a card has it"


def test_a_garment_without_styles_joins_in(outfit: JoinedGarments) -> None:
    plain = replace(load_garment("short-pant-male"), styledirs=None)
    joined = JoinedGarments([plain, load_garment("tshirt-male")]).joined
    style, betas = torch.ones(1, 4), torch.zeros(1, 10)
    part = outfit.parts["short-pant-male"]
    torch.testing.assert_close(joined.rest(betas, style)[:, part], plain.rest(betas))
    assert (joined.rest(betas, style) - outfit.joined.rest(betas, style)).abs().max() > 0.01


@pytest.mark.parametrize("names", [(), ("tshirt-male", "tshirt-male"), ("tshirt-male", "skirt-female")])
def test_what_makes_no_outfit_is_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(SimulationError, match="wanted different garments of one body, got"):
        JoinedGarments([load_garment(name) for name in names])


def test_one_garment_of_the_set_is_trained_on(dataset: GarmentDataset) -> None:
    for name in NAMES:
        samples = TrainingSet.of(name, dataset, None).samples
        garment, body = load_garment(name), load_body("male")
        assert samples.displacement.shape == (dataset.train.sum(), garment.n_vertices, 3)
        posed = garment.unpose(
            torch.from_numpy(dataset.sample(int(np.flatnonzero(dataset.train)[0])).vertices[dataset.parts[name]])[None],
            body(samples.pose[:1], samples.betas[:1]).transforms,
        )
        whole = posed - garment.rest(samples.betas[:1], samples.style[:1])
        assert (whole - samples.displacement[:1]).norm(dim=-1).mean() < 0.05
    with pytest.raises(RefuError, match=r"wanted a set whose garment is shirt-male, got short-pant-male\+tshirt-male"):
        TrainingSet.of("shirt-male", dataset, None)


@pytest.mark.parametrize("name", NAMES)
def test_distances_are_learnt_around_the_garment_that_is_asked_for(dataset: GarmentDataset, name: str) -> None:
    garment, body = load_garment(name), load_body("male")
    sampler = SdfSampler(dataset, body, garment, torch.arange(1))
    batch = sampler.draw(torch.Generator().manual_seed(0), bodies=1, points=400, noise=0.0)
    sample = dataset.sample(0)
    rotation, root = body_frame(body, torch.tensor(sample.pose[None]), torch.tensor(sample.betas[None]))
    worn = (torch.tensor(sample.vertices[dataset.parts[name]]) - root) @ rotation[0] + root
    cloth = trimesh.Trimesh(worn, garment.faces, process=False)
    on_cloth = batch.points[0, 250:300]  # after those on and near the skin, and near the cloth
    assert np.abs(trimesh.proximity.closest_point(cloth, on_cloth)[1]).max() < 1e-5


@pytest.mark.parametrize(
    "parts",
    [
        {"short-pant-male": 2699},
        {"short-pant-male": 2699, "tshirt-male": 7661},
        {"short-pant-male": 2699, "kilt": 7662},
        {"short-pant-male": -1, "tshirt-male": 10362},
        {"short-pant-male": 2699.0, "tshirt-male": 7662},
        {"short-pant-male": True, "tshirt-male": 10360},
        [2699, 7662],
        None,
    ],
)
def test_damaged_parts_are_refused(simulated: Path, tmp_path: Path, parts: Any) -> None:
    path = shutil.copytree(simulated, tmp_path / "set")
    write_card(path, read_card(path, FORMAT) | {"parts": parts})
    with pytest.raises(SimulationError, match="wanted a card whose parts are the 10361 vertices"):
        GarmentDataset(path)
