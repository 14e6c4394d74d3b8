"""Keypoints to poses: against the body model, and a known motion with noise, gaps, exchanged sides and other people."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters import iter_smpl_frames, read_motion
from refu_core import FrameError, RefuError, SmplFrame, load_body
from refu_core.keypoints import LAYOUTS, MOST_PEOPLE, KeypointTracker, People, Proportions, Skeleton, keypoint_layout
from refu_core.keypoints._pose import Pose, exp_so3, log_so3
from refu_core.keypoints._solver import turned_about_bones, twisted_wrongly
from refu_core.recordings._followed import SMPL_POINTS, follow
from refu_core.skeleton import JOINT_NAMES
from tests.torn import interrupts

ROOT = Path(__file__).parents[2]
MOTIONS = Path(os.environ.get("REFU_MOTIONS", "/nowhere"))
Array = NDArray[np.float64]
SHOWN = [i for i, name in enumerate(JOINT_NAMES) if "hand" not in name and "foot" not in name]
"""Joints that the layouts show, or that lie between what they show."""


@cache
def proportions() -> Proportions:
    return Proportions.builtin("male")


@cache
def skeleton(name: str) -> Skeleton:
    return Skeleton(keypoint_layout(name), proportions())


def test_a_layout_that_there_is_not_is_answered_with_those_there_are() -> None:
    with pytest.raises(RefuError, match="no layout of keypoints 'openpose': wanted coco17"):
        keypoint_layout("openpose")


def pose_of(frame: SmplFrame) -> Pose:
    betas = frame.betas.astype(np.float64)
    return Pose(frame.transl + proportions().of(betas)[0], exp_so3(frame.pose.astype(np.float64)), betas)


def points_of(frame: SmplFrame, layout: str) -> Array:
    return skeleton(layout).posed(pose_of(frame)).points


def joints_of(frame: SmplFrame) -> Array:
    return skeleton("smpl24").posed(pose_of(frame)).joints


class Clip(NamedTuple):
    frames: list[SmplFrame]
    fps: float


@cache
def clip(name: str, n: int = 75) -> Clip:
    """Known motion, of somebody who isn't of mean shape."""
    betas = np.random.default_rng(0).normal(size=10).astype(np.float32) * 0.8
    if name.startswith("cmu"):
        if not (MOTIONS / f"{name}.npz").exists():
            pytest.skip("REFU_MOTIONS has no recorded motion")
        motion = read_motion(MOTIONS / f"{name}.npz")
        frames, fps = [motion.frame(i) for i in range(min(n, len(motion)))], motion.fps
    else:
        frames = [record.frame for record in iter_smpl_frames(ROOT / "bags" / name) if record.frame][:n]
        fps = 30.0
    stamps = [10**9 + round(1e9 * i / fps) for i in range(len(frames))]
    known = [SmplFrame(f.pose, betas, f.transl, stamp_ns=stamp) for f, stamp in zip(frames, stamps, strict=True)]
    return Clip(known, fps)


def noisy(points: Array, rng: np.random.Generator, *, noise: float = 0.01, dropped: float = 0.1) -> Array:
    seen = points + rng.normal(size=points.shape) * noise
    seen[rng.random(len(points)) < dropped] = np.nan
    return seen


def errors(got: list[SmplFrame | None], known: list[SmplFrame]) -> Array:
    """[m], shape (T, joints)."""
    assert all(frame is not None for frame in got)
    pairs = zip(got, known, strict=True)
    return np.array([np.linalg.norm(joints_of(a) - joints_of(b), axis=1)[SHOWN] for a, b in pairs if a is not None])


def jitter(places: list[Array]) -> float:
    """Median of the second differences [m]."""
    return float(np.median(np.linalg.norm(np.diff(places, 2, axis=0), axis=-1)))


