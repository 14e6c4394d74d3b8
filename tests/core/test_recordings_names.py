"""Files of motion whose arrays have other names, whose root is apart, or whose numbers are packed in another way."""

from __future__ import annotations

import bz2
import lzma
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_recordings import POSES, TRANSL, T, same

from msg_adapters import MotionFileError, read_motion
from refu_core import load_body
from refu_core.keypoints import Proportions
from refu_core.recordings import PELVIS
from refu_core.recordings._upright import PELVIS_OF_SMPLX

BETAS = np.linspace(-1, 1, 10)


@pytest.mark.parametrize("form", ["npz", "pickle"])
@pytest.mark.parametrize(
    "names",
    [
        ("smpl_global_orient", "smpl_body_pose", "smpl_transl", "smpl_betas"),
        ("globalOrient", "bodyPose", "transl", "Betas"),
        ("Root_Orient", "Pose_Body", "Trans", "betas"),
        ("gt_root_orient", "gt_pose_body", "gt_root_transl", "gt_shape"),
    ],
)
def test_names_that_are_spelled_otherwise(form: str, names: tuple[str, str, str, str], tmp_path: Path) -> None:
    values = (POSES[:, 0], POSES[:, 1:].reshape(T, 69), TRANSL, BETAS)
    content: dict[str, Any] = {**dict(zip(names, values, strict=True)), "joints": np.zeros((T, 24, 3)), "fps": 25.0}
    if form == "npz":
        np.savez(tmp_path / "a", **content)
    else:
        (tmp_path / "a.npz").write_bytes(pickle.dumps({"results": content}))
        (tmp_path / "a.npz").rename(tmp_path / "a.pkl")
    motion = read_motion(tmp_path / ("a.npz" if form == "npz" else "a.pkl"))
    same(motion)
    np.testing.assert_allclose(motion.transl, TRANSL)
    np.testing.assert_allclose(motion.betas, BETAS, atol=1e-6)
    assert motion.fps == 25
    assert any(note.startswith("taken by like names: ") and names[0] in note for note in motion.notes)


def test_a_root_that_may_be_one_is_not_left_out(tmp_path: Path) -> None:
    np.savez(tmp_path / "a", pose_body=POSES[:, 1:22], root_rot=POSES[:, 0], fps=30)
    with pytest.raises(MotionFileError, match="pose_body has no root, and root_rot may be it: save it as root_orient"):
        read_motion(tmp_path / "a.npz")


def test_an_error_names_what_the_file_has(tmp_path: Path) -> None:
    np.savez(tmp_path / "a", rotations=POSES, root_positions=TRANSL, fps=30)
    with pytest.raises(MotionFileError, match="the file has rotations, root_positions, fps"):
        read_motion(tmp_path / "a.npz")


@pytest.mark.parametrize("n_joints", [23, 24])
def test_easymocap_turns_people_about_the_origin(n_joints: int, tmp_path: Path) -> None:
    """Its vertices are those of a body without a root, turned by Rh and moved by Th."""
    poses = POSES.copy()
    poses[:, 0] = 0
    file = {"Rh": POSES[:, 0], "Th": TRANSL, "poses": poses[:, 24 - n_joints :].reshape(T, -1), "shapes": BETAS[None]}
    np.savez(tmp_path / "a", **file)
    motion = read_motion(tmp_path / "a.npz", fps=30)
    same(motion)
    np.testing.assert_allclose(motion.betas, BETAS, atol=1e-6)
    body = load_body("neutral")
    upright = body(poses.astype(np.float32), BETAS[None].astype(np.float32)).vertices.double().numpy()
    wanted = np.stack([Rotation.from_rotvec(r).apply(v) for r, v in zip(POSES[:, 0], upright, strict=True)])
    wanted += TRANSL[:, None]
    got = body(motion.poses, motion.betas[None], motion.transl.astype(np.float32)).vertices.double().numpy()
    assert np.linalg.norm(got - wanted, axis=2).max() < 0.01  # the pelvis of any betas is within 5 mm of one place


