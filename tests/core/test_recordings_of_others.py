"""Files of motion as other people's programs lay them out, made up here in the same way."""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_recordings import POSES, TRANSL, Z_UP, T, bvh, same, turned

from msg_adapters import MotionFileError, read_motion
from refu_core import load_body
from refu_core.recordings import PELVIS
from refu_core.recordings._upright import PELVIS_OF_SMPLX

BETAS = np.linspace(-1, 1, 10)
JOINTS = load_body("male")(POSES.astype(np.float32), transl=TRANSL.astype(np.float32)).joints.double().numpy()


def pickled(path: Path, content: Any) -> Path:
    path.write_bytes(pickle.dumps(content))
    return path


def robot(n: int) -> np.ndarray[Any, Any]:
    """Rotation vectors of a robot's joints, the root first: each turns about one axis."""
    poses = np.zeros((T, n, 3))
    for joint in range(1, n):
        poses[:, joint, joint % 3] = np.sin(np.linspace(0, joint, T))
    poses[:, 0] = POSES[:, 0]
    return poses


@pytest.mark.parametrize("frame", ["world", "cam"])
def test_glamr_is_read_in_the_world_or_else_in_the_camera(tmp_path: Path, frame: str) -> None:
    """Its root's translation is where the pelvis is. Cameras' poses have a name like a person's."""
    person = {"smpl_pose": POSES[:, 1:].reshape(T, 69), "smpl_beta": np.tile(BETAS, (T, 1))}
    for name in ("cam", "world") if frame == "world" else ("cam",):
        root = POSES[:, 0] if name == frame else turned(POSES, Z_UP)[:, 0]
        place = TRANSL + PELVIS if name == frame else np.zeros((T, 3))
        person |= {f"smpl_orient_{name}": root, f"root_trans_{name}": place}
    camera = np.tile(np.eye(4), (T, 1, 1))
    motion = read_motion(pickled(tmp_path / "a.pkl", {"person_data": {0: person}, "cam_pose": camera}), fps=30)
    same(motion)
    np.testing.assert_allclose(motion.transl, TRANSL, atol=1e-9)
    np.testing.assert_allclose(motion.betas, BETAS, atol=1e-6)
    assert ("in a camera, too" in "; ".join(motion.notes)) == (frame == "world")


@pytest.mark.parametrize("is_nested", [False, True])
def test_of_like_names_the_one_of_a_pose_is_taken(tmp_path: Path, is_nested: bool) -> None:
    person = {"est_pose": POSES.reshape(T, 72), "est_trans": TRANSL}
    camera = {"cam_pose": np.tile(np.eye(4), (T, 1, 1)), "left_hand_pose": np.zeros((T, 45))}
    content = {**camera, "who": person} if is_nested else {**camera, **person}
    motion = read_motion(pickled(tmp_path / "a.pkl", content), fps=30)
    same(motion)
    np.testing.assert_allclose(motion.transl, TRANSL)


def test_errors_name_arrays_as_the_file_does(tmp_path: Path) -> None:
    np.savez(tmp_path / "a", cam_pose=np.tile(np.eye(4), (T, 1, 1)), fps=30)
    with pytest.raises(MotionFileError, match=r"cam_pose must be .* got \(30, 4, 4\)"):
        read_motion(tmp_path / "a.npz")
    np.savez(tmp_path / "a", posed_joints=np.ones((T, 34, 3)), fps=30)
    with pytest.raises(MotionFileError, match=r"posed_joints \(30, 34, 3\): no places of SMPL's joints"):
        read_motion(tmp_path / "a.npz")
    with pytest.raises(MotionFileError, match=r"motion \(30, 276\): no places of SMPL's joints"):
        read_motion(pickled(tmp_path / "a.pkl", {"motion": np.ones((T, 276))}), fps=30)
    with pytest.raises(MotionFileError, match=r"no poses; wanted .*; the file has 0-walk_poses, issue"):
        read_motion(pickled(tmp_path / "a.pkl", {"0-walk_poses": {"issue": "stool"}}), fps=30)


