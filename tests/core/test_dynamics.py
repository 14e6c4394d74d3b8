"""Cloth that knows how a person moves: what frames are told of their past, and what a network makes of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from small_set import QUANTUM, write_set, write_shard

from refu_core import GarmentPipeline, PoseHistory, RefuError, SmplFrame, load_body, load_garment
from refu_core.backbones import (
    BasisDecoder,
    Dynamic,
    Dynamics,
    DynamicsConfig,
    TailorNet,
    backbone_config,
    build_backbone,
    load_backbone,
    save_backbone,
    save_basis,
    save_dynamics,
)
from refu_core.backbones._features import N_STYLE_SHAPE
from refu_core.errors import FrameError, WeightsError
from refu_core.frames import LAGS, N_PAST
from refu_core.metrics import CollisionChecker
from refu_core.simulation import open_dataset
from refu_core.training import DynamicsSettings, LoopSettings, PretrainSettings, train_dynamics
from refu_core.training._data import output_basis, read_samples
from refu_core.training._pretrain import tell_of
from refu_core.weights import load_weights, weights_folder
from refu_lab.cli import main
from refu_lab.stress._frames import promised

pytestmark = pytest.mark.usefixtures("no_curves_in_module")
GARMENT = "short-pant-male"
LIKE = "skirt-female"
HIP = 1
FPS = 30.0
seeds = st.integers(0, 2**31)
Motion = Callable[[float], SmplFrame]


def a_motion(seed: int, *, slow: float = 1.0) -> Motion:
    """Somebody who turns, walks and swings all limbs, smoothly and without end."""
    rng = np.random.default_rng(seed)
    size, rate, start = rng.uniform(-0.6, 0.6, (24, 3)), rng.uniform(1, 4, (24, 3)) / slow, rng.uniform(0, 6, (24, 3))
    way, pace = rng.uniform(-0.3, 0.3, 3), rng.uniform(1, 4, 3) / slow

    def at(seconds: float) -> SmplFrame:
        pose = size * np.sin(rate * seconds + start)
        return SmplFrame(pose, transl=way * np.sin(pace * seconds), stamp_ns=round(1e9 * seconds))

    return at


def past_of(frames: Iterator[SmplFrame]) -> NDArray[np.float32]:
    """Of the last one."""
    past = PoseHistory.told(frames)[-1].past
    assert past is not None
    return past


def turned(pose: NDArray[np.float32], degrees: float) -> NDArray[np.float32]:
    """The pose (24, 3) of somebody who faces elsewhere."""
    root = Rotation.from_euler("y", degrees, degrees=True) * Rotation.from_rotvec(pose[0])
    return np.concatenate((root.as_rotvec()[None], pose[1:])).astype(np.float32)


def played(motion: Motion, *, until: float, fps: float, seconds: float = 0.6) -> Iterator[SmplFrame]:
    """By default a little more than the half second that is remembered."""
    n = round(seconds * fps)
    return (motion(until - (n - i) / fps) for i in range(n + 1))


def as_defined(motion: Motion, now: float) -> NDArray[np.float64]:
    """The definition, asked of the motion itself."""
    here = motion(now)
    turn = Rotation.from_rotvec(here.pose).as_matrix()
    velocity = (here.transl - motion(now - LAGS[-1]).transl) / LAGS[-1]
    rows = []
    for lag in LAGS:
        then = motion(now - lag)
        rotations = Rotation.from_rotvec(then.pose).as_matrix() - turn
        rotations[0] = turn[0].T @ rotations[0]
        beside = turn[0].T @ (then.transl - (here.transl - velocity * lag))
        rows.append(np.concatenate((rotations.ravel(), beside)))
    return np.array(rows)


@given(seed=seeds)
def test_the_past_is_what_its_definition_says(seed: int) -> None:
    motion = a_motion(seed)
    got = past_of(played(motion, until=10.0, fps=60.0, seconds=1.0))  # all lags are whole frames then
    assert got.shape == (len(LAGS), N_PAST)
    np.testing.assert_allclose(got, as_defined(motion, 10.0), atol=1e-5)


@given(seed=seeds, fps=st.floats(20.0, 400.0), shake=st.floats(0, 0.4))
def test_frames_may_come_at_any_rate(seed: int, fps: float, shake: float) -> None:
    motion, rng = a_motion(seed, slow=3.0), np.random.default_rng(seed)

    def late(frame: SmplFrame) -> SmplFrame:
        return motion(1e-9 * frame.stamp_ns + shake / fps * rng.random())

    frames = [late(frame) for frame in played(motion, until=10.0, fps=fps)]
    got = past_of(iter(frames))
    np.testing.assert_allclose(got, as_defined(motion, 1e-9 * frames[-1].stamp_ns), atol=0.02)


@given(seed=seeds, heading=st.floats(-3, 3), place=st.tuples(*[st.floats(-1e6, 1e6)] * 3))
def test_place_and_heading_say_nothing(seed: int, heading: float, place: tuple[float, float, float]) -> None:
    motion, turn = a_motion(seed), Rotation.from_rotvec((0, heading, 0))

    def elsewhere(seconds: float) -> SmplFrame:
        frame = motion(seconds)
        pose = frame.pose.astype(np.float64)
        pose[0] = (turn * Rotation.from_rotvec(pose[0])).as_rotvec()
        return replace(frame, pose=pose, transl=turn.apply(frame.transl.copy()) + place)

    got = past_of(played(elsewhere, until=10.0, fps=FPS))
    np.testing.assert_allclose(got, past_of(played(motion, until=10.0, fps=FPS)), atol=1e-5)


@given(seed=seeds)
def test_who_stands_or_glides_has_no_past(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, speed = rng.normal(0, 0.5, (24, 3)), rng.uniform(-3, 3, 3)
    frames = (SmplFrame(pose, transl=speed * i / FPS, stamp_ns=round(1e9 * i / FPS)) for i in range(30))
    told = [frame.past for frame in PoseHistory.told(frames)]
    assert not np.abs(told[-1]).max() > 1e-6  # type: ignore[arg-type]
    assert not told[0].any()  # type: ignore[union-attr]


def test_far_away_no_motion_is_made_of_rounding() -> None:
    far = np.array((1e28, -3e27, 0.0))
    frames = (SmplFrame(np.zeros((24, 3)), transl=far, stamp_ns=round(1e9 * i / FPS)) for i in range(30))
    assert not any(frame.past.any() for frame in PoseHistory.told(frames) if frame.past is not None)


def test_a_frame_that_comes_late_takes_no_past_from_others() -> None:
    frames = [a_motion(3)(i / 15) for i in range(12)]
    late = PoseHistory.told([*frames[:7], *frames[8:10], frames[7], *frames[10:]])
    for got, wanted in zip(late[9:], [PoseHistory.told(frames)[7], *PoseHistory.told(frames)[10:]], strict=True):
        assert got.past is not None
        assert wanted.past is not None
        np.testing.assert_allclose(got.past, wanted.past, atol=0.02)  # the motion is taken as even between frames


@pytest.mark.parametrize("break_", ["clock back", "long pause", "leap", "turn"])
def test_what_does_not_go_on_starts_anew(break_: str) -> None:
    motion, history = a_motion(3), PoseHistory()
    for frame in played(motion, until=10.0, fps=FPS):
        last = history(frame)
    assert last.past is not None
    assert last.past.any()
    frame = {
        "clock back": replace(motion(10.1), stamp_ns=5 * 10**9),
        "long pause": motion(10.26),
        "leap": replace(motion(10.1), transl=motion(10.1).transl + np.array((0, 0, 2.0))),
        "turn": replace(motion(10.24), pose=turned(motion(10.24).pose, 180)),
    }[break_]
    told = history(frame).past
    assert told is not None
    assert not told.any()


@pytest.mark.parametrize(("fps", "degrees_s"), [(30, 360), (30, 600), (5, 600), (120, 600)])
def test_who_turns_as_fast_as_people_do_goes_on(fps: int, degrees_s: float) -> None:
    """Recorded roots reach 355 degrees a second."""
    stands = np.zeros((24, 3), np.float32)
    frames = [
        SmplFrame(turned(stands, degrees_s * i / fps), stamp_ns=round(1e9 * (1 + i / fps))) for i in range(fps // 2 + 1)
    ]
    assert all(frame.past is not None and frame.past.any() for frame in PoseHistory.told(frames)[1:])


@pytest.mark.parametrize("fps", [5, 10, 30, 60])
def test_a_frame_that_faces_backwards_swings_nothing(fps: int) -> None:
    """Trackers take front for back, in one frame or for good."""
    stands = np.zeros((24, 3), np.float32)
    poses = [turned(stands, 175 if i in {2, 4, 5} else 0) for i in range(8)]
    frames = [SmplFrame(pose, stamp_ns=round(1e9 * (1 + i / fps))) for i, pose in enumerate(poses)]
    assert not any(frame.past.any() for frame in PoseHistory.told(frames) if frame.past is not None)


def test_a_message_that_comes_twice_or_upon_the_last_one_ends_nothing() -> None:
    motion = a_motion(3)
    frames = list(played(motion, until=10.0, fps=60.0))
    np.testing.assert_array_equal(past_of(iter([*frames, frames[-1]])), past_of(iter(frames)))
    walk = [replace(frame, transl=frame.transl + np.array((0, 0, 1.5e-9 * frame.stamp_ns))) for frame in frames]
    queued = [*walk[:-1], replace(walk[-1], stamp_ns=walk[-2].stamp_ns + 1_500_000)]  # stamped as they were read
    np.testing.assert_allclose(past_of(iter(queued)), past_of(iter(walk)), atol=0.05)


def test_people_are_told_apart_forgotten_and_bounded() -> None:
    history, one, other = PoseHistory(), a_motion(1), a_motion(2)
    for a, b in zip(played(one, until=5.0, fps=FPS), played(other, until=5.0, fps=FPS), strict=True):
        told = history(a, "a"), history(b, "b")
    for mine, motion in zip(told, (one, other), strict=True):
        np.testing.assert_array_equal(mine.past, past_of(played(motion, until=5.0, fps=FPS)))
    history.forget("a")
    assert not history(one(5.1), "a").past.any()  # type: ignore[union-attr]
    assert history(other(5.1), "b").past.any()  # type: ignore[union-attr]
    for k in range(1000):
        history(one(5.2), f"passer-by {k}")
    assert len(history._people) == 64
    for k in range(3000):  # a second at 3 kHz
        history(one(6 + k / 3000), "fast")
    assert len(history._people["fast"]) < 1.1 * 240 * LAGS[-1]


def test_nothing_older_than_the_longest_lag_counts() -> None:
    motion = a_motion(5)
    short, long = (past_of(played(motion, until=10.0, fps=FPS, seconds=s)) for s in (LAGS[-1] + 0.1, 9.0))
    np.testing.assert_array_equal(short, long)


@pytest.mark.parametrize("past", [np.zeros(5), np.full((len(LAGS), N_PAST), np.nan), "yesterday"])
def test_a_past_of_another_kind_is_refused(past: object) -> None:
    with pytest.raises(FrameError, match="past"):
        SmplFrame(np.zeros(72), past=past)  # type: ignore[arg-type]


# The network --------------------------------------------------------------------------------------


def untrained(basis: BasisDecoder | None = None) -> Dynamic:
    """With a tailornet of a basis of few components, none of them trained."""
    torch.manual_seed(0)
    garment = load_garment(GARMENT)
    basis = basis or output_basis(1e-2 * torch.randn(12, garment.n_vertices, 3), rank=8)
    config = replace(backbone_config("tailornet", garment), low=(16,), high=(8,), style_shape=(8,))  # type: ignore[arg-type]
    still = build_backbone(config, garment, basis=basis, pivots=torch.randn(3, 14))
    assert isinstance(still, TailorNet)
    dynamics = Dynamics(DynamicsConfig(garment.card.joints, hidden=(16,)), still)
    with torch.no_grad():
        n_now = still.features.size + N_STYLE_SHAPE
        dynamics.net.lowest[n_now:], dynamics.net.highest[n_now:] = -1.0, 1.0
    return Dynamic(still, dynamics).eval().requires_grad_(False)


@given(seed=seeds)
def test_who_stands_wears_what_the_tailornet_says(seed: int) -> None:
    network, draw = NETWORK, torch.Generator().manual_seed(seed)
    betas, pose, past = (torch.randn(4, *shape, generator=draw) for shape in ((10,), (24, 3), (len(LAGS), N_PAST)))
    plain = network.still(betas, pose, None)
    for rest in (None, torch.zeros_like(past)):
        assert torch.equal(network(betas, pose, None, past=rest), plain)
    moved = network(betas, pose, None, past=past)
    assert not torch.allclose(moved, plain, atol=1e-4)
    for i in range(4):
        alone = network(betas[i : i + 1], pose[i : i + 1], None, past=past[i : i + 1])
        torch.testing.assert_close(alone, moved[i : i + 1], atol=1e-5, rtol=0)


def test_it_is_told_nothing_beyond_what_it_has_learnt_from() -> None:
    betas, pose, past = torch.randn(1, 10), torch.randn(1, 24, 3), torch.randn(1, len(LAGS), N_PAST)
    wild = network_code(betas, pose, 1e2 * past.sign())
    torch.testing.assert_close(wild, network_code(betas, pose, past.sign()))


def network_code(betas: torch.Tensor, pose: torch.Tensor, past: torch.Tensor) -> torch.Tensor:
    displacement = NETWORK(betas, pose, None, past=past)
    assert displacement is not None
    return displacement


def test_joints_that_do_not_move_the_garment_say_nothing() -> None:
    betas, pose, past = torch.randn(1, 10), torch.randn(1, 24, 3), torch.zeros(1, len(LAGS), N_PAST)
    elbow = 18
    past[..., 9 * elbow : 9 * elbow + 9] = 1.0
    assert torch.equal(network_code(betas, pose, past), network_code(betas, pose, torch.zeros_like(past)))


def test_what_a_tailornet_learns_of_later_changes_no_dynamics() -> None:
    """They are told of the joints that they were trained with."""
    network, draw = untrained(), torch.Generator().manual_seed(0)
    shapes = (10,), (24, 3), (len(LAGS), N_PAST)
    betas, pose, past = (0.3 * torch.randn(4, *shape, generator=draw) for shape in shapes)
    before = network(betas, pose, None, past=past)
    tell_of(network.still, (16, 17), pose)
    later = Dynamics(network.dynamics.config, network.still)
    later.load_state_dict(network.dynamics.state_dict())
    after = Dynamic(network.still, later).eval()(betas, pose, None, past=past)
    torch.testing.assert_close(after, before, atol=1e-6, rtol=0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Weights of `NETWORK`, where `GarmentPipeline.load` finds them."""
    return write(tmp_path / GARMENT, NETWORK)