@pytest.mark.parametrize("kind", ["GVHMR", "Motion-X", "AMASS", "EasyMocap"])
def test_people_of_smplx_are_where_its_pelvis_is(kind: str, tmp_path: Path) -> None:
    """In its mesh that is lower: a translation moves another point of the body."""
    body = {"global_orient": POSES[:, 0], "body_pose": POSES[:, 1:22].reshape(T, 63), "transl": TRANSL, "betas": BETAS}
    flat, file = POSES[:, :22].reshape(T, 66), tmp_path / "a.npz"
    if kind == "GVHMR":
        file = tmp_path / "a.pkl"
        file.write_bytes(pickle.dumps({"smpl_params_global": body}))
    elif kind == "Motion-X":
        file = tmp_path / "a.npy"
        np.save(file, np.hstack([flat, np.zeros((T, 243)), TRANSL, np.tile(BETAS, (T, 1))]))
    elif kind == "AMASS":
        np.savez(file, poses=np.pad(flat, ((0, 0), (0, 99))), trans=TRANSL, betas=BETAS)
    else:
        poses = np.pad(flat[:, 3:], ((0, 0), (3, 99)))
        np.savez(file, Rh=POSES[:, 0], Th=TRANSL, poses=poses, shapes=BETAS[None], surface_model_type="smplx")
    motion = read_motion(file, fps=30)
    at = PELVIS_OF_SMPLX if kind != "EasyMocap" else Rotation.from_rotvec(POSES[:, 0]).apply(PELVIS_OF_SMPLX)
    np.testing.assert_allclose(motion.transl + PELVIS, TRANSL + at, atol=1e-6)
    assert "betas are SMPL-X's" in "; ".join(motion.notes)
    assert "SMPL-X's mesh has its pelvis 13 cm lower" in "; ".join(motion.notes)
    male = Proportions.builtin("male")
    own = read_motion(file, fps=30, worn=Proportions(male.joints - [0, 0.13, 0], male.shapedirs))  # is SMPL-X's, too
    assert "lower" not in "; ".join(own.notes)
    if kind != "EasyMocap":
        np.testing.assert_allclose(own.transl, TRANSL, atol=1e-12)


def test_two_roots_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a", Rh=POSES[:, 0], Th=TRANSL, poses=POSES.reshape(T, 72), fps=30)
    with pytest.raises(MotionFileError, match="poses has a root of its own beside Rh; wanted zeros there, or no Rh"):
        read_motion(tmp_path / "a.npz")


def tensors() -> dict[str, Any]:
    whole = torch.tensor(POSES.reshape(T, 72))
    body = {"global_orient": whole[:, :3], "body_pose": whole[:, 3:].float(), "transl": torch.tensor(TRANSL)}
    return {"smpl": body, "fps": 25}


def write_tensors(path: Path, how: str) -> None:
    content = tensors()
    match how:
        case "pickled":
            path.write_bytes(pickle.dumps(content))
        case "torch before 1.6":
            torch.save(content, path, _use_new_zipfile_serialization=False)
        case "bz2":
            path.write_bytes(bz2.compress(pickle.dumps(content)))
        case "xz":
            path.write_bytes(lzma.compress(pickle.dumps(content)))