@pytest.mark.parametrize("n_joints", [22, 24, 27])
@pytest.mark.parametrize("name", ["pose_aa", "poses"])
def test_a_robot_is_not_taken_for_a_person(tmp_path: Path, name: str, n_joints: int) -> None:
    clip = {name: robot(n_joints), "root_trans_offset": TRANSL, "dof": np.ones((T, n_joints - 1)), "fps": 30}
    with pytest.raises(MotionFileError, match=f"{name} .30, {n_joints}, 3.: each joint turns about one axis, as a rob"):
        read_motion(pickled(tmp_path / "a.pkl", {"0-walk_poses": clip}))
    clip["smpl_joints"] = np.zeros((T, n_joints, 3)) + np.arange(3)
    with pytest.raises(MotionFileError, match=r"as a robot's do; wanted a person's|no places of SMPL's joints"):
        read_motion(pickled(tmp_path / "a.pkl", {"0-walk_poses": clip}))
    clip["smpl_joints"] = JOINTS
    motion = read_motion(pickled(tmp_path / "a.pkl", {"0-walk_poses": clip}))
    notes = "; ".join(motion.notes)
    assert f"{name} (30, {n_joints}, 3) is left out: each joint turns about one axis" in notes
    assert "smpl_joints (30, 24, 3) holds places of joints" in notes
    got = load_body("neutral")(motion.poses, motion.betas[None], motion.transl.astype(np.float32)).joints.numpy()
    assert np.linalg.norm(got - JOINTS, axis=2)[:, :22].mean() < 0.01


@pytest.mark.parametrize("name", ["dof_pos", "joint_vel", "qpos"])
def test_angles_of_a_robot_are_told_from_unknown_arrays(tmp_path: Path, name: str) -> None:
    clip = {"fps": 50, "root_pos": TRANSL, "root_rot": np.ones((T, 4)), name: np.ones((T, 29))}
    with pytest.raises(
        MotionFileError, match="the joints of robots and simulated figures aren't read: give the person"
    ):
        read_motion(pickled(tmp_path / "a.pkl", clip))
    np.savez(tmp_path / "a", **clip)
    with pytest.raises(
        MotionFileError, match="the joints of robots and simulated figures aren't read: give the person"
    ):
        read_motion(tmp_path / "a.npz")


def test_a_place_of_the_pelvis_is_no_translation_of_the_mesh(tmp_path: Path) -> None:
    clip = {"pose_aa": POSES, "root_trans_offset": TRANSL + PELVIS, "fps": 30}
    np.testing.assert_allclose(read_motion(pickled(tmp_path / "a.pkl", clip)).transl, TRANSL, atol=1e-9)


def test_a_spine_whose_joints_are_elsewhere_is_still_a_persons(tmp_path: Path) -> None:
    """Large betas, as those that fit a robot, move the joints of the trunk along it."""
    joints = JOINTS[:, :22].copy()
    for joint, share in ((3, 0.1), (6, 0.3), (9, 0.4)):
        joints[:, joint] = joints[:, 0] + share * (joints[:, 12] - joints[:, 0])
    np.savez(tmp_path / "a", joints=joints, fps=30)
    assert "holds places of joints" in "; ".join(read_motion(tmp_path / "a.npz").notes)


def test_a_tensor_alone(tmp_path: Path) -> None:
    torch.save(torch.tensor(POSES), tmp_path / "a.pt")
    same(read_motion(tmp_path / "a.pt", fps=30))
    same(read_motion(pickled(tmp_path / "a.pkl", POSES), fps=30))


AZURE = "PELVIS HIP_LEFT HIP_RIGHT SPINE_NAVAL KNEE_LEFT KNEE_RIGHT SPINE_CHEST ANKLE_LEFT ANKLE_RIGHT SPINE_TOP "
AZURE += (
    "FOOT_LEFT FOOT_RIGHT NECK CLAVICLE_LEFT CLAVICLE_RIGHT HEAD SHOULDER_LEFT SHOULDER_RIGHT ELBOW_LEFT ELBOW_RIGHT "
)
AZURE += "WRIST_LEFT WRIST_RIGHT HAND_LEFT HAND_RIGHT"


