"""Files of motion that go image by image, that hold places in the place of rotations, or lengths in other units."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_recordings import POSES, TRANSL, R, T, bvh, same, save

from msg_adapters import MotionFileError, read_motion
from refu_core import load_body
from refu_core.recordings._tracks import _who_is_who
from refu_core.skeleton import JOINT_NAMES


def person(i: int, shift: float = 0.0) -> dict[str, Any]:
    body = {"global_orient": R[i, :1], "body_pose": R[i, 1:], "betas": np.full((1, 10), 0.5)}
    return body | {"transl": TRANSL[i] + [shift, 0, 0]}


def romp(i: int) -> dict[str, Any]:
    """Two people, rows of arrays, whose order changes."""
    rows = slice(None, None, 1 - 2 * (i % 2))
    poses, places = np.stack([POSES[i].reshape(72)] * 2), np.stack([TRANSL[i], TRANSL[i] + [2, 0, 0]])
    return {"smpl_thetas": poses[rows], "cam_trans": places[rows], "smpl_betas": np.zeros((2, 10))}


FRAMES: dict[str, Any] = {
    "a list of dictionaries": [person(i) for i in range(T)],
    "by the image": {f"{i:06}.png": person(i) for i in range(T)},
    "with a rate beside them": {"fps": 25.0, "results": [person(i) for i in range(T)]},
    "one deeper": [{"pred_smpl_params": person(i), "score": 0.9} for i in range(T)],
    "a list of people": [[person(i, 2.0), person(i)][:: 2 * (i % 2) - 1] for i in range(T)],
    "rows are people": {"results": {f"{i:08}.jpg": romp(i) for i in range(T)}},
    "by the person": {4: [person(i) for i in range(9)], 7: [person(i) for i in range(T)]},
}


@pytest.mark.parametrize("form", FRAMES)
def test_frames_become_a_clip(form: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(FRAMES[form]))
    has_rate = "rate" in form
    motion = read_motion(path, fps=None if has_rate else 30)
    same(motion)
    np.testing.assert_allclose(motion.transl, TRANSL)
    assert motion.fps == (25 if has_rate else 30)
    said = "; ".join(motion.notes)
    assert "frame by frame" in said
    assert ("2 persons" in said) == ("people" in form or "person" in form)


def test_people_without_names_are_told_apart_by_where_they_are() -> None:
    here, there, nowhere = np.zeros(3), np.array([2.0, 0, 0]), np.full(3, np.nan)
    seen = [[("", nowhere), ("a", here)], [("", here)], [("1", there)], [("", np.array([9.0, 0, 0]))]]
    assert list(_who_is_who(seen)) == [["0", "a"], ["a"], ["1"], ["3"]]
    assert list(_who_is_who([[("1", here)], [("", there)]])) == [["1"], ["2"]]


@settings(max_examples=40, deadline=None)
@given(
    numbers=st.one_of(
        st.lists(st.integers(-5, 60), min_size=T, max_size=T).map(np.array),
        st.sets(st.integers(0, 200), min_size=T, max_size=T).map(lambda found: np.array(sorted(found))),
        st.integers(1, T + 3).map(np.arange),
        st.just(np.arange(T) / 2),
        st.just(np.arange(T, dtype=np.uint64) + np.uint64(2**64 - 50)),
        st.just(np.arange(T) * 10**6),
    ),
    has_gap=st.booleans(),
)
def test_frames_are_where_their_numbers_say_or_it_is_told(
    numbers: NDArray[Any], has_gap: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Two tracks under one name, and frames that were lost, aren't joined in silence."""
    path = tmp_path_factory.mktemp("numbers") / "a.npz"
    poses = POSES.copy()
    poses[T // 2] = np.nan if has_gap else poses[T // 2]
    motion = read_motion(save(path, poses=poses, trans=TRANSL, frame_ids=numbers))
    said = "; ".join(motion.notes)
    rises = numbers.size == T and numbers.dtype.kind in "iu" and (numbers[1:] > numbers[:-1]).all()
    span = int(numbers[-1]) - int(numbers[0]) + 1
    if rises and span == T:
        assert "frames" not in said
        assert len(motion) == T
    elif rises and span <= 10**6 and not has_gap:
        assert f"{span - T} of {span} frames are missing: interpolated" in said
        assert len(motion) == span
    else:
        assert ("as they come" in said) or ("too fast there" in said)
        assert len(motion) == T


@pytest.mark.parametrize("person", ["7", 7])
def test_a_person_who_is_not_there_is_refused_in_a_file_of_one(tmp_path: Path, person: Any) -> None:
    (tmp_path / "a.bvh").write_text("HIERARCHY")
    for path in (save(tmp_path / "a.npz", poses=POSES), tmp_path / "a.bvh"):
        with pytest.raises(MotionFileError, match=r"no person '7'; .* one.*: leave the person out"):
            read_motion(path, person=person)
    same(read_motion(tmp_path / "a.npz", person="0"))


def test_frames_of_torch_and_of_parameters(tmp_path: Path) -> None:
    frames = [{"poses": torch.nn.Parameter(torch.tensor(POSES[i].reshape(1, 72)))} for i in range(T)]
    torch.save(frames, tmp_path / "a.pt")
    same(read_motion(tmp_path / "a.pt", fps=30))


def test_what_stands_beside_an_object_is_read(tmp_path: Path) -> None:
    """GRAB: rate and gender are arrays, the body is a dictionary that NumPy has pickled."""
    body = {"params": {"global_orient": POSES[:, 0], "body_pose": POSES[:, 1:22].reshape(T, 63), "transl": TRANSL}}
    np.savez(tmp_path / "a.npz", body=np.array(body, dtype=object), framerate=120.0, gender="female")
    motion = read_motion(tmp_path / "a.npz")
    assert (motion.fps, motion.gender) == (120.0, "female")


@pytest.mark.parametrize(("unit", "said"), [(1.0, "metres"), (1000.0, "millimetres")])
def test_places_of_joints_are_followed_and_not_taken_for_rotations(tmp_path: Path, unit: float, said: str) -> None:
    wanted = load_body("male")(POSES, transl=TRANSL).joints.numpy()
    np.save(tmp_path / "joints.npy", (unit * wanted[:, :22]).astype(np.float32))
    motion = read_motion(tmp_path / "joints.npy", fps=30)
    notes = "; ".join(motion.notes)
    assert "places of joints and no rotations" in notes
    assert f"taken as {said}" in notes
    got = load_body("neutral")(motion.poses, motion.betas[None], motion.transl.astype(np.float32)).joints.numpy()
    assert np.linalg.norm(got - wanted, axis=2)[:, :22].mean() < 0.01


def test_rotations_are_not_taken_for_places(tmp_path: Path) -> None:
    """A pose that is the same on both sides, and still, has limbs of one length, too."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = rng.normal(0, 0.3, (24, 3))
        for left, right in ((1, 2), (4, 5), (7, 8), (13, 14), (16, 17), (18, 19), (20, 21)):
            pose[right] = pose[left] * [1, -1, -1]
        motion = read_motion(save(tmp_path / "a.npz", poses=np.stack([pose] * 3)))
        np.testing.assert_allclose(motion.poses[0, 1:], pose[1:], atol=1e-6)


@pytest.mark.parametrize("unit", [100.0, 1000.0])
@pytest.mark.parametrize("moves", [False, True])
def test_translations_that_are_no_metres_are_said(tmp_path: Path, unit: float, moves: bool) -> None:
    transl = TRANSL if moves else np.tile([0.0, 0.9, 0.3], (T, 1))
    notes = read_motion(save(tmp_path / "a.npz", poses=POSES, trans=unit * transl)).notes
    assert any("divide the translation by 100 or 1000" in note for note in notes)
    assert not any("divide" in note for note in read_motion(save(tmp_path / "a.npz", poses=POSES, trans=transl)).notes)


@pytest.mark.parametrize("name", ["fps", "FPS", "frameRate", "mocap_framerate"])
def test_names_of_frame_rates(tmp_path: Path, name: str) -> None:
    arrays: dict[str, Any] = {"poses": POSES, name: 29.97}
    np.savez(tmp_path / "a.npz", **arrays)
    assert read_motion(tmp_path / "a.npz").fps == 29.97


def test_humanoid_controllers_and_meshcapade(tmp_path: Path) -> None:
    clip = {"pose_aa": POSES.reshape(T, 72), "trans_orig": TRANSL, "beta": np.ones(16), "fps": 30}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"0-walk": clip}))
    motion = read_motion(tmp_path / "a.pkl")
    same(motion)
    np.testing.assert_array_equal(motion.betas, np.ones(10))
    with (tmp_path / "a.smpl").open("wb") as file:
        np.savez(file, bodyPose=POSES[:, :22], bodyTranslation=TRANSL, shapeParameters=np.ones(10), frameRate=30.0)
    motion = read_motion(tmp_path / "a.smpl")
    same(motion, joints=22)
    np.testing.assert_allclose(motion.transl, TRANSL)
    np.testing.assert_array_equal(motion.betas, np.ones(10))


def test_files_of_other_kinds_are_named(tmp_path: Path) -> None:
    for name in ("a.json", "a.fbx"):
        (tmp_path / name).write_text("{}")
        with pytest.raises(MotionFileError, match=f"no file of motion is a {Path(name).suffix}; wanted a motion"):
            read_motion(tmp_path / name)
    np.savez(tmp_path / "SMPL_MALE.npz", v_template=np.zeros((9, 3)), J_regressor=np.zeros((24, 9)))
    with pytest.raises(MotionFileError, match="give it as --body"):
        read_motion(tmp_path / "SMPL_MALE.npz")
    ragged = [POSES[:9].reshape(9, 72), POSES.reshape(T, 72)]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"poses": ragged}))
    with pytest.raises(MotionFileError, match=r"several shapes: \(9, 72\), \(30, 72\)"):
        read_motion(tmp_path / "a.pkl")


SMPL = (
    "Pelvis L_Hip R_Hip Spine1 L_Knee R_Knee Spine2 L_Ankle R_Ankle Spine3 L_Foot R_Foot Neck L_Collar R_Collar Head "
)
SMPL += "L_Shoulder R_Shoulder L_Elbow R_Elbow L_Wrist R_Wrist L_Hand R_Hand"
MOTIVE = (
    "Hip LThigh RThigh Ab LShin RShin Chest LFoot RFoot Chest2 LToe RToe Neck LShoulder RShoulder Head LUArm RUArm "
)
MOTIVE += "LFArm RFArm LHand RHand LThumb RThumb"
KINECT = "SpineBase HipLeft HipRight SpineLow KneeLeft KneeRight SpineMid AnkleLeft AnkleRight SpineHigh FootLeft "
KINECT += "FootRight Neck ClavicleLeft ClavicleRight Head ShoulderLeft ShoulderRight ElbowLeft ElbowRight WristLeft "
KINECT += "WristRight HandLeft HandRight"
CMU = (
    "hip lfemur rfemur lowerback ltibia rtibia upperback lfoot rfoot thorax ltoes rtoes lowerneck lclavicle rclavicle "
)
CMU += "head lhumerus rhumerus lradius rradius lwrist rwrist lhand rhand"
BIPED = (
    "Bip01 Bip01|L|Thigh Bip01|R|Thigh Spine Bip01|L|Calf Bip01|R|Calf Spine1 Bip01|L|Foot Bip01|R|Foot Spine2 L|Toe0 "
)
BIPED += "R|Toe0 Neck L|Clavicle R|Clavicle Head Bip01|L|UpperArm Bip01|R|UpperArm Bip01|L|Forearm Bip01|R|Forearm "
BIPED += "Bip01|L|Hand Bip01|R|Hand L|Finger R|Finger"


@pytest.mark.parametrize("names", [SMPL, MOTIVE, KINECT, CMU, BIPED], ids=["SMPL", "Motive", "Kinect", "CMU", "biped"])
def test_skeletons_by_other_names(tmp_path: Path, names: str) -> None:
    """Each joint is where it is: an ankle isn't the ball of the foot because that is called foot."""
    text, joints = bvh([name.replace("|", " ") for name in names.split()], 100.0, n=3)
    (tmp_path / "a.bvh").write_text(text)
    motion = read_motion(tmp_path / "a.bvh")
    got = load_body("neutral")(motion.poses, motion.betas[None], motion.transl.astype(np.float32)).joints.numpy()
    limbs = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in
             ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")]  # fmt: skip
    assert np.linalg.norm(got - joints, axis=2)[:, limbs].max() < 0.02
