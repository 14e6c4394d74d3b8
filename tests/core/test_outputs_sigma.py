"""σ of predictions: as often right as it says, and the input's covariance as samples of it would have it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from refu_core import FrameError, GarmentPipeline, MeshError, PoseHistory, SmplFrame, WeightsError, load_garment
from refu_core.outputs import RADIUS_90, UNKNOWN_SIGMA, Sigma, SigmaMap, bend_of, fit_sigma, load_sigma, save_sigma
from refu_core.outputs._sigma import MOST_GROWTH, turned_of
from refu_lab.truth import cross_checked, held_out, moments_of

BAGS = Path(__file__).parents[2] / "bags"
OWN = "top-of-mine"


@pytest.fixture(scope="module")
def pipeline() -> GarmentPipeline:
    """A garment that has a σ and one that has none, somebody's own."""
    own = replace(load_garment("longsleeve-male"), name=OWN)
    return GarmentPipeline.load(["short-pant-male", own], sdf="none", collider=False)


@pytest.mark.parametrize("garment", ["tshirt-male", "shirt-male", "short-pant-male", "skirt-female"])
def test_nine_in_ten_true_vertices_are_within_the_interval(garment: str) -> None:
    """Of the style-shape pairs that σ wasn't fitted to; what ships is fitted to all."""
    samples = held_out(BAGS / f"eval_{garment.replace('-', '_')}", garment, every=2)
    assert load_sigma(samples.garment).is_measured
    assert 0.85 <= cross_checked(samples) <= 0.95


def test_what_ships_is_what_the_script_makes() -> None:
    fitted = held_out(BAGS / "eval_short_pant_male", "short-pant-male")
    shipped, anew = load_sigma(fitted.garment), fit_sigma(fitted.garment, fitted.errors, fitted.poses)
    assert np.allclose(anew.sigma, shipped.sigma, rtol=0.01)
    assert np.allclose(anew.factor, shipped.factor, rtol=0.01)


def test_sigma_is_that_of_the_errors(tmp_path: Path) -> None:
    garment = load_garment("short-pant-male")
    rng = np.random.default_rng(0)
    poses = rng.normal(0, 0.4, (300, 24, 3))
    wide = np.argsort(np.argsort(bend_of(garment, poses))) >= 200  # the most bent third is off by twice as much
    true = 0.004 * np.where(wide, 2, 1)
    errors = np.linalg.norm(rng.normal(size=(300, garment.n_vertices, 3)), axis=2) * true[:, None]
    found = fit_sigma(garment, errors, poses)
    for bend, sigma in zip(found.bend, (0.004, 0.004, 0.008), strict=True):
        assert found.at(float(bend)) == pytest.approx(sigma, rel=0.08)
    assert np.mean(errors[~wide] <= RADIUS_90 * found.at(float(found.bend[0]))) == pytest.approx(0.9, abs=0.01)
    save_sigma(garment, found, {}, folder=tmp_path)
    again = load_sigma(garment, folder=tmp_path)
    assert np.allclose(again.sigma, found.sigma, rtol=1e-3)
    assert again.is_measured
    (tmp_path / "tshirt-male").symlink_to(tmp_path / "short-pant-male")
    with pytest.raises(WeightsError, match="whose garment is tshirt-male"):
        load_sigma(load_garment("tshirt-male"), folder=tmp_path)
    with pytest.raises(MeshError, match="σ needs 30 samples or more, got 9"):
        fit_sigma(garment, errors[:9], poses[:9])
    with pytest.raises(MeshError, match=r"wanted finite errors .* and poses"):
        fit_sigma(garment, errors, np.where(np.arange(300)[:, None, None] == 7, np.nan, poses))
    with pytest.raises(MeshError, match="wanted finite errors"):
        fit_sigma(garment, np.ma.masked_equal(errors, errors[0, 0]), poses)


@pytest.mark.parametrize("garment", ["tshirt-male", "skirt-female"])
def test_moving_cloth_is_less_sure(garment: str) -> None:
    """Without this, the interval holds 46 % of a T-shirt's true vertices in this fast motion, and 69 % of a skirt's."""
    moments = moments_of(BAGS / f"eval_{garment.replace('-', '_')}_sequence", load_garment(garment))[::10]
    dressing = GarmentPipeline.load([garment])
    sigma = Sigma(dressing)
    shares, before = [], []
    for one in moments:
        out = dressing(one.frame)
        error = np.linalg.norm(out[garment].local - one.truth, axis=1)
        for told, frame in ((shares, one.frame), (before, replace(one.frame, past=None))):
            told.append(np.mean(error <= RADIUS_90 * sigma(frame, out)[garment]))
    assert 0.72 < np.mean(shares) < 0.9
    assert np.mean(before) < np.mean(shares) - 0.1
    fast = replace(one.frame, past=np.full((4, 219), 50.0))
    assert np.allclose(sigma(fast, out)[garment], (1 + MOST_GROWTH) * sigma(replace(fast, past=None), out)[garment])