def test_bvh_of_azure_kinect_in_capitals(tmp_path: Path) -> None:
    (tmp_path / "a.bvh").write_text(bvh(AZURE.split(), 100.0, n=2)[0])
    notes = "; ".join(read_motion(tmp_path / "a.bvh").notes)
    assert "is fitted by the positions of 18" in notes
    assert "not found" not in notes


def test_words_of_bvh_in_any_case(tmp_path: Path) -> None:
    text = bvh(AZURE.split(), 100.0, n=2)[0]
    (tmp_path / "a.bvh").write_text(text)
    (tmp_path / "b.bvh").write_text(
        text.replace("ROOT", "Root").replace("JOINT", "joint").replace("End Site", "END SITE")
    )
    one, other = (read_motion(tmp_path / name) for name in ("a.bvh", "b.bvh"))
    np.testing.assert_array_equal(one.poses, other.poses)


def test_bvh_with_helpers(tmp_path: Path) -> None:
    """MoDi and others put a joint before a limb, which bears the names of both."""
    (tmp_path / "a.bvh").write_text(bvh(AZURE.split(), 100.0, n=2)[0])
    names = AZURE.replace("CLAVICLE_", "SPINE_SHOULDER_")
    (tmp_path / "b.bvh").write_text(bvh(names.split(), 100.0, n=2)[0])
    one, other = (read_motion(tmp_path / name) for name in ("a.bvh", "b.bvh"))
    np.testing.assert_array_equal(one.poses, other.poses)