def write(folder: Path, network: Dynamic) -> Path:
    card = {"garment": GARMENT, "body_fingerprint": load_body("male").fingerprint}
    save_basis(folder, network.still.decoder, card)  # type: ignore[arg-type]
    save_backbone(folder / "tailornet-none", network.still, card)
    save_backbone(folder / "tailornet-hybrid", network.still, card)
    save_dynamics(folder, network.dynamics, card)
    return folder


def test_saved_and_loaded_it_predicts_the_same(folder: Path) -> None:
    loaded = load_backbone("dynamic", GARMENT, folder=folder)
    assert loaded.heeds_past
    assert not load_backbone("tailornet", GARMENT, folder=folder).heeds_past
    betas, pose, past = torch.randn(2, 10), 0.3 * torch.randn(2, 24, 3), 0.3 * torch.randn(2, len(LAGS), N_PAST)
    got, wanted = (one(betas, pose, None, past=past) for one in (loaded, NETWORK))
    torch.testing.assert_close(got, wanted, atol=1e-3, rtol=0)  # parameters are stored in half precision


def test_what_does_not_belong_together_is_refused(folder: Path) -> None:
    network = untrained()
    mlp = build_backbone(
        backbone_config("mlp", load_garment(GARMENT)),
        load_garment(GARMENT),
        basis=network.still.decoder,  # type: ignore[arg-type]
    )
    card = {"garment": GARMENT, "body_fingerprint": load_body("male").fingerprint}
    save_backbone(folder / "mlp-none", mlp, card)
    (folder / "tailornet-none.json").write_text((folder / "mlp-none.json").read_text())
    (folder / "tailornet-none.safetensors").write_bytes((folder / "mlp-none.safetensors").read_bytes())
    with pytest.raises(WeightsError, match="go with a tailornet, got mlp"):
        load_backbone("dynamic", GARMENT, folder=folder)
    stored = json.loads((folder / "dynamics.json").read_text())
    for change, message in (
        ({"basis_sha256": "another"}, "basis_sha256"),
        ({"garment": "skirt-female"}, "garment"),
        ({"config": {"joints": [0, 24]}}, "joints below 24"),
        ({"config": {"joints": [0, 16]}}, "that the tailornet knows"),
        ({"config": {"joints": [0, 1], "hidden": [16]}}, "doesn't fit tailornet-hybrid"),
        ({"config": {"joints": [0, 1], "depth": 3}}, "doesn't know"),
    ):
        (folder / "dynamics.json").write_text(json.dumps(stored | change))
        with pytest.raises(WeightsError, match=rf"dynamics\.\w+: .*{message}"):
            load_backbone("dynamic", GARMENT, mode="hybrid", folder=folder)
    (folder / "dynamics.json").unlink()
    with pytest.raises(WeightsError, match="no such weights"):
        load_backbone("dynamic", GARMENT, mode="hybrid", folder=folder)