@given(seed=st.integers(0, 1000), degrees=st.floats(0, 60))
def test_a_turn_is_as_far_as_it_is(seed: int, degrees: float) -> None:
    """Two joints that turn by as much as each other, about any axes: root of the sum of squares."""
    rng, garment = np.random.default_rng(seed), load_garment("short-pant-male")
    turned = np.zeros((24, 3))
    for joint in garment.card.joints[1:3]:
        axis = rng.normal(size=3)
        turned[joint] = np.radians(degrees) * axis / np.linalg.norm(axis)
    last = [SmplFrame(np.zeros((24, 3)), stamp_ns=0), SmplFrame(turned, stamp_ns=10**8)]
    past = PoseHistory.told(last)[-1].past
    assert past is not None
    assert turned_of(garment, past) == pytest.approx(np.sqrt(2) * np.radians(degrees), rel=0.1, abs=1e-3)


def test_of_somebody_who_lies_little_is_known(pipeline: GarmentPipeline) -> None:
    name, ask = "short-pant-male", Sigma(pipeline)
    pose = np.zeros((24, 3))
    found = []
    for lean in (0.0, 0.5, 0.9, 1.5):
        pose[0, 0] = lean
        frame = SmplFrame(pose=pose)
        found.append(ask(frame, pipeline(frame))[name])
    stands, leans, falls, lies = found
    assert np.array_equal(stands, leans)
    assert (falls > stands).all()
    assert (lies >= UNKNOWN_SIGMA * (1 - 1e-6)).all()
    frame = SmplFrame(pose=pose, up=np.array([0.0, np.cos(1.5), np.sin(1.5)]))  # a camera that leans as much
    assert np.allclose(ask(frame, pipeline(frame))[name], stands)


def test_what_nobody_has_measured_is_said_to_be_unknown(pipeline: GarmentPipeline) -> None:
    frame = SmplFrame(pose=np.zeros(72))
    every = Sigma(pipeline)
    assert [one.is_measured for one in every.maps.values()] == [True, False]
    found = every(frame, pipeline(frame))
    assert (found[OWN] == np.float32(UNKNOWN_SIGMA)).all()
    assert 0.001 < found["short-pant-male"].min() < found["short-pant-male"].max() < 0.02
    assert not load_sigma(pipeline.garments[OWN]).is_measured
    assert np.isfinite(SigmaMap.unknown(3).at(1.0)).all()


@pytest.mark.parametrize("is_full", [False, True])
def test_the_inputs_covariance_is_that_of_samples(pipeline: GarmentPipeline, is_full: bool) -> None:
    """Six hundred poses drawn from it, against one linear formula."""
    name, rng = OWN, np.random.default_rng(1)
    pose = rng.normal(0, 0.3, (24, 3))
    frame = SmplFrame(pose=pose)
    scale = np.radians(rng.uniform(0.3, 1.5, (24, 1, 1))) * (np.eye(3) + 0.3 * rng.normal(size=(24, 3, 3)))
    blocks = scale @ scale.transpose(0, 2, 1)
    whole = np.zeros((72, 72))
    for j in range(24):
        whole[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = blocks[j]
    if is_full:  # and a sender whose errors are one for all joints of the spine
        common = np.zeros(72)
        common[[3 * j for j in (3, 6, 9)]] = np.radians(1.0)
        whole += np.outer(common, common)
    root = np.linalg.cholesky(whole + 1e-14 * np.eye(72))
    drawn = pose + (rng.normal(size=(600, 72)) @ root.T).reshape(-1, 24, 3)
    body, garment = pipeline.body, pipeline.garments[name]
    posed = body.posed(torch.tensor(drawn, dtype=torch.float32), body.shape(torch.zeros(1, 10)))
    places = garment.pose(garment.v_template.expand(600, -1, -1), posed.transforms).numpy().astype(np.float64)
    true = np.sqrt(places.var(0).sum(1) / 3)
    every = Sigma(pipeline)
    every.maps[name] = SigmaMap(np.full(len(true), 1e-6, np.float32), np.zeros(1), np.ones(1))
    given, out = whole if is_full else blocks, pipeline(frame)
    found = every(frame, out, pose_covariance=given)[name]
    assert np.abs(found / true - 1).max() < 0.2  # six hundred samples say no more than 7 %, and turns aren't linear
    assert abs(np.mean(found / true) - 1) < 0.05
    more = every(frame, out, pose_covariance=given, transl_covariance=0.01**2 * np.eye(3))[name]
    assert np.allclose(more**2, found**2 + 0.01**2, rtol=1e-4)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"pose_covariance": np.eye(3)}, r"pose_covariance must be finite numbers of the shape \(72, 72\) or"),
        ({"pose_covariance": torch.eye(72, requires_grad=True)}, "pose_covariance must be finite .*, got Tensor"),
        ({"pose_covariance": -np.eye(72)}, "negative variance"),
        ({"transl_covariance": np.full((3, 3), np.nan)}, "transl_covariance must be finite"),
        ({"transl_covariance": "wide"}, "transl_covariance must be finite numbers"),
        ({"pose_covariance": 1e300 * np.eye(72)}, r"pose_covariance: wanted numbers up to 1e\+12, got 1e\+300"),
    ],
)
def test_a_bad_covariance_gets_a_sentence(pipeline: GarmentPipeline, given: dict[str, object], said: str) -> None:
    frame = SmplFrame(pose=np.zeros(72))
    with pytest.raises(FrameError, match=said):
        Sigma(pipeline)(frame, pipeline(frame), **given)
