"""Points that a tracker has elsewhere than SMPL has its joints: a person made of such points stands upright."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from msg_adapters import read_motion
from refu_core import SmplFrame
from refu_core.keypoints import KeypointTracker, Proportions, Skeleton, keypoint_layout
from refu_core.keypoints._pose import Pose, Posed, exp_so3

Array = NDArray[np.float64]
SPINE, NECK = [0, 3, 6, 9], [12, 15]
LIMBS = [4, 5, 7, 8, 16, 17, 18, 19, 20, 21]


def between(a: Array, b: Array, share: float) -> Array:
    return a + share * (b - a)


def somebody(*, face_back: float = 0.0) -> dict[str, Array]:
    """Points [m] of a person of 1.8 m who stands upright, arms hanging, as cameras see them."""
    left = {
        "hip": (0.1, 0.93, 0.0),
        "knee": (0.1, 0.49, 0.01),
        "ankle": (0.1, 0.08, -0.02),
        "foot": (0.11, 0.02, 0.11),
        "heel": (0.1, 0.02, -0.07),
        "big_toe": (0.09, 0.02, 0.17),
        "small_toe": (0.15, 0.02, 0.13),
        "shoulder": (0.19, 1.47, 0.0),
        "elbow": (0.23, 1.19, -0.01),
        "wrist": (0.24, 0.94, 0.05),
        "hand": (0.24, 0.87, 0.07),
        "handtip": (0.24, 0.76, 0.08),
        "thumb": (0.2, 0.83, 0.1),
        "index": (0.22, 0.83, 0.1),
        "pinky": (0.24, 0.84, 0.03),
        "eye": (0.03, 1.71, 0.1),
        "ear": (0.08, 1.69, 0.0),
        "mouth": (0.03, 1.63, 0.11),
    }
    points = {f"l_{name}": np.array(place) for name, place in left.items()}
    points |= {f"r_{name}": np.array(place) * (-1, 1, 1) for name, place in left.items()}
    points |= {"nose": np.array((0, 1.67, 0.13)), "top": np.array((0, 1.8, 0.02))}
    for name in ("nose", "l_eye", "r_eye", "l_ear", "r_ear"):
        points[name] = points[name] - (0, 0, face_back)
    hips, shoulders = (between(points[f"l_{a}"], points[f"r_{a}"], 0.5) for a in ("hip", "shoulder"))
    return points | {"hips": hips, "shoulders": shoulders, "-": np.full(3, np.nan)}


def named(words: str, points: dict[str, Array]) -> Array:
    return np.array([points[word] for word in words.split()])


FACE = "nose l_eye r_eye l_ear r_ear "
COCO = FACE + "l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_hip r_hip l_knee r_knee l_ankle r_ankle"
ARM = "shoulder elbow wrist hand handtip thumb"
LEG = "hip knee ankle foot"


def sided(side: str, words: str) -> str:
    return " ".join(f"{side}_{word}" for word in words.split())


def seen_by(layout: str) -> Array:
    """The person's keypoints, made as the tracker makes them, shape (K, 3)."""
    p = somebody(face_back=0.12 if layout == "zed34" else 0.0)
    low, high = p["hips"], p["shoulders"]
    if layout in ("zed34", "kinect32"):
        extra = {"neck": high, "low": between(low, high, 1 / 3), "mid": between(low, high, 2 / 3)}
        extra |= {f"{s}_collar": between(high, p[f"{s}_shoulder"], 0.3) for s in "lr"}
        extra["head"] = between(high, p["nose"], 0.6)
        if layout == "kinect32":
            extra |= {"neck": np.array((0, 1.54, -0.02)), "head": np.array((0, 1.62, -0.02))}
            extra |= {"low": np.array((0, 1.13, 0.005)), "mid": np.array((0, 1.3, 0.013))}
            extra |= {f"{s}_collar": np.array((sign * 0.03, 1.5, -0.02)) for s, sign in (("l", 1), ("r", -1))}
        words = f"hips low mid neck l_collar {sided('l', ARM)} r_collar {sided('r', ARM)} {sided('l', LEG)} "
        words += f"{sided('r', LEG)} head nose l_eye l_ear r_eye r_ear"
        return named(words + (" l_heel r_heel" if layout == "zed34" else ""), p | extra)
    words = {
        "coco17": COCO,
        "zed18": f"nose shoulders {sided('r', 'shoulder elbow wrist')} {sided('l', 'shoulder elbow wrist')} "
        f"{sided('r', 'hip knee ankle')} {sided('l', 'hip knee ankle')} r_eye l_eye r_ear l_ear",
        "body25": f"nose shoulders {sided('r', 'shoulder elbow wrist')} {sided('l', 'shoulder elbow wrist')} hips "
        f"{sided('r', 'hip knee ankle')} {sided('l', 'hip knee ankle')} r_eye l_eye r_ear l_ear "
        f"{sided('l', 'big_toe small_toe heel')} {sided('r', 'big_toe small_toe heel')}",
        "halpe26": f"{COCO} top shoulders hips l_big_toe r_big_toe l_small_toe r_small_toe l_heel r_heel",
        "mediapipe33": "nose l_eye l_eye l_eye r_eye r_eye r_eye l_ear r_ear l_mouth r_mouth l_shoulder r_shoulder "
        "l_elbow r_elbow l_wrist r_wrist l_pinky r_pinky l_index r_index l_thumb r_thumb l_hip r_hip l_knee r_knee "
        "l_ankle r_ankle l_heel r_heel l_big_toe r_big_toe",
        "h36m17": f"hips {sided('r', 'hip knee ankle')} {sided('l', 'hip knee ankle')} spine thorax face crown "
        f"{sided('l', 'shoulder elbow wrist')} {sided('r', 'shoulder elbow wrist')}",
    }[layout]
    of_h36m = {"spine": between(low, high, 0.6), "thorax": np.array((0, 1.57, 0.02))}
    of_h36m |= {"face": np.array((0, 1.62, 0.11)), "crown": np.array((0, 1.77, 0.06))}
    return named(words, p | of_h36m)