NETWORK = untrained()


# The pipeline -------------------------------------------------------------------------------------


def test_a_pipeline_tells_its_garments(folder: Path) -> None:
    still, moving = (
        GarmentPipeline.load([GARMENT], backbone=name, sdf="none", weights=folder.parent)
        for name in ("tailornet", "dynamic")
    )
    assert moving.heeds_past
    assert not still.heeds_past
    motion = a_motion(7)
    frames = PoseHistory.told(played(motion, until=5.0, fps=FPS))
    standing, last = replace(frames[-1], past=None), frames[-1]
    np.testing.assert_array_equal(moving(standing)[GARMENT].local, still(standing)[GARMENT].local)
    alone = moving(last)[GARMENT].local
    assert np.linalg.norm(alone - still(last)[GARMENT].local, axis=1).max() > 1e-3
    # The pose alone doesn't say whether anything has changed.
    assert moving(standing).stats.skipped.get("unchanged") is None
    assert moving(standing).stats.skipped["unchanged"] == 1
    together = moving([frames[3], standing, last])
    np.testing.assert_allclose(together[2][GARMENT].local, alone, atol=1e-5)
    np.testing.assert_allclose(together[1][GARMENT].local, still(standing)[GARMENT].local, atol=1e-5)


@pytest.mark.parametrize("garment", ["skirt-female", "tshirt-male"])
def test_whatever_the_past_nothing_is_inside(garment: str) -> None:
    pipeline, rng = GarmentPipeline.load([garment], threads=2), np.random.default_rng(0)
    assert pipeline.heeds_past
    checker = CollisionChecker(pipeline.body.faces.numpy())
    n_promised = 0
    for size in (0.1, 0.5, 2.0, 100.0):
        pasts = size * rng.uniform(-1, 1, (6, len(LAGS), N_PAST))
        for out in pipeline([replace(promised(rng), past=past) for past in pasts]):
            assert np.isfinite(out[garment].local).all()
            if out.stats.within_promise:
                n_promised += 1
                checker.update(out.body)
                assert checker.check(out[garment].local, out[garment].faces).n_inside == 0
    assert n_promised > 10


