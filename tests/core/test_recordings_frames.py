"""Files of motion that go image by image, that hold places in the place of rotations, or lengths in other units."""

from __future__ import annotations

import pickle
from collections.abc import Callable
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
from tests.limits import run_limited


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


@pytest.mark.parametrize("whole", [int, np.int64])
@pytest.mark.parametrize("name", ["frame", "img_name"])
def test_one_dictionary_per_person_and_frame(whole: Callable[[int], Any], name: str, tmp_path: Path) -> None:
    """Trackers' own numbers tell people and lost frames, not where a dictionary is in the list."""
    kept = [i for i in range(T) if i not in (10, 11)]
    number = (lambda i: f"clip/{i:06}.jpg") if name == "img_name" else whole
    people = [person(i, x) | {"track_id": whole(int(x)), name: number(i)} for i in kept for x in (3.0, 0.0)]
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(people))
    for x in (0, 3):
        motion = read_motion(tmp_path / "a.pkl", fps=30, person=str(x))
        assert len(motion) == T
        assert "2 of 30 frames are missing: interpolated" in motion.notes
        np.testing.assert_allclose(motion.transl[kept], TRANSL[kept] + [x, 0, 0])


def test_a_list_too_long_to_read_says_how_to_save_it(tmp_path: Path) -> None:
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([person(0)] + [{"frame": i} for i in range(300_000)]))
    with pytest.raises(MotionFileError, match="too many values: save one array for all frames"):
        read_motion(tmp_path / "a.pkl", fps=30)


ODD_ROWS: dict[str, dict[str, Any]] = {
    "an infinite number of a person": romp(0) | {"track_ids": np.array([np.inf, 1.0])},
    "the same beside bodies": {"smpl": [person(0)], "tid": np.array([np.inf])},
    "a pose that is a number": {"smpl_thetas": np.ones(())},
}


@pytest.mark.parametrize("form", ODD_ROWS)
def test_odd_rows_of_an_image_are_refused(form: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({f"{i}.jpg": ODD_ROWS[form] for i in range(3)}))
    with pytest.raises(
        MotionFileError, match="smpl_thetas must be" if "pose" in form else "people's numbers must be whole"
    ):
        read_motion(path, fps=30)


def test_ten_people_of_one_shape_keep_their_names(tmp_path: Path) -> None:
    """A shape's ten numbers are no numbers of ten people."""
    poses = np.zeros((10, 72)) + 0.1
    row = {"smpl_thetas": poses, "smpl_betas": np.arange(10.0), "track_ids": np.arange(10, 20)}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({f"{i}.jpg": row for i in range(T)}))
    assert len(read_motion(tmp_path / "a.pkl", fps=30, person="17")) == T


def test_people_without_names_are_told_apart_by_where_they_are() -> None:
    here, there, nowhere = np.zeros(3), np.array([2.0, 0, 0]), np.full(3, np.nan)
    seen = [[("", nowhere), ("a", here)], [("", here)], [("1", there)], [("", np.array([9.0, 0, 0]))]]
    assert list(_who_is_who(seen)) == [["0", "a"], ["a"], ["1"], ["3"]]
    assert list(_who_is_who([[("1", here)], [("", there)]])) == [["1"], ["2"]]


# Tables -----------------------------------------------------------------------------------------------------------

AWAY = np.array([2.5, 0, 0])


def table(order: NDArray[np.int64], **columns: Any) -> dict[str, Any]:
    """Rows of two people, T each: the first one's, then the second one's, who is 2.5 m away; in another order."""
    arrays = {"pose": np.concatenate([POSES, POSES[::-1]]).reshape(2 * T, 72), "trans": np.concatenate([TRANSL] * 2)}
    arrays["trans"][T:] += AWAY
    arrays["betas"] = np.repeat([np.full(10, 0.5), np.full(10, -0.5)], T, axis=0)
    return {name: np.asarray(array)[order] for name, array in (arrays | columns).items()}