def posed(skeleton: Skeleton, frame: SmplFrame) -> Posed:
    betas = frame.betas.astype(np.float64)
    pelvis = frame.transl + skeleton.proportions.of(betas)[0]
    return skeleton.posed(Pose(pelvis, exp_so3(frame.pose.astype(np.float64)), betas))


def tilts(turns: Array) -> Array:
    """How far forward each joint is turned [degrees], of somebody who faces z, shape (24,)."""
    return np.degrees(np.arctan2(turns[:, 2, 1], turns[:, 1, 1]))


@pytest.mark.parametrize("body", ["neutral", "male"])
@pytest.mark.parametrize(
    "layout", ["zed34", "zed18", "kinect32", "body25", "halpe26", "coco17", "mediapipe33", "h36m17"]
)
def test_somebody_who_stands_is_upright(layout: str, body: str) -> None:
    skeleton = Skeleton(keypoint_layout(layout), Proportions.builtin(body))
    track, seen, rng = KeypointTracker(skeleton), seen_by(layout), np.random.default_rng(0)
    for i in range(60):
        frame = track.update(seen + rng.normal(size=seen.shape) * 0.005, 10**9 + i * 33_333_333)
    assert frame is not None
    found = posed(skeleton, frame)
    tilt = tilts(found.turns)
    off = np.linalg.norm(found.points - seen, axis=1)[np.isin(skeleton.layout.joints, LIMBS)]
    assert np.abs(tilt[SPINE]).max() < 16
    assert np.abs(tilt[NECK]).max() < 24
    assert np.abs(frame.betas).max() < 2
    assert off.max() < 0.05


def test_points_that_a_tracker_makes_from_others_say_nothing() -> None:
    layout = keypoint_layout("zed34")
    seen = seen_by("zed34")
    moved = seen + np.where(layout.is_told, 0.0, 0.2)[:, None]
    plain, other = (KeypointTracker(Skeleton(layout, Proportions.builtin("male"))).update(p, 1) for p in (seen, moved))
    assert (~layout.is_told).sum() == 6  # two on the spine, three between the shoulders, and the head
    assert plain is not None
    assert other is not None
    np.testing.assert_array_equal(plain.pose, other.pose)


@pytest.mark.parametrize("layout", ["zed34", "kinect32", "h36m17"])
def test_the_jacobian_of_points_beside_joints_is_that_of_small_steps(layout: str) -> None:
    rng = np.random.default_rng(1)
    bones = Skeleton(keypoint_layout(layout), Proportions.builtin("male"))
    pose = Pose(rng.normal(size=3), exp_so3(rng.normal(size=(24, 3))), rng.normal(size=10))
    numbers = [0, 1, 2, *(3 + 3 * bones.turning[:, None] + np.arange(3)).ravel(), *range(75, 85)]
    steps = 1e-5 * np.eye(85)[numbers]
    moved = [(bones.posed(pose.moved(s)).points - bones.posed(pose.moved(-s)).points) / 2e-5 for s in steps]
    jacobian = bones.jacobian(bones.posed(pose), of_betas=True)
    np.testing.assert_allclose(jacobian, np.reshape(moved, (len(steps), -1)).T, atol=1e-7)


SMPL = (
    "0 0 0, 7 -9 -1, -7 -9 -1, 0 11 -3, 10 -47 -1, -10 -47 -1, 0 24 -3, 9 -87 -5, -9 -87 -5, 0 30 0, 12 -92 7, "
    "-12 -92 7, 0 51 -4, 8 42 -4, -8 42 -4, 0 58 1, 17 45 -5, -17 45 -5, 43 44 -7, -43 44 -7, 68 44 -7, -68 44 -7"
)
"""About where SMPL's mean shape has its joints [cm]."""


def test_joints_of_smpl_stand_as_upright_on_a_built_in_body(tmp_path: Path) -> None:
    """Its spine has other places for them: its head is 38° in front of its neck, the built-in bodies' 19°."""
    joints = np.array([place.split() for place in SMPL.split(",")], np.float64) / 100 + np.array((0, 0.94, 0))
    np.save(tmp_path / "joints.npy", np.repeat(joints[None], 30, axis=0))
    motion = read_motion(tmp_path / "joints.npy", fps=20, axes="smpl")
    skeleton = Skeleton(keypoint_layout("smpl24"), Proportions.builtin("neutral"))
    tilt = tilts(posed(skeleton, motion.frame(29)).turns)
    assert np.abs(tilt[SPINE + NECK]).max() < 12
    assert np.abs(motion.betas).max() < 1