@pytest.mark.parametrize("how", ["pickled", "torch before 1.6", "bz2", "xz"])
def test_tensors_by_other_ways(how: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    write_tensors(path, how)
    motion = read_motion(path)
    same(motion)
    np.testing.assert_allclose(motion.transl, TRANSL)
    data = path.read_bytes()
    for cut in range(0, len(data) - 1, max(1, len(data) // 40)):
        path.write_bytes(data[:cut])
        with pytest.raises(MotionFileError):
            read_motion(path)


def test_places_under_a_name(tmp_path: Path) -> None:
    joints = load_body("male")(POSES.astype(np.float32), transl=TRANSL.astype(np.float32)).joints.double().numpy()
    np.savez(tmp_path / "a", joints=100 * joints, fps=30)
    assert "taken as centimetres" in "; ".join(read_motion(tmp_path / "a.npz").notes)
    np.savez(tmp_path / "a", joints=np.random.default_rng(0).normal(size=joints.shape), fps=30)
    with pytest.raises(MotionFileError, match=r"joints .* no places of SMPL's joints"):
        read_motion(tmp_path / "a.npz")
    samples = np.stack([joints[:, :22], joints[:, :22] + [1, 0, 0]]).transpose(0, 2, 3, 1)  # as MDM leaves them
    np.save(tmp_path / "results", {"motion": samples, "text": ["walks", "runs"]}, allow_pickle=True)
    first, second = (read_motion(tmp_path / "results.npy", fps=20, person=person) for person in ("0", "1"))
    assert len(first) == T
    np.testing.assert_allclose(second.transl - first.transl, np.tile([1.0, 0, 0], (T, 1)), atol=1e-6)
    samples[1, :, :, T // 2 :] = 0  # padding
    np.save(tmp_path / "results", {"motion": samples, "lengths": np.array([T, T // 2])}, allow_pickle=True)
    second = read_motion(tmp_path / "results.npy", fps=20, person="1")
    assert len(second) == T // 2
    np.save(tmp_path / "results", {"motion": samples}, allow_pickle=True)
    with pytest.raises(MotionFileError, match=r"motion .* no places of SMPL's joints"):
        read_motion(tmp_path / "results.npy", fps=20, person="1")


def test_places_are_fitted_to_the_body_that_is_worn(tmp_path: Path) -> None:
    body, betas = load_body("male"), torch.tensor([[-2.0, *[0.0] * 9]])
    poses = torch.from_numpy(POSES.astype(np.float32))
    joints = body(poses, betas.expand(T, 10), transl=torch.from_numpy(TRANSL).float()).joints.double().numpy()
    np.savez(tmp_path / "a", joints=joints, fps=30)
    motion = read_motion(tmp_path / "a.npz", worn=Proportions.of_body(body), axes="smpl")
    assert motion.is_fitted
    fitted = body(
        torch.tensor(motion.poses),
        torch.tensor(motion.betas).expand(T, 10),
        transl=torch.from_numpy(motion.transl).float(),
    )
    off = np.linalg.norm(fitted.joints.double().numpy() - joints, axis=-1)
    assert off.mean() < 0.01
    assert not read_motion(tmp_path / "a.npz").is_fitted


def test_roots_turn_about_the_pelvis_of_the_body_that_is_worn(tmp_path: Path) -> None:
    arrays = load_body("male")
    low = Proportions(Proportions.of_body(arrays).joints - [0, 1.1, 0], Proportions.of_body(arrays).shapedirs)
    np.savez(tmp_path / "a", poses=POSES, trans=TRANSL, mocap_framerate=30.0)
    as_it_is, turned = (read_motion(tmp_path / "a.npz", worn=low, axes=axes) for axes in ("frame", "z-up"))
    places = [motion.transl + low.of(motion.betas.astype(np.float64))[0] for motion in (as_it_is, turned)]
    np.testing.assert_allclose(places[0], places[1][:, [2, 0, 1]], atol=1e-9)


def test_a_rate_that_is_text(tmp_path: Path) -> None:
    np.savez(tmp_path / "a", poses=POSES, mocap_framerate="29.97")
    assert read_motion(tmp_path / "a.npz").fps == 29.97


def test_one_frame_of_smplx_without_an_axis_of_time(tmp_path: Path) -> None:
    """SMPLer-X: one file per person and image."""
    np.savez(tmp_path / "a", global_orient=POSES[:1, 0], body_pose=POSES[0, 1:22], transl=TRANSL[0], betas=BETAS)
    motion = read_motion(tmp_path / "a.npz", fps=30)
    np.testing.assert_allclose(motion.transl[0] + PELVIS, TRANSL[0] + PELVIS_OF_SMPLX, atol=1e-6)
    assert "betas are SMPL-X's" in "; ".join(motion.notes)


def test_betas_of_smplx_on_a_body_of_smplx_are_its_own(tmp_path: Path) -> None:
    wide = np.pad(POSES[:, :22].reshape(T, 66), ((0, 0), (0, 99)))
    np.savez(tmp_path / "a", poses=wide, trans=TRANSL, betas=BETAS, fps=30)
    male = Proportions.builtin("male")
    own = read_motion(tmp_path / "a.npz", worn=Proportions(male.joints - [0, 0.13, 0], male.shapedirs))
    assert "SMPL-X" not in "; ".join(own.notes)
    assert "betas are SMPL-X's" in "; ".join(read_motion(tmp_path / "a.npz").notes)


def test_rate_and_gender_that_stand_elsewhere(tmp_path: Path) -> None:
    """MoSh's are among what it tells about its work."""
    wide, told = np.pad(POSES[:, :22].reshape(T, 66), ((0, 0), (0, 99))), {"type": "smplx", "gender": "female"}
    work: dict[str, Any] = {"mocap_frame_rate": 100.0, "cfg": {"surface_model": told}}
    content: dict[str, Any] = {"fullpose": wide, "trans": TRANSL, "stageii_debug_details": work}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    motion = read_motion(tmp_path / "a.pkl")
    assert (motion.fps, motion.gender) == (100, "female")
    assert "mocap_frame_rate of stageii_debug_details counts for the motion" in motion.notes
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content | {"video": {"fps": 25.0}}))
    with pytest.raises(MotionFileError, match="no frame rate in the file"):
        read_motion(tmp_path / "a.pkl")
    body = {"poses": POSES, "trans": TRANSL}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"first": body | {"gender": "male"}, "second": dict(body), "fps": 9}))
    assert read_motion(tmp_path / "a.pkl", person="second").gender == "neutral"


@pytest.mark.parametrize("name", ["smpl_betas", "betas"])
def test_a_child_is_not_left_out_in_silence(name: str, tmp_path: Path) -> None:
    poses = "smpl_thetas" if name == "smpl_betas" else "poses"
    for age in (0.0, 0.9):
        np.savez(tmp_path / "a", **{poses: POSES.reshape(T, 72), name: np.tile([*BETAS, age], (T, 1)), "fps": 30})
        motion = read_motion(tmp_path / "a.npz")
        is_said = "the eleventh beta, a child's share of the shape (0.9), is left out" in "; ".join(motion.notes)
        assert is_said == (name == "smpl_betas" and age > 0)
        np.testing.assert_allclose(motion.betas, BETAS, atol=1e-6)


def test_what_a_network_gave_is_not_another_person(tmp_path: Path) -> None:
    def body(*axes: int) -> dict[str, Any]:
        arrays = {"global_orient": POSES[:, 0], "body_pose": POSES[:, 1:22].reshape(T, 63), "transl": TRANSL}
        return {name: array.reshape(*axes, *array.shape) for name, array in arrays.items()}

    content = {"smpl_params_global": body(), "net_outputs": {"pred_smpl_params_global": body(1)}}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    motion = read_motion(tmp_path / "a.pkl", fps=30)
    assert len(motion) == T
    said = "; ".join(motion.notes)
    assert "left out as another version of the same motion: net_outputs/pred_smpl_params_global" in said
    assert "persons" not in said
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"one": body(1), "two": body()}))
    assert "2 persons: one (30 frames), two (30 frames)" in "; ".join(read_motion(tmp_path / "a.pkl", fps=30).notes)


@pytest.mark.parametrize(
    ("name", "shape", "said"),
    [
        ("body_pose", (1, 32), "VPoser's latent pose: save what VPoser decodes it to"),
        ("poses", (T, 33, 3), "keypoints: publish them, or use KeypointTracker"),
        ("poses", (T, 17, 3), "keypoints: publish them, or use KeypointTracker"),
        ("poses", (T, 75), "3 of a translation: save them apart, as poses and trans"),
        ("poses", (T, 82), "10 of a shape: save them apart, as poses and betas"),
        ("poses", (T, 85), "10 of a shape (VIBE): save the latter two apart, as poses and betas"),
    ],
)
def test_arrays_that_hold_something_else_say_what_to_do(
    name: str, shape: tuple[int, ...], said: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "a", **{name: np.full(shape, 0.1)}, fps=30)
    with pytest.raises(MotionFileError) as told:
        read_motion(tmp_path / "a.npz")
    assert said in str(told.value)
    if name == "poses":
        np.save(tmp_path / "a", np.full(shape, 0.1))
        with pytest.raises(MotionFileError) as told:
            read_motion(tmp_path / "a.npy", fps=30)
        assert said in str(told.value)