def images(frames: Any, folder: str = "seq") -> list[str]:
    return [f"{folder}/{folder}_{i:04}.png" for i in frames]


TWICE = np.tile(np.arange(T), 2)
COLUMNS: dict[str, dict[str, Any]] = {
    "CoMotion": {"id": np.repeat([1, 2], T), "frame_idx": TWICE},
    "BEDLAM": {"sub": ["1"] * T + ["2"] * T, "imgname": images(TWICE), "gender": ["male"] * T + ["female"] * T},
    "one a folder": {"imgname": images(range(T), "1") + images(range(T), "2")},
    "no number": {"track_ids": np.repeat([[1], [2]], T, axis=0)},
}
ORDERS = {
    "grouped": np.arange(2 * T),
    "interleaved": np.arange(2 * T).reshape(2, T).T.reshape(-1),
    "any": np.random.default_rng(0).permutation(2 * T),
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("form", COLUMNS)
@pytest.mark.parametrize("kind", ["npz", "torch", "pickle"])
def test_rows_of_several_people_are_told_apart(kind: str, form: str, order: str, tmp_path: Path) -> None:
    if form == "no number" and order == "any":
        return
    arrays = table(ORDERS[order], **COLUMNS[form])
    path = tmp_path / ("a.npz" if kind == "npz" else "a.pt" if kind == "torch" else "a.pkl")
    if kind == "npz":
        np.savez(path, **arrays)
    elif kind == "torch":
        torch.save({name: array.tolist() if array.dtype.kind == "U" else torch.tensor(array) for name, array in
                    arrays.items()}, path)  # fmt: skip
    else:
        path.write_bytes(pickle.dumps({"results": {**arrays, "fps": 30.0}}))
    before = "results/" if kind == "pickle" and form in ("BEDLAM", "one a folder") else ""
    first, second = (read_motion(path, fps=30, person=before + person) for person in ("1", "2"))
    same(first)
    np.testing.assert_allclose(first.transl, TRANSL, atol=1e-6)
    np.testing.assert_allclose(second.transl, TRANSL + AWAY, atol=1e-6)
    np.testing.assert_allclose(second.poses, POSES[::-1], atol=1e-6)
    assert (first.betas[0], second.betas[0]) == (0.5, -0.5)
    assert second.gender == ("female" if form == "BEDLAM" else "neutral")
    said = "; ".join(read_motion(path, fps=30).notes)
    assert "the rows are 2 persons', told apart by their" in said
    assert f"2 persons: {before}" in said
    assert not any(word in said for word in ("jumps", "m/s", "missing", "betas differ"))


def test_rows_of_one_image_are_followed_by_their_places(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", **table(ORDERS["interleaved"], imgname=images(TWICE)))
    motion = read_motion(path)
    same(motion)
    assert "2 persons: 0 (30 frames), 1 (30 frames)" in "; ".join(motion.notes)


def test_rows_that_nothing_tells_apart_are_said_to_jump(tmp_path: Path) -> None:
    for order, said in (
        ("interleaved", "jumps to and fro by 2.5 m"),
        ("grouped", f"jumps by 2.7 m after frame {T - 1}"),
    ):
        notes = "; ".join(read_motion(save(tmp_path / "a.npz", **table(ORDERS[order]))).notes)
        assert f"the person {said}: several people's rows?" in notes
        assert "divide" not in notes


def test_columns_that_tell_nobody_apart_change_nothing(tmp_path: Path) -> None:
    """A number for each row, a count of frames, pictures, one person's images."""
    wanted = read_motion(save(tmp_path / "a.npz", poses=POSES, trans=TRANSL))
    for columns in (
        {"id": np.arange(T)},
        {"frames": T},
        {"frames": np.zeros((T, 40, 30, 3), np.uint8)},
        {"frames": np.array([object()] * T)},
        {"sub": "rp_a", "imgname": images(range(5, 5 + T))},
        {"sub": ["rp_a"] * T, "image_path": ["a.png"] * T},
        {"track_id": np.arange(T + 1)},
    ):
        motion = read_motion(save(tmp_path / "a.npz", poses=POSES, trans=TRANSL, **columns))
        assert motion.notes == wanted.notes
        np.testing.assert_array_equal(motion.poses, wanted.poses)


def test_lost_frames_by_numbers_that_a_table_of_text_gave(tmp_path: Path) -> None:
    kept = np.delete(np.arange(T), [10, 11])
    arrays = {"poses": POSES[kept], "trans": TRANSL[kept]}
    motion = read_motion(save(tmp_path / "a.npz", **arrays, frame_ids=kept.astype(float)))
    assert "2 of 30 frames are missing: interpolated" in motion.notes
    tracks = {"poses": np.tile(POSES, (2, 1, 1)), "trans": np.tile(TRANSL, (2, 1)), "sub": ["a"] * T + ["b"] * T}
    motion = read_motion(save(tmp_path / "a.npz", **tracks, frame_ids=np.tile(np.arange(T), 2) / 1.0), person="b")
    np.testing.assert_array_equal(motion.transl, TRANSL)


@pytest.mark.parametrize("name", ["frame_ids", "frame_idx", "frame", "frames", "imgname"])
@pytest.mark.parametrize("above", [False, True])
def test_lost_frames_by_any_name(name: str, above: bool, tmp_path: Path) -> None:
    """TRAM's `frame`, CoMotion's `frame_idx`; PromptHMR's `frames`, which stand above the pose."""
    kept = np.delete(np.arange(T), [10, 11])
    numbers: Any = images(kept) if name == "imgname" else kept
    body = {"pred_rotmat": R[kept], "pred_trans": TRANSL[kept, None]}
    if above and name == "imgname":
        return
    content: dict[str, Any] = {name: numbers, "world": body} if above else {**body, name: numbers}
    np.save(tmp_path / "a.npy", content)  # type: ignore[arg-type]
    motion = read_motion(tmp_path / "a.npy", fps=30)
    assert "2 of 30 frames are missing: interpolated" in motion.notes
    np.testing.assert_allclose(motion.transl[kept], TRANSL[kept])


def test_numbers_that_are_time_stamps_fill_nothing(tmp_path: Path) -> None:
    motion = read_motion(save(tmp_path / "a.npz", poses=POSES, trans=TRANSL, frame_idx=33_000 * np.arange(T)))
    assert len(motion) == T
    assert "at most 3000 for 30 frames are read" in "; ".join(motion.notes)


def test_many_tables_are_refused_in_time(tmp_path: Path) -> None:
    one = {"poses": np.zeros((20_000, 72), np.float32), "id": np.arange(20_000) % 2}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps([dict(one) for _ in range(1000)]))
    assert "tables of more than 300000 rows" in run_limited(lambda: read_motion(tmp_path / "a.pkl", fps=30)).error
    inner: Any = {"smpl_poses": np.zeros((4, 72)), "id": [1, 1, 2, 2]}
    for _ in range(4):
        inner = {str(i): inner for i in range(300)}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(inner))
    assert not run_limited(lambda: read_motion(tmp_path / "a.pkl", fps=30)).error  # one mapping, seen from many sides


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


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("name", [None, "frames", "poses"])
def test_an_array_that_holds_itself_is_no_motion(n: int, name: str | None, tmp_path: Path) -> None:
    held = np.empty(n, object)
    held[:] = [held] * n
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(held if name is None else {name: held}))
    with pytest.raises(MotionFileError, match=r"no poses; wanted|an array of objects|several shapes"):
        read_motion(tmp_path / "a.pkl", fps=30.0)


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