# The model --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS)
def test_joints_are_the_bodys(layout: str) -> None:
    rng = np.random.default_rng(1)
    body = load_body("male", dtype=torch.float64)
    assert np.abs(Proportions.of_body(body).shapedirs - proportions().shapedirs).max() < 1e-9
    pose, betas = rng.normal(size=(24, 3)) * 0.6, rng.normal(size=10)
    model = body(pose[None], betas[None]).joints[0].numpy()
    posed = skeleton(layout).posed(Pose(model[0], exp_so3(pose), betas))
    np.testing.assert_allclose(posed.joints, model, atol=1e-9)
    kept = keypoint_layout(layout)
    np.testing.assert_array_equal(kept.mirrored[kept.mirrored], np.arange(len(kept)))
    at = [i for i in range(24) if kept.at_joint(i) >= 0]
    np.testing.assert_allclose(posed.points[[kept.at_joint(i) for i in at]], model[at], atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.sampled_from(["zed38", "coco17"]), st.booleans())
@settings(max_examples=10)
def test_the_jacobian_is_that_of_small_steps(seed: int, layout: str, fits_betas: bool) -> None:
    rng = np.random.default_rng(seed)
    bones = skeleton(layout)
    pose = Pose(rng.normal(size=3), exp_so3(rng.normal(size=(24, 3))), rng.normal(size=10))
    numbers = [0, 1, 2, *(3 + 3 * bones.turning[:, None] + np.arange(3)).ravel(), *range(75, 85)]
    steps = 1e-5 * np.eye(85)[numbers if fits_betas else numbers[:-10]]
    moved = [(bones.posed(pose.moved(s)).points - bones.posed(pose.moved(-s)).points) / 2e-5 for s in steps]
    jacobian = bones.jacobian(bones.posed(pose), of_betas=fits_betas)
    np.testing.assert_allclose(jacobian, np.reshape(moved, (len(steps), -1)).T, atol=1e-7)