def test_bvh_of_limbs_that_end_without_a_name(tmp_path: Path) -> None:
    text, joints = bvh(AZURE.split(), 100.0, n=3)
    head, _, motion = text.partition("MOTION")
    order = re.findall(r"(?:ROOT|JOINT) (\S+)", head)
    gone = [order.index(name) for name in ("WRIST_LEFT", "HAND_LEFT")]
    wrist = r"JOINT WRIST_LEFT\n{\n(OFFSET .*)\nCHANNELS.*\nJOINT HAND_LEFT\n{[^{}]*{[^{}]*}\n}\n}"
    head, n = re.subn(wrist, r"End Site\n{\n\1\n}", head)
    assert n == 1
    rows = [line.split() for line in motion.splitlines()[3:]]
    rows = [[*row[:3], *(row[3 + i] for i in range(3 * 24) if i // 3 not in gone)] for row in rows]
    start = motion.splitlines()[:3]
    (tmp_path / "a.bvh").write_text("\n".join([f"{head}MOTION", *start[1:], *(" ".join(row) for row in rows)]))
    motion_read = read_motion(tmp_path / "a.bvh")
    assert "is fitted by the positions of 18" in "; ".join(motion_read.notes)
    body = load_body("neutral")
    got = body(motion_read.poses, motion_read.betas[None], motion_read.transl.astype(np.float32)).joints.numpy()
    assert np.linalg.norm(got - joints, axis=2)[:, 20].max() < 0.02


def test_bvh_whose_frames_were_never_counted(tmp_path: Path) -> None:
    text = bvh(AZURE.split(), 100.0, n=3)[0]
    (tmp_path / "a.bvh").write_text(text.replace("Frames: 3", "Frames: 0"))
    assert len(read_motion(tmp_path / "a.bvh")) == 3


def test_places_of_another_skeleton_are_not_taken_for_rotations(tmp_path: Path) -> None:
    """As LAFAN's, 22 joints in an order of their own, all within what radians may be."""
    order = np.random.default_rng(0).permutation(22)
    for name, array in (("a", JOINTS[:, order]), ("b", JOINTS[:, order].reshape(T, 66))):
        np.save(tmp_path / name, array)
        with pytest.raises(MotionFileError, match="holds places of joints, in another order than SMPL's: save them as"):
            read_motion(tmp_path / f"{name}.npy", fps=30)


def test_joints_that_turn_alike_are_no_places(tmp_path: Path) -> None:
    np.save(tmp_path / "a", np.tile(np.sin(np.arange(T) / 9)[:, None, None] * [0.2, 0.1, 0.0], (1, 24, 1)))
    assert "no betas" in "; ".join(read_motion(tmp_path / "a.npy", fps=30).notes)


def test_names_of_places(tmp_path: Path) -> None:
    np.savez(tmp_path / "a", global_joint_positions=JOINTS[:, :22], height=1.8)
    notes = "; ".join(read_motion(tmp_path / "a.npz", fps=30).notes)
    assert "global_joint_positions (30, 22, 3) holds places of joints" in notes


@pytest.mark.parametrize("turns", [(130, 133, 80, 249, 186, 78, 207, 314), (8, -132, 32, 56, -111, -19, 144, 174)])
def test_somebody_who_turns_at_cuts_is_not_wound_up(tmp_path: Path, turns: tuple[float, ...]) -> None:
    """A spine that is wound up has its ends where one that isn't has them, and used to stay so."""
    about = [Rotation.from_euler("y", angle, degrees=True) for angle in (*turns, *[turns[-1]] * 8)]
    after = np.stack([turn.apply(JOINTS[0] - JOINTS[0, 0]) + JOINTS[0, 0] for turn in about])
    np.savez(tmp_path / "a", joints=np.concatenate((JOINTS[:5], after)), fps=30)
    poses = read_motion(tmp_path / "a.npz").poses
    assert np.linalg.norm(poses[-1, [3, 6, 9]], axis=1).sum() < 0.5


def test_jumps_of_followed_people_are_told(tmp_path: Path) -> None:
    joints = JOINTS.copy()
    joints[T // 2 :] += [0, 0, 30]
    np.savez(tmp_path / "a", joints=joints, fps=30)
    assert "the person jumps by 30.0 m after frame 14" in "; ".join(read_motion(tmp_path / "a.npz").notes)
    way = np.arange(T)[:, None, None] * [0.0, 0.0, 1.0]
    np.savez(tmp_path / "a", joints=JOINTS + 100 + 3 * way, fps=30)
    assert "m/s: is it 30 frames a second?" in "; ".join(read_motion(tmp_path / "a.npz").notes)
    np.savez(tmp_path / "a", joints=JOINTS + 100, fps=30)
    assert "the origin" not in "; ".join(read_motion(tmp_path / "a.npz").notes)


@pytest.mark.parametrize("n", [66, 72])
@pytest.mark.parametrize("is_first", [False, True])
def test_a_translation_in_a_poses_array_is_told_apart(tmp_path: Path, n: int, is_first: bool) -> None:
    """Without that, 69 columns were taken for a body without its root."""
    pose = POSES.reshape(T, 72)[:, :n]
    np.save(tmp_path / "a", np.concatenate((TRANSL, pose) if is_first else (pose, TRANSL), axis=1))
    motion = read_motion(tmp_path / "a.npy", fps=30)
    same(motion, joints=22)
    np.testing.assert_allclose(motion.transl, TRANSL)
    assert "of a translation" in "; ".join(motion.notes)


def test_a_body_without_a_root_and_a_name(tmp_path: Path) -> None:
    np.save(tmp_path / "a", POSES[:, 1:].reshape(T, 69))
    same(read_motion(tmp_path / "a.npy", fps=30), root=False)
    for still in (np.zeros((T, 69)), np.full((T, 69), np.nan)):
        np.save(tmp_path / "a", still)
        with pytest.raises(MotionFileError, match=r"may be 3 columns of a translation .* save them apart"):
            read_motion(tmp_path / "a.npy", fps=30)


@pytest.mark.parametrize(("number", "gender"), [(0, "neutral"), (1, "male"), (2, "female")])
def test_meshcapade_numbers_genders_and_bodies(tmp_path: Path, number: int, gender: str) -> None:
    """Its second body is SMPL-X, whose pelvis is lower."""
    arrays = {"bodyPose": POSES[:, :22], "bodyTranslation": TRANSL, "frameRate": np.float32(24)}
    with (tmp_path / "a.smpl").open("wb") as file:
        np.savez(file, smplVersion=np.int32(2), gender=np.int32(number), **arrays)
    motion = read_motion(tmp_path / "a.smpl")
    assert (motion.gender, motion.fps) == (gender, 24)
    np.testing.assert_allclose(motion.transl, TRANSL + PELVIS_OF_SMPLX - PELVIS, atol=1e-9)
    notes = "; ".join(motion.notes)
    assert "SMPL-X's mesh has its pelvis 13 cm lower" in notes
    assert "like names" not in notes