def test_all_precisions_are_told(folder: Path) -> None:
    from refu_core import Wearer, dress

    outfit = GarmentPipeline.load([GARMENT], backbone="dynamic", sdf="none", weights=folder.parent).outfit
    past, pose = 0.3 * torch.randn(1, len(LAGS), N_PAST), 0.3 * torch.randn(1, 24, 3)
    found = []
    for one, kind in ((outfit, torch.float32), (outfit.to(torch.float64), torch.float64)):
        wearer = Wearer.of(one, torch.zeros(1, 10, dtype=kind))
        found.append(dress(pose.to(kind), wearer, past=past.to(kind)).drapes[GARMENT].vertices)
        with pytest.raises(FrameError, match="past must be"):
            dress(pose.to(kind), wearer, past=past[:, :2].to(kind))
    torch.testing.assert_close(found[0].double(), found[1], atol=1e-5, rtol=0)


# Training -----------------------------------------------------------------------------------------


def write_sequences(folder: Path, *, count: int = 10, n_test: int = 2, seconds: float = 2.0) -> Path:
    """Shorts that are thrown outwards by how fast the hip swings, in the documented format (docs/guide/data.md)."""
    garment, body, n = load_garment(GARMENT), load_body("male"), round(seconds * FPS)
    rng = np.random.default_rng(0)
    shift = torch.zeros(garment.n_vertices, 3)
    shift[:, 2] = 0.1 * garment.weights[:, HIP]
    poses, vertices = np.zeros((count, n, 24, 3), "<f4"), []
    for k in range(count):
        t = np.arange(n) / FPS
        rate, start = rng.uniform(2, 5), rng.uniform(0, 6)
        poses[k, :, HIP, 0] = 0.6 * np.sin(rate * t + start)
        speed = np.concatenate(([0], np.diff(poses[k, :, HIP, 0]) * FPS))
        with torch.no_grad():
            rest = garment.rest(torch.zeros(n, 10)) + torch.as_tensor(speed, dtype=torch.float32)[:, None, None] * shift
            posed = garment.pose(rest, body(torch.as_tensor(poses[k]), torch.zeros(n, 10)).transforms)
        vertices.append(np.rint(posed.numpy() / QUANTUM).astype("<i2"))
    columns = {
        "vertices": np.stack(vertices),
        "pose": poses,
        "transl": np.zeros((count, n, 3), "<f4"),
        "betas": np.zeros((count, 10), "<f4"),
        "style": np.zeros((count, 4), "<f4"),
        "slot": np.arange(count, dtype="<i4"),
        "shape": np.zeros(count, "<i4"),
        "clip": np.zeros(count, "<i4"),
        "start": np.zeros(count, "<f4"),
        "mirrored": np.zeros(count, "|u1"),
        "split": (np.arange(count) >= count - n_test).astype("|u1"),
        "state": np.ones(count, "|u1"),
        "cause": np.zeros((count, n), "|u1"),
        "stretch": np.ones((count, n), "<f4"),
        "speed": np.ones((count, n), "<f4"),
        "dropped": np.zeros((count, 4), "<i4"),
        "seconds": np.ones(count, "<f4"),
    }
    card = {
        "format": "refu-sequences-2",
        "garment": GARMENT,
        "body": "male",
        "body_fingerprint": body.fingerprint,
        "quantum_m": QUANTUM,
        "plan": {"count": count},
        "clips": {"train": ["a"], "test": ["b"]},
    }
    return write_shard(folder, columns, card)