@given(hnp.arrays(np.float64, (4, 3), elements=st.floats(-1.8, 1.8)))
def test_exp_and_log(vectors: Array) -> None:
    np.testing.assert_allclose(exp_so3(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(log_so3(exp_so3(vectors)), Rotation.from_rotvec(vectors).as_rotvec(), atol=1e-7)


def test_half_turns_have_a_logarithm() -> None:
    turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    np.testing.assert_allclose(exp_so3(log_so3(turns)), turns, atol=1e-9)


# What must hold ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", ["zed38", "mediapipe33", "coco17"])
@pytest.mark.parametrize("name", ["walk", "reach_squat", "cmu_02_06", "cmu_03_01"])
def test_noise_of_10_mm_and_a_tenth_not_seen(layout: str, name: str) -> None:
    rng = np.random.default_rng(2)
    known, track = clip(name).frames, KeypointTracker(skeleton(layout))
    seen = [points_of(frame, layout) + rng.normal(size=(len(skeleton(layout).layout), 3)) * 0.01 for frame in known]
    holes = [np.where(rng.random(len(points))[:, None] < 0.1, np.nan, points) for points in seen]
    got = [track.update(points, frame.stamp_ns) for points, frame in zip(holes, known, strict=True)]
    assert errors(got, known).mean() <= 0.015
    assert jitter([joints_of(frame) for frame in got if frame]) <= 0.7 * jitter(seen)
    changes = np.abs(np.diff([frame.betas for frame in got if frame], axis=0)).max(axis=1)
    assert (changes[30:] > 0).sum() <= 6  # a shape that never settles would cost the pipeline every frame


def test_exact_keypoints_are_met() -> None:
    known = clip("walk").frames
    track = KeypointTracker(skeleton("zed38"), betas=known[0].betas)
    got = [track.update(points_of(frame, "zed38"), frame.stamp_ns) for frame in known]
    assert errors(got, known)[5:].mean() < 0.004


def test_arms_turn_about_themselves_as_arms_do() -> None:
    """No joint's place shows how a straight arm is turned about itself; somebody walks for ten seconds."""
    known = clip("eval_skirt_female_sequence", 300).frames
    places = np.stack([joints_of(frame)[: len(SMPL_POINTS)] for frame in known])
    got = follow(SMPL_POINTS, places, fps=30, axes="smpl", usual="smpl", worn=proportions(), notes=[])
    arms = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("shoulder", "elbow")]
    turns, truth = (
        Rotation.from_rotvec(np.concatenate(p)) for p in (got.poses[:, arms], [f.pose[arms] for f in known])
    )
    off = np.degrees((turns.inv() * truth).magnitude())
    assert off.mean() < 15
    assert np.percentile(off, 95) < 30  # 44 where a second was needed to come to rest


def about_bones(one: Skeleton, pose: Pose, limb: int, n: int) -> Pose:
    """The pose with a limb turned by 170° about its first n bones that may, each undone by the next joint."""
    joints, ends = one.chains[limb]
    bones = one.bones(pose.betas)[ends[:n]]
    about = np.tile(np.eye(3), (len(joints), 1, 1))
    about[: len(bones)] = exp_so3(np.radians(170) * bones / np.linalg.norm(bones, axis=1)[:, None])
    turns = pose.turns.copy()
    turns[joints] = turned_about_bones(turns[joints], about)
    np.testing.assert_allclose(one.posed(replace(pose, turns=turns)).points, one.posed(pose).points, atol=1e-9)
    return replace(pose, turns=turns)


@pytest.mark.parametrize("layout", ["smpl24", "coco17", "mediapipe33"])
@pytest.mark.parametrize("n_bones", [1, 3])
@pytest.mark.parametrize("limb", range(4))
def test_a_limb_that_bends_the_wrong_way_is_turned_about(layout: str, limb: int, n_bones: int) -> None:
    """A limb may have any twist while it is straight, and no small step mends it once it bends.

    Nor one that is turned about all its bones: a thigh by half a turn, knee and foot against it.
    """
    known = clip("reach_squat", 300).frames[250]  # elbows and knees are bent
    one, pose = skeleton(layout), pose_of(known)
    joint = one.chains[limb][0][0]
    track = KeypointTracker(one, betas=known.betas)
    points = one.posed(pose).points
    track.update(points, 10**9)
    begun = track._pose
    track._pose = about_bones(one, begun, limb, n_bones)
    frame = [track.update(points, 10**9 + 33_000_000 * i) for i in range(1, 6)][-1]
    assert frame is not None
    off = Rotation.from_rotvec(frame.pose[joint]).inv() * Rotation.from_matrix(begun.turns[joint])
    assert np.degrees(off.magnitude()) < 30
    off = Rotation.from_rotvec(frame.pose[joint]).inv() * Rotation.from_rotvec(known.pose[joint])
    assert np.degrees(off.magnitude()) < 60
    assert np.linalg.norm(one.posed(pose_of(frame)).points - points, axis=1).max() < 0.01
    if layout == "smpl24":
        assert errors([frame], [known]).max() < 0.01


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("limb", range(4))
def test_a_limb_may_be_turned_about_each_of_its_bones(layout: str, limb: int) -> None:
    """Thigh by half a turn, knee and foot against it: no keypoint of any layout shows that, and small steps kept it."""
    pose, one = pose_of(clip("reach_squat", 300).frames[250]), skeleton(layout)
    joints, ends = one.chains[limb]
    assert len(joints) >= 2
    assert len(ends) >= 2
    turns = about_bones(one, pose, limb, 3).turns
    ((found, back),) = twisted_wrongly(replace(pose, turns=turns), one)
    np.testing.assert_array_equal(found, joints)
    turns[joints] = turned_about_bones(turns[joints], back)
    mended = replace(pose, turns=turns)
    np.testing.assert_allclose(one.posed(mended).points, one.posed(pose).points, atol=1e-9)
    assert not twisted_wrongly(mended, one)


def test_a_turned_world_turns_the_pose_alone() -> None:
    """A camera's axes: y down, tilted, ten metres away."""
    turn = Rotation.from_euler("xyz", [160, 20, -30], degrees=True)
    plain, other = KeypointTracker(skeleton("coco17")), KeypointTracker(skeleton("coco17"))
    rng = np.random.default_rng(3)
    for frame in clip("walk").frames[:20]:
        seen = noisy(points_of(frame, "coco17"), rng)
        a, b = plain.update(seen, frame.stamp_ns), other.update(turn.apply(seen) + np.array([1, 2, 10]), frame.stamp_ns)
        assert a is not None
        assert b is not None
        np.testing.assert_allclose(a.pose[1:], b.pose[1:], atol=1e-5)
        off = Rotation.from_rotvec(b.pose[0]) * (turn * Rotation.from_rotvec(a.pose[0])).inv()
        assert off.magnitude() < 1e-5


# What trackers do -------------------------------------------------------------------------------------------------


def followed(change: Any, layout: str = "zed38", name: str = "walk") -> tuple[list[SmplFrame | None], list[SmplFrame]]:
    """A clip with 5 mm of noise whose keypoints `change(i, points)` has changed."""
    rng, known = np.random.default_rng(4), clip(name).frames
    track = KeypointTracker(skeleton(layout))
    seen = [change(i, noisy(points_of(f, layout), rng, noise=0.005, dropped=0.0)) for i, f in enumerate(known)]
    return [track.update(points, f.stamp_ns) for points, f in zip(seen, known, strict=True)], known


@pytest.mark.parametrize("group", [("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")])
def test_exchanged_sides_are_put_right(group: tuple[str, ...]) -> None:
    kept = keypoint_layout("coco17")
    these = [i for i, joint in enumerate(kept.joints) if any(part in JOINT_NAMES[joint] for part in group)]

    def change(i: int, points: Array) -> Array:
        if i in (20, 21, 22, 40):
            points[these] = points[kept.mirrored[these]]
        return points

    got, known = followed(change, "coco17")
    off = errors(got, known)
    assert off[18:45].max() < 0.12
    assert off[18:45].mean() < 0.02


@pytest.mark.parametrize("layout", ["coco17", "zed38"])
@pytest.mark.parametrize(
    "parts",
    [
        ("",),
        *(("shoulder", "elbow", "wrist", "hand"), ("elbow", "wrist", "hand"), ("wrist", "hand")),
        *(("hip", "knee", "ankle", "foot"), ("knee", "ankle", "foot"), ("ankle", "foot")),
    ],
)
def test_exchanged_sides_cost_nothing_though_a_third_is_not_seen(layout: str, parts: tuple[str, ...]) -> None:
    kept = keypoint_layout(layout)
    these = [i for i, joint in enumerate(kept.joints) if any(part in JOINT_NAMES[joint] for part in parts)]
    rng = np.random.default_rng(5)
    holes = rng.random((75, len(kept))) < 0.3

    def change(i: int, points: Array, *, is_exchanged: bool) -> Array:
        if is_exchanged and i % 30 > 20:
            points[these] = points[kept.mirrored[these]]
        points[holes[i]] = np.nan
        return points

    (got, known), (plain, _) = (
        followed(partial(change, is_exchanged=exchanged), layout, "reach_squat") for exchanged in (True, False)
    )
    assert errors(got, known).mean() < 1.15 * errors(plain, known).mean()


@pytest.mark.parametrize("layout", ["coco17", "zed38"])
def test_legs_exchanged_in_the_first_frame_are_put_right_after_a_second(layout: str) -> None:
    """Although the rest of the body fits well meanwhile."""
    kept = keypoint_layout(layout)
    exchanged = np.where(np.isin(kept.joints, (1, 2, 4, 5, 7, 8, 10, 11)), kept.mirrored, range(len(kept)))
    got, known = followed(lambda i, points: points if i else points[exchanged], layout)
    assert errors(got, known)[35:].mean(axis=1).max() < 0.012


def running(t: float) -> SmplFrame:
    """Somebody who runs at 3.5 m/s, at a time [s]."""
    phase, pose = 2 * np.pi * 1.4 * t, np.zeros((24, 3))
    pose[0] = 0.15, 0.15 * np.sin(phase), 0
    for side, sign in (("left", 1), ("right", -1)):
        at = {part: JOINT_NAMES.index(f"{side}_{part}") for part in ("hip", "knee", "shoulder", "elbow")}
        pose[at["hip"], 0] = -0.3 - 0.8 * sign * np.sin(phase)
        pose[at["knee"], 0] = 0.9 - 0.7 * sign * np.cos(phase)
        swing = Rotation.from_rotvec([0.7 * sign * np.sin(phase), 0, 0])
        pose[at["shoulder"]] = (swing * Rotation.from_rotvec([0, 0, -1.2 * sign])).as_rotvec()
        pose[at["elbow"], 1] = -1.4 * sign
    return SmplFrame(pose, transl=[0, 0.05 * np.cos(2 * phase), 3.5 * t], stamp_ns=10**9 + round(1e9 * t))


@pytest.mark.parametrize("seed", [5, 25, 40])
def test_a_runner_is_not_turned_round_by_exchanged_sides(seed: int) -> None:
    """With a third of the keypoints lost, and others far off."""
    track, rng = KeypointTracker(skeleton("coco17"), betas=np.zeros(10)), np.random.default_rng(seed)
    for i in range(90):
        frame = running(i / 30)
        seen = noisy(points_of(frame, "coco17"), rng, noise=0.02, dropped=0.3)
        off = rng.random(len(seen)) < 0.06
        seen[off] += rng.uniform(-0.3, 0.3, (int(off.sum()), 3))
        if i % 30 in range(20, 29):
            seen = seen[skeleton("coco17").layout.mirrored]
        got = track.update(seen, frame.stamp_ns)
        assert got is not None
        turned = Rotation.from_rotvec(got.pose[0]).inv() * Rotation.from_rotvec(frame.pose[0])
        assert np.degrees(turned.magnitude()) < 90


def test_an_arm_that_is_not_seen_for_long_comes_to_rest_and_comes_back() -> None:
    kept = keypoint_layout("zed38")
    arm = [i for i, joint in enumerate(kept.joints) if JOINT_NAMES[joint] in ("left_elbow", "left_wrist")]

    def change(i: int, points: Array) -> Array:
        if 20 <= i < 55:
            points[arm] = np.nan
        return points

    got, known = followed(change)
    off = errors(got, known)
    trunk = [SHOWN.index(i) for i, name in enumerate(JOINT_NAMES) if i in SHOWN and "left" not in name]
    assert off[:, trunk].mean() < 0.012
    assert off[20:55].max() < 0.6  # an arm's length: it hangs on its person
    assert off[65:].mean() < 0.015


def test_outliers_move_nobody() -> None:
    rng = np.random.default_rng(5)

    def change(i: int, points: Array) -> Array:
        if i > 5:
            points[rng.integers(len(points), size=2)] += rng.normal(size=(2, 3)) * 2
        return points

    got, known = followed(change)
    assert errors(got, known)[6:].mean() < 0.015


def test_people_come_and_go() -> None:
    known = clip("walk").frames
    track = KeypointTracker(skeleton("zed38"))
    empty = np.full((38, 3), np.nan)
    assert track.update(empty, 10**9) is None
    assert track.at(10**9) is None
    few = empty.copy()
    few[:4] = points_of(known[0], "zed38")[:4]  # a spine says nothing of where somebody faces
    assert track.update(few, 2 * 10**9) is None
    got = [track.update(points_of(frame, "zed38"), 3 * 10**9 + frame.stamp_ns) for frame in known[:10]]
    assert all(got)
    last = 3 * 10**9 + known[9].stamp_ns
    assert track.update(empty, last + 2 * 10**8) is not None  # held
    assert track.at(last + 3 * 10**8) is not None
    assert track.at(last + 10**9) is None
    assert track.update(empty, last + 8 * 10**8) is None  # gone
    far = points_of(known[20], "zed38") + np.array([5, 0, 0])
    came = track.update(far, last + 9 * 10**8)
    assert came is not None
    assert np.linalg.norm(came.transl - known[20].transl - [5, 0, 0]) < 0.1
    jumped = track.update(
        far + np.array([0, 0, 3]), last + 9 * 10**8 + 33_000_000
    )  # another person under the same name
    assert jumped is not None
    assert np.linalg.norm(jumped.transl - known[20].transl - [5, 0, 3]) < 0.1


def test_a_person_whose_keypoints_are_refused_is_nobody() -> None:
    people = People(skeleton("coco17"))
    with pytest.raises(FrameError):
        people.update("a", np.zeros((5, 3)), confidence=None, stamp_ns=1, now_ns=1)
    assert people.at(2) == {}


def test_refused_keypoints_take_nobodys_place() -> None:
    people, points = People(skeleton("coco17")), points_of(SmplFrame(np.zeros((24, 3))), "coco17")
    people.update("ann", points, confidence=None, stamp_ns=1, now_ns=1)
    for name in map(str, range(MOST_PEOPLE)):
        with pytest.raises(FrameError, match="millimetres"):
            people.update(name, 1e3 * points, confidence=None, stamp_ns=1, now_ns=1)
    people.update("bob", points, confidence=None, stamp_ns=1, now_ns=1)
    assert {*people.at(2)} == {"ann", "bob"}


def test_clocks() -> None:
    frame = clip("walk").frames[0]
    track, points = KeypointTracker(skeleton("zed38")), points_of(frame, "zed38")
    first = track.update(points, 10**10)
    again = track.update(points + 0.5, 10**10)  # a message that came twice, or late, changes nothing
    late = track.update(points + 0.5, 10**10 - 10**7)
    assert first is not None
    assert again is not None
    assert late is not None
    np.testing.assert_array_equal(first.transl, again.transl)
    np.testing.assert_array_equal(first.transl, late.transl)
    back = track.update(points + np.array([0.5, 0, 0]), 10**9)  # the sender has started again
    assert back is not None
    assert (back.stamp_ns, round(back.transl[0] - first.transl[0], 1)) == (10**9, 0.5)


def test_keypoints_that_come_late_set_no_clock_back() -> None:
    people, frame = People(skeleton("zed38")), clip("walk").frames[0]
    points = points_of(frame, "zed38")
    for late_ns in (0, 99_000_000, 0):
        people.update("ann", points, confidence=None, stamp_ns=10**10 - late_ns, now_ns=5 * 10**9)
        assert people.at(5 * 10**9)["ann"].stamp_ns == 10**10


@pytest.mark.parametrize("step", [0, -1])
def test_stamps_that_do_not_go_on_keep_nobody_where_they_were(step: int) -> None:
    people, frame = People(skeleton("zed38")), clip("walk").frames[0]
    places = []
    for i in range(60):
        now = 10**12 + i * 33_000_000
        moved = points_of(frame, "zed38") + np.array([0.02 * i, 0, 0])
        seen = people.update("ann", moved, confidence=None, stamp_ns=5 * 10**9 + step * i, now_ns=now)
        assert seen is not None
        places.append(seen.transl[0] - frame.transl[0])
    assert places[-1] == pytest.approx(0.02 * 59, abs=0.03)
    assert set(people.at(now + 10**8)) == {"ann"}


def test_a_clock_set_back_brings_nobody_back() -> None:
    people, points = People(skeleton("zed38")), points_of(clip("walk").frames[0], "zed38")
    for person, now in (("ann", 10_000), ("bob", 10_300)):
        people.update(person, points, confidence=None, stamp_ns=now * 10**9, now_ns=now * 10**9)
    assert people.at(9_000 * 10**9) == {}
    people.update("bob", points, confidence=None, stamp_ns=9_001 * 10**9, now_ns=9_001 * 10**9)
    assert set(people.at(9_001 * 10**9)) == {"bob"}


def test_an_interrupt_leaves_the_track_as_it_was() -> None:
    """It was half a step ahead: the same keypoints again gave a pose that was 40 mrad off, and so did the next ones."""
    frames = clip("walk", 16).frames
    points = [points_of(frame, "coco17") for frame in frames]

    def begun(n: int) -> KeypointTracker:
        track = KeypointTracker(skeleton("coco17"))
        for frame, seen in zip(frames[:n], points, strict=False):
            track.update(seen, frame.stamp_ns)
        return track

    for n in (0, 10):
        known, torn = begun(n + 1), begun(n)
        step = partial(torn.update, points[n], frames[n].stamp_ns)
        assert sum(1 for _ in interrupts(step, "keypoints/_tracker")) > 30
        for i in range(n + 1, n + 4):
            got, wanted = (one.update(points[i], frames[i].stamp_ns) for one in (torn, known))
            assert got is not None
            assert wanted is not None
            assert (got.pose == wanted.pose).all()


def test_predictions_at_a_steady_rate() -> None:
    """Somebody who is seen 15 times a second is where they are 60 times a second."""
    known = clip("cmu_03_01").frames
    people, off, held = People(skeleton("zed38")), [], []
    rng = np.random.default_rng(6)
    newest = None
    for i, frame in enumerate(known):
        if i % 4 == 0:
            seen = noisy(points_of(frame, "zed38"), rng)
            stamp = 7 * 10**9 + frame.stamp_ns  # of another clock
            newest = people.update("ann", seen, confidence=None, stamp_ns=stamp, now_ns=frame.stamp_ns)
        ahead = people.at(frame.stamp_ns)["ann"]
        assert newest is not None
        off.append(np.linalg.norm(joints_of(ahead) - joints_of(frame), axis=1)[SHOWN].mean())
        held.append(np.linalg.norm(joints_of(newest) - joints_of(frame), axis=1)[SHOWN].mean())
    assert np.mean(off[16:]) < 0.7 * np.mean(held[16:])
    assert people.at(known[-1].stamp_ns + 10**9) == {}


messy = st.one_of(st.floats(-3, 3), st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e300, -1e5]))