SOMA = "Hips LeftLeg RightLeg Spine1 LeftShin RightShin Spine2 LeftFoot RightFoot Chest LeftToeBase RightToeBase Neck1 "
SOMA += "LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand LI RI"
DEEPMOTION = "hips l_upleg r_upleg spine l_leg r_leg spine1 l_foot r_foot spine2 l_toebase r_toebase neck l_shoulder "
DEEPMOTION += "r_shoulder head l_arm r_arm l_forearm r_forearm l_hand r_hand l_index r_index"
DEEPMOTION = " ".join(f"{name}_JNT" for name in DEEPMOTION.split())
THEIA = "pelvis l_thigh r_thigh abdomen l_shank r_shank torso l_foot r_foot torso2 l_toes r_toes neck l_shoulder "
THEIA += "r_shoulder head l_uarm r_uarm l_larm r_larm l_hand r_hand l_thumb r_thumb"
VRM = "C_Hips L_UpperLeg R_UpperLeg C_Spine L_LowerLeg R_LowerLeg C_Chest L_Foot R_Foot C_UpperChest L_ToeBase "
VRM += "R_ToeBase C_Neck L_Shoulder R_Shoulder C_Head L_UpperArm R_UpperArm L_LowerArm R_LowerArm L_Hand R_Hand LI RI"
VRM = " ".join(f"J_Bip_{name}" for name in VRM.split())
MAYA = "Root_M Hip_L Hip_R Spine1_M Knee_L Knee_R Spine2_M Ankle_L Ankle_R Chest_M Toes_L Toes_R Neck_M Scapula_L "
MAYA += "Scapula_R Head_M Shoulder_L Shoulder_R Elbow_L Elbow_R Wrist_L Wrist_R Thumb_L Thumb_R"
AVERAGE = " ".join(f"m_avg_{name}" for name in SMPL.split())
MAKEHUMAN = "root upperleg01.L upperleg01.R spine05 lowerleg01.L lowerleg01.R spine03 foot.L foot.R spine01 toe2-1.L "
MAKEHUMAN += "toe2-1.R neck01 clavicle.L clavicle.R head upperarm01.L upperarm01.R lowerarm01.L lowerarm01.R wrist.L "
MAKEHUMAN += "wrist.R finger.L finger.R"
ICLONE = "Hip L_Thigh R_Thigh Waist L_Calf R_Calf Spine01 L_Foot R_Foot Spine02 L_ToeBase R_ToeBase NeckTwist01 "
ICLONE += "L_Clavicle R_Clavicle Head L_Upperarm R_Upperarm L_Forearm R_Forearm L_Hand R_Hand L_Index R_Index"
ICLONE = " ".join(f"CC_Base_{name}" for name in ICLONE.split())
BY_NAME = {"SOMA": SOMA, "DeepMotion": DEEPMOTION, "Theia": THEIA, "VRM": VRM, "Maya": MAYA, "m_avg": AVERAGE}
BY_NAME |= {"MakeHuman": MAKEHUMAN, "iClone": ICLONE, "biped": BIPED}


@pytest.mark.parametrize("tool", BY_NAME)
def test_all_points_of_a_skeleton_are_found(tool: str, tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(bvh([name.replace("|", "_") for name in BY_NAME[tool].split()], 100.0, n=1)[0])
    notes = "; ".join(read_motion(tmp_path / "a.bvh").notes)
    assert "is fitted by the positions of 18" in notes  # all, and the top of the head
    assert "not found" not in notes


def test_points_of_a_skeleton_that_are_not_found_are_named(tmp_path: Path) -> None:
    """Rigify's: a spine has no names; its root is known as the pelvis, since both legs hang on it."""
    names = "spine thigh.L thigh.R spine.001 shin.L shin.R spine.002 foot.L foot.R spine.003 toe.L toe.R spine.004 "
    names += "shoulder.L shoulder.R spine.006 upper_arm.L upper_arm.R forearm.L forearm.R hand.L hand.R index.L index.R"
    (tmp_path / "a.bvh").write_text(bvh(names.split(), 100.0, n=1)[0])
    notes = "; ".join(read_motion(tmp_path / "a.bvh").notes)
    assert "by the positions of 15; not found by their names: neck, head" in notes


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