def test_it_learns_what_a_pose_cannot_tell(tmp_path: Path) -> None:
    data = write_sequences(tmp_path / "sequences")
    samples = read_samples(open_dataset(data), load_body("male"), load_garment(GARMENT), split="train")
    weights = write(tmp_path / GARMENT, untrained(output_basis(samples.displacement, rank=8)))
    settings = DynamicsSettings(LoopSettings(weight_decay=0.01, learning_rate=3e-3), steps=300)
    card = train_dynamics(GARMENT, [data], weights, settings=settings, quiet=True)
    figures = card["figures"]
    assert figures["mpve_mm"] < 0.35 * figures["still_mm"]
    assert figures["basis_mm"] < figures["mpve_mm"]
    stored = load_weights(weights / "dynamics")
    assert stored.card["figures"] == figures
    assert not (weights / "dynamics.checkpoint").exists()


def test_sets_are_learnt_from_together(tmp_path: Path) -> None:
    sets = [write_sequences(tmp_path / str(count), count=count, n_test=1, seconds=0.5) for count in (3, 4)]
    samples = read_samples(open_dataset(sets[0]), load_body("male"), load_garment(GARMENT), split="train")
    weights = write(tmp_path / GARMENT, untrained(output_basis(samples.displacement, rank=8)))
    settings = DynamicsSettings(steps=1)
    one, other, both = (
        train_dynamics(GARMENT, some, weights, settings=settings, quiet=True) for some in (sets[:1], sets[1:], sets)
    )
    # Of two or three sequences none is kept for validation, of five one is.
    assert both["figures"]["samples"] == one["figures"]["samples"] + other["figures"]["samples"]
    n_frames = len(samples) // 2
    assert [one["samples"], other["samples"]] == [2 * 2 * n_frames, 2 * 3 * n_frames]
    assert both["samples"] == 2 * 4 * n_frames