@given(
    st.lists(
        st.tuples(
            hnp.arrays(np.float64, (17, 3), elements=messy),
            hnp.arrays(np.float64, 17, elements=st.one_of(messy, st.floats(0, 100))),
            st.integers(-(10**9), 2 * 10**9),
        ),
        max_size=6,
    ),
    st.booleans(),
)
@settings(max_examples=60)
def test_whatever_comes_a_pose_is_finite(messages: list[tuple[Array, Array, int]], begun: bool) -> None:
    track, stamp = KeypointTracker(skeleton("coco17")), 10**12
    if begun:
        track.update(points_of(clip("walk").frames[0], "coco17"), stamp)
    for points, confidence, step in messages:
        stamp += step
        try:
            track.update(points, stamp, confidence=confidence)  # a SmplFrame is finite, or an error
        except FrameError as error:
            if "wanted metres" not in str(error):
                raise
        track.at(stamp + 10**8)


def test_confidence() -> None:
    points = points_of(clip("walk").frames[0], "coco17")
    wrong = points.copy()
    wrong[7] += [0, 0.5, 0]
    frames = []
    for level in (np.nan, -1.0, 0.0, 1e-9):
        confidence = np.ones(17)
        confidence[7] = level
        frames.append(KeypointTracker(skeleton("coco17")).update(wrong, 1, confidence=confidence))
        frames.append(KeypointTracker(skeleton("coco17")).update(wrong, 1, confidence=100 * confidence))
    gone = wrong.copy()
    gone[7] = np.nan
    reference = KeypointTracker(skeleton("coco17")).update(gone, 1)
    assert reference is not None
    for frame in frames:
        assert frame is not None
        np.testing.assert_allclose(frame.pose, reference.pose, atol=1e-3)
    scores = np.random.default_rng(0).uniform(0.6, 1.06, 17)
    scores[3] = 1.02  # as heat maps have them, no per cent
    assert KeypointTracker(skeleton("coco17")).update(points, 1, confidence=scores) is not None
    with pytest.raises(FrameError, match=r"wanted 17 keypoints of coco17, got \(33, 3\)"):
        KeypointTracker(skeleton("coco17")).update(np.zeros((33, 3)), 1)


def test_keypoints_in_another_unit_are_refused() -> None:
    points = points_of(clip("walk").frames[0], "zed38")
    for unit in (100, 1000):
        with pytest.raises(FrameError, match="wanted metres: does the tracker send millimetres"):
            KeypointTracker(skeleton("zed38")).update(unit * points, 1)
    points[::3] += 50.0  # some are somewhere else
    assert KeypointTracker(skeleton("zed38")).update(points, 1) is not None
    assert KeypointTracker(skeleton("zed38")).update(np.full_like(points, np.nan), 1) is None


def test_a_tracker_that_begins_with_the_sides_exchanged_is_put_right() -> None:
    """Which way somebody faces shows in noses, toes, knees and elbows, whatever is called left."""
    kept, frame = keypoint_layout("zed38"), clip("walk").frames[0]
    points = points_of(frame, "zed38")
    right = KeypointTracker(skeleton("zed38")).update(points, 1)
    got = KeypointTracker(skeleton("zed38")).update(points[kept.mirrored], 1)
    assert right is not None
    assert got is not None
    np.testing.assert_allclose(got.pose, right.pose, atol=1e-3)
