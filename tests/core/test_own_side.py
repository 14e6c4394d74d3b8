"""Cloth deep in the body: against a slow reference, and what becomes of a skirt on raised, spread thighs."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from refu_core import GarmentPipeline, SmplFrame
from refu_core.contact import DEFAULT_CONTACT, OwnSide
from refu_core.garments import load_garment
from refu_core.metrics import CollisionChecker
from refu_core.realtime import Dressed
from refu_core.skeleton import JOINT_NAMES

SKIRT = "skirt-female"
MESH = load_garment(SKIRT).mesh
N = MESH.n_vertices


@cache
def own_side() -> OwnSide:
    return OwnSide(load_garment(SKIRT), torch.full((N,), 0.05))  # thin legs: a skirt isn't round one of them


def slow(points: NDArray[np.float64], distance: NDArray[np.float64], skin: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same, one vertex at a time."""
    how = DEFAULT_CONTACT
    share = [min(max(-d / how.layer_reach - 1, 0), 1) for d in distance]
    start, items = MESH.ring
    way = [share[i] * (skin[i] - points[i]) for i in range(N)]
    moved = way
    for _ in range(how.around):
        around = [np.mean([moved[j] for j in items[start[i] : start[i + 1]]], axis=0) for i in range(N)]
        moved = [way[i] + (1 - share[i]) * how.fade * around[i] for i in range(N)]
    far = np.linalg.norm(moved, axis=1)
    return points + moved * np.minimum(1, how.max_displacement / np.maximum(far, 1e-12))[:, None]


def test_equals_the_slow_one() -> None:
    rng = np.random.default_rng(0)
    points, skin = rng.normal(0, 0.05, (2, N, 3))
    distance = np.where(rng.random(N) < 0.1, -rng.uniform(0, 0.08, N), 0.01)
    given = [torch.tensor(one, dtype=torch.float32) for one in (points, distance, skin)]
    found = own_side()(given[0], own_side().share(given[1]), given[2])
    np.testing.assert_allclose(found, slow(points, distance, skin), atol=1e-6)


def test_cloth_that_is_not_deep_stays() -> None:
    distance = torch.linspace(1e-6 - DEFAULT_CONTACT.layer_reach, 1.0, N)
    assert not own_side().share(distance).any()
    deep = torch.tensor([-2 * DEFAULT_CONTACT.layer_reach, -1.0]).expand(N // 2, 2).flatten()
    assert own_side().share(deep)[:2].tolist() == [1.0, 1.0]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_it_is_continuous_and_bounded(seed: int) -> None:
    """Whatever is deep: cloth moves by no more than the promise, and a millimetre of depth makes a few."""
    random = torch.Generator().manual_seed(seed)
    points, skin = 0.1 * torch.randn(2, N, 3, generator=random)
    distance = 0.05 * torch.randn(N, generator=random)
    one = own_side()(points, own_side().share(distance), skin)
    other = own_side()(points, own_side().share(distance - 0.001), skin)
    assert float((one - points).norm(dim=1).max()) <= DEFAULT_CONTACT.max_displacement + 1e-6
    # The share changes by 3 % a millimetre.
    assert float((other - one).norm(dim=1).max()) < 0.034 * 2 * float((skin - points).norm(dim=1).max())


def cross_legged(bend: float) -> SmplFrame:
    pose = np.zeros((24, 3))
    for side, sign in (("left", 1), ("right", -1)):
        pose[JOINT_NAMES.index(f"{side}_hip")] = np.radians([-85 * bend, 45 * sign * bend, 45 * sign * bend])
        pose[JOINT_NAMES.index(f"{side}_knee"), 0] = np.radians(100 * bend)
        pose[JOINT_NAMES.index(f"{side}_shoulder"), 2] = np.radians(-75 * sign)
    return SmplFrame(pose)


@pytest.mark.parametrize("bend", [0.7, 0.85, 1.0])
def test_a_skirt_on_raised_and_spread_thighs_is_not_torn(bend: float) -> None:
    """Its back was predicted up to 80 mm deep in the thighs, and was thrown out to both sides of them."""
    pipeline = GarmentPipeline.load([SKIRT])
    checker = CollisionChecker(pipeline.body.faces)
    outs = pipeline([cross_legged(bend), cross_legged(bend + 0.01)])
    checker.update(outs[0].body)
    found = checker.check(outs[0][SKIRT].local, pipeline.garments[SKIRT].faces.numpy())
    assert not found.inside.any()
    assert len(found.pairs) < 20
    assert np.linalg.norm(outs[1][SKIRT].local - outs[0][SKIRT].local, axis=1).max() < 0.06


@pytest.mark.parametrize("way", [[0.0, 0.0, 0.04], [0.04, 0.0, 0.0]])
def test_a_sleeve_in_the_middle_of_a_forearm_is_not_torn(way: list[float]) -> None:
    """A forearm is never 30 mm deep: the halves of a sleeve were thrown out to both sides of it."""
    pipeline = GarmentPipeline.load(["shirt-male"])
    shirt = pipeline.garments["shirt-male"]
    of_forearm = shirt.weights[:, JOINT_NAMES.index("left_elbow"), None]

    def moved(dressed: Dressed) -> Dressed:
        drape = dressed.drapes["shirt-male"]
        drape = drape._replace(vertices=drape.vertices + of_forearm * torch.tensor(way))
        return dressed._replace(drapes={"shirt-male": drape})

    pose = np.zeros((24, 3))
    pose[16, 2], pose[17, 2] = -1.2, 1.2
    out = pipeline.adjusted(SmplFrame(pose), moved)
    checker = CollisionChecker(pipeline.body.faces)
    checker.update(out.body)
    assert checker.check(out["shirt-male"].local, shirt.faces.numpy()).is_free
    lengths = [np.linalg.norm(points[a] - points[b], axis=1) for a, b in [shirt.mesh.edges.T]
               for points in (out["shirt-male"].local, shirt.v_template.numpy())]  # fmt: skip
    assert (lengths[0] / lengths[1]).max() < 2


def test_a_heel_goes_up_behind_a_skirt() -> None:
    pose = np.zeros((24, 3))
    pose[4, 0], pose[16, 2], pose[17, 2] = 1.9, -1.2, 1.2
    pipeline = GarmentPipeline.load([SKIRT])
    out = pipeline(SmplFrame(pose))
    checker = CollisionChecker(pipeline.body.faces)
    checker.update(out.body)
    assert checker.check(out[SKIRT].local, pipeline.garments[SKIRT].faces.numpy()).is_free