def test_a_set_may_be_for_training_or_for_the_test_alone(tmp_path: Path) -> None:
    for_training = write_sequences(tmp_path / "training", count=3, n_test=0, seconds=0.5)
    for_the_test = write_sequences(tmp_path / "test", count=2, n_test=2, seconds=0.5)
    samples = read_samples(open_dataset(for_training), load_body("male"), load_garment(GARMENT), split="train")
    weights = write(tmp_path / GARMENT, untrained(output_basis(samples.displacement, rank=8)))
    learn = partial(train_dynamics, GARMENT, folder=weights, settings=DynamicsSettings(steps=1), quiet=True)
    card = learn([for_the_test, for_training])
    assert (card["samples"], card["figures"]["samples"]) == (2 * len(samples), 2 * 15)
    for alone, wanted in ((for_training, "to test on"), (for_the_test, "to train on")):
        with pytest.raises(RefuError, match=wanted):
            learn([alone])


def test_it_goes_on_from_what_a_related_garment_knows(tmp_path: Path) -> None:
    data = write_sequences(tmp_path / "sequences", count=4, n_test=1, seconds=0.5)
    samples = read_samples(open_dataset(data), load_body("male"), load_garment(GARMENT), split="train")
    weights = write(tmp_path / GARMENT, untrained(output_basis(samples.displacement, rank=8)))
    card = train_dynamics(GARMENT, [data], weights, like=LIKE, settings=DynamicsSettings(steps=1), quiet=True)
    assert card["start"] == LIKE
    known, own = (load_weights(folder / "dynamics").tensors for folder in (weights_folder(LIKE), weights))
    middle = "net.layers.1.weight"  # but for a step of learning, and rounding
    assert torch.allclose(own[middle].float(), known[middle].float(), atol=2 * DynamicsSettings().later_rate + 2e-3)
    assert own["net.layers.2.weight"].shape == (8, known["net.layers.2.weight"].shape[1])


def test_samples_at_rest_teach_no_motion(tmp_path: Path) -> None:
    data = write_set(tmp_path / "rest", load_garment(GARMENT), load_body("male"))
    with pytest.raises(RefuError, match="--sequences"):
        train_dynamics(GARMENT, [data], tmp_path, quiet=True)


def test_a_tailornet_is_wanted_first(tmp_path: Path) -> None:
    data = write_sequences(tmp_path / "sequences", count=3, n_test=1, seconds=0.5)
    with pytest.raises(WeightsError, match="no such weights"):
        train_dynamics(GARMENT, [data], tmp_path / GARMENT, quiet=True)


def test_the_command_counts_frames_and_not_sequences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It counted for itself, and trained on thousands of frames with the settings for dozens of samples."""
    data = write_sequences(tmp_path / "sequences", count=4, n_test=1, seconds=0.5)
    counted, of = [], PretrainSettings.of
    monkeypatch.setattr(PretrainSettings, "of", lambda *given, samples=0: counted.append(samples) or of(*given))
    common = ["--backbone", "mlp", "--mode", "none", "--steps", "1", "--quiet"]
    assert main(["train", GARMENT, "--data", str(data), "--output", str(tmp_path / GARMENT), *common]) == 0
    assert counted == [3 * 15]
