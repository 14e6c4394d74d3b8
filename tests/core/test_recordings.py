"""Files of motion, as archives and estimators write them: each read as what it is, or refused with what to do."""

from __future__ import annotations

import base64
import collections
import pickle
import zlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from msg_adapters import Motion, MotionFileError, iter_smpl_frames, read_motion
from refu_core import load_body
from refu_core.recordings import Axes, axis_of, upright_turn
from refu_core.simulation import SimulationError, load_clips
from refu_core.skeleton import JOINT_NAMES, PARENTS
from tests.limits import refusal, run_limited

ROOT = Path(__file__).parents[2]
T = 30
Z_UP = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # y up to z up: (x, y, z) to (z, x, y)
CAMERA = Rotation.from_euler("x", 180, degrees=True)
Z_DOWN = Rotation.from_euler("x", -90, degrees=True)
LYING = Rotation.from_euler("z", -90, degrees=True)


@cache
def walk() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (T, 24, 3) and translations (T, 3) of a person who walks."""
    frames = [record.frame for record in iter_smpl_frames(ROOT / "bags" / "walk")][:T]
    poses = np.array([frame.pose for frame in frames if frame], np.float64)
    return poses, np.array([frame.transl for frame in frames if frame])


def turned(poses: NDArray[np.float64], turn: Rotation) -> NDArray[np.float64]:
    roots = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return np.concatenate([roots[:, None], poses[:, 1:]], axis=1)


def matrices(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(-1, 24, 3, 3)


def save(path: Path, **arrays: Any) -> Path:
    np.savez(path, **{"fps": 30.0} | arrays)
    return path


def same(motion: Motion, *, joints: int = 24, root: bool = True) -> None:
    got, wanted = matrices(motion.poses.astype(np.float64)), matrices(walk()[0])
    first = 0 if root else 1
    np.testing.assert_allclose(got[:, first:joints], wanted[:, first:joints], atol=2e-4)


POSES, TRANSL = walk()
R = matrices(POSES)
FORMS: dict[str, tuple[dict[str, Any], str]] = {
    "72 columns": ({"poses": POSES.reshape(T, 72)}, ""),
    "24 x 3": ({"poses": POSES}, ""),
    "matrices": ({"poses": R.astype(np.float32)}, "rotation matrices"),
    "216 columns": ({"pred_thetas": R.reshape(T, 216)}, "rotation matrices"),
    "6D, rows": ({"poses": R[:, :, :2].reshape(T, 24, 6)}, "first two rows"),
    "6D, columns": ({"poses": R[..., :2].swapaxes(2, 3).reshape(T, 144)}, "first two columns"),
    "6D, interleaved": ({"poses": R[..., :2].reshape(T, 24, 6)}, "interleaved"),
    "a root and a body": ({"global_orient": R[:, :1], "body_pose": R[:, 1:]}, "rotation matrices"),
    "root_orient, pose_body": ({"root_orient": POSES[:, 0], "pose_body": POSES[:, 1:22].reshape(T, 63)}, ""),
    "66 columns": ({"poses": POSES[:, :22].reshape(T, 66)}, ""),
    "SMPL-H": ({"poses": np.pad(POSES[:, :22].reshape(T, 66), ((0, 0), (0, 90)))}, ""),
    "SMPL-X": ({"fullpose": 0, "poses": np.pad(POSES[:, :22].reshape(T, 66), ((0, 0), (0, 99)))}, ""),
    "EMDB": ({"poses_root": POSES[:, 0], "poses_body": POSES[:, 1:].reshape(T, 69)}, ""),
    "AIST++": ({"smpl_poses": POSES.reshape(T, 72), "smpl_trans": 90 * TRANSL, "smpl_scaling": [90.0]}, "divided"),
    "AIST++, halved": ({"smpl_poses": POSES, "smpl_trans": 8 * TRANSL, "smpl_scaling": np.full(1, 8, "f2")}, "divided"),
    "MDM, time last": ({"thetas": np.moveaxis(R[:, :, :2].reshape(T, 24, 6), 0, -1)}, "first two rows"),
    "groups": ({"smpl_params_global/poses": POSES, "smpl_params_incam/poses": turned(POSES, CAMERA)}, "in the world"),
    "ROMP": ({"results": {"smpl_thetas": POSES.reshape(T, 72), "cam_trans": TRANSL}}, ""),
    "two persons": (
        {"root_orient": np.stack([POSES[:, 0]] * 2), "pose_body": np.stack([POSES[:, 1:22].reshape(T, 63)] * 2)},
        "2 persons: 0, 1; 0 is taken",
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_forms(tmp_path: Path, form: str) -> None:
    arrays, note = FORMS[form]
    motion = read_motion(save(tmp_path / "a.npz", **arrays), fps=30)
    same(motion, joints=22)
    assert note in "; ".join(motion.notes)
    if "smpl_trans" in arrays or "results" in arrays:
        np.testing.assert_allclose(motion.transl, TRANSL)
    else:
        assert "no translation" in "; ".join(motion.notes)


@pytest.mark.parametrize(
    ("axes", "turn", "note"),
    [
        ("z-up", Z_UP, "+z: taken as z up"),
        ("y-down", CAMERA, "-y: taken as y down"),
        ("z-down", Z_DOWN, "-z: taken as z down"),
    ],
)
def test_axes_are_seen_and_said(tmp_path: Path, axes: Axes, turn: Rotation, note: str) -> None:
    body = load_body("male", dtype=torch.float64)
    path = save(tmp_path / "a.npz", poses=turned(POSES, turn), trans=TRANSL, betas=np.ones(10))
    motion, left = read_motion(path), read_motion(path, axes="frame")
    same(motion)
    assert any(note in line for line in motion.notes)
    assert left.notes == ()
    np.testing.assert_allclose(upright_turn(left.poses[:, 0].astype(float)), turn.inv().as_matrix(), atol=1e-12)
    # The person is where the file has them, turned: the same way for every vertex of every frame.
    ours, theirs = (body(m.poses, np.ones((1, 10)), m.transl).vertices.numpy() for m in (motion, left))
    np.testing.assert_allclose(ours, turn.inv().apply(theirs.reshape(-1, 3)).reshape(ours.shape), atol=6e-3)
    (clip,) = load_clips(path)
    np.testing.assert_array_equal(clip.poses, motion.poses)
    explicit = read_motion(path, axes=axes)
    np.testing.assert_array_equal(explicit.poses, motion.poses)
    assert explicit.notes == ()


def test_who_lies_is_never_silent(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", poses=turned(POSES, LYING), trans=TRANSL, betas=np.zeros(10))
    assert any("lies along +x" in note for note in read_motion(path).notes)
    assert any("upright in 0 %" in note for note in read_motion(path, axes="smpl").notes)
    tilted = turned(POSES, Rotation.from_euler("x", 40, degrees=True))
    assert any("leans by" in note for note in read_motion(save(path, poses=tilted, trans=TRANSL)).notes)
    assert axis_of(np.random.default_rng(0).normal(size=(500, 3)) * 3) == ""


@given(st.integers(0, 2**31), st.sampled_from([3, 9, 6]))
def test_any_rotation_comes_back(seed: int, size: int) -> None:
    from refu_core.recordings._rotations import rotvecs_of

    turns = Rotation.random(24 * 3, random_state=seed)
    r = turns.as_matrix().reshape(3, 24, 3, 3)
    array = {3: turns.as_rotvec().reshape(3, 24, 3), 9: r, 6: r[..., :2].reshape(3, 24, 6)}[size]
    got, n = rotvecs_of(array, "poses", (24,), [], has_root=True)
    assert n == 24
    np.testing.assert_allclose(matrices(got), r, atol=1e-6)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"poses": np.degrees(POSES)}, r"as long as \d+ in most frames, wanted radians.*np.radians"),
        ({"poses": np.ones((T, 24, 4))}, r"quaternions.*Rotation.from_quat"),
        ({"poses": R * 1.2}, "joint 0 in frame 0 isn't a rotation"),
        ({"poses": R * [1, 1, -1]}, r"joint 0 in frame 0 mirrors \(determinant -1"),
        ({"poses": np.ones((T, 24, 6))}, "aren't two rows or columns"),
        ({"poses": POSES[:, :20]}, r"n = 24 \| 22 \| 52 .* joints, got \(30, 20, 3\)"),
        ({"global_orient": POSES[:, 0], "body_pose": np.zeros((T, 32))}, r"body_pose must be .* got \(30, 32\)"),
        ({"global_orient": POSES[:9, 0], "body_pose": POSES[:, 1:]}, "global_orient has 9 frames, body_pose 30"),
        ({"poses": POSES, "fps": None}, "no frame rate in the file: say it, as in --fps 30"),
        ({"poses": POSES, "betas": np.zeros((4, 10))}, "betas must be one row of .*, or a row for each of 30"),
        ({"verts": np.zeros((T, 9, 3))}, "no poses; wanted pose_world, .*; the file has"),
        ({"mhr_model_params": np.zeros((T, 204))}, "MHR .* aren't read: save pred_keypoints_3d"),
        ({"motion_feats": np.zeros((T, 263))}, "HumanML3D features aren't read: fit SMPL"),
        ({"poses": POSES, "betas": np.full((T, 10), np.inf)}, "betas has values that are NaN or infinite"),
        ({"smpl_poses": POSES, "smpl_scaling": []}, "smpl_scaling must be a number in .*, got"),
        ({"smpl_poses": POSES, "smpl_trans": TRANSL, "smpl_scaling": [0.0]}, "smpl_scaling must be a number in"),
    ],
)  # fmt: skip
def test_what_is_refused_says_what_to_do(tmp_path: Path, arrays: dict[str, Any], said: str) -> None:
    arrays = {"fps": 30.0} | arrays
    np.savez(tmp_path / "a.npz", **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(MotionFileError, match=said):
        read_motion(tmp_path / "a.npz")
    with pytest.raises(SimulationError, match=said):
        load_clips(tmp_path / "a.npz")


def test_a_person_has_one_shape(tmp_path: Path) -> None:
    betas = np.random.default_rng(0).normal(size=(T, 16))
    motion = read_motion(save(tmp_path / "a.npz", poses=POSES, betas=betas, gender="b'female'"))
    np.testing.assert_allclose(motion.betas, np.median(betas, axis=0)[:10], atol=1e-6)
    assert motion.gender == "female"
    assert any("betas differ by up to" in note for note in motion.notes)
    wide = np.pad(POSES[:, :22].reshape(T, 66), ((0, 0), (0, 99)))
    assert any("SMPL-X's" in note for note in read_motion(save(tmp_path / "b.npz", poses=wide, betas=betas)).notes)


# Pickles ----------------------------------------------------------------------------------------------------------


class Foreign:
    """Of a package that isn't there when the file is read."""

    def __init__(self, **content: Any) -> None:
        self.__dict__ |= content


def wham() -> dict[Any, Any]:
    persons: dict[Any, Any] = collections.defaultdict(dict)
    for key, n in ((np.int64(3), 20), (8, T)):
        row = {"pose": turned(POSES, CAMERA)[:n].reshape(n, 72), "trans": TRANSL[:n], "verts": np.zeros((n, 5, 3))}
        world = {"pose_world": POSES[:n].reshape(n, 72), "trans_world": TRANSL[:n], "betas": np.zeros((n, 10))}
        persons[key] = row | world | {"frame_ids": np.arange(n)}
    return persons


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("packed", [False, True])
def test_several_persons_in_a_pickle(tmp_path: Path, protocol: int, packed: bool) -> None:
    content = pickle.dumps(wham() | {"tracker": Foreign(a=1)} if protocol > 1 else wham(), protocol)
    (tmp_path / "a.pkl").write_bytes(zlib.compress(content) if packed else content)
    motion = read_motion(tmp_path / "a.pkl", fps=30)
    same(motion)
    np.testing.assert_array_equal(motion.transl, TRANSL)
    said = "; ".join(motion.notes)
    assert "2 persons: 3 (20 frames), 8 (30 frames); 8 is taken (--person chooses another)" in said
    assert "in a camera, too: the one in the world is taken" in said
    assert len(read_motion(tmp_path / "a.pkl", fps=30, person="3")) == 20
    with pytest.raises(MotionFileError, match="no person '7'; the file has 3"):
        read_motion(tmp_path / "a.pkl", fps=30, person="7")


def test_objects_of_packages_that_are_not_there(tmp_path: Path) -> None:
    held = Foreign(poses=POSES, trans=TRANSL)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"smpl": held}).replace(b"test_recordings", b"nobody_has_this"))
    same(read_motion(tmp_path / "a.pkl", fps=30))


def test_nothing_in_a_pickle_is_executed(tmp_path: Path) -> None:
    target = tmp_path / "owned"
    content = b"cos\nsystem\n(X" + len(f"touch {target}").to_bytes(4, "little") + f"touch {target}".encode() + b"tR."
    (tmp_path / "a.pkl").write_bytes(content)
    assert "no poses" in refusal(lambda: read_motion(tmp_path / "a.pkl"))
    assert not target.exists()
    shared = b"}U\x05poses" + b"N" + b"2\x86" * 60 + b"s."  # a tuple of 2⁶⁰ leaves, all shared
    rows = b"](" + b"K\x01" * 999 + b"eq\x01"
    wide = b"}U\x05poses](" + (b"](" + rows + b"h\x01" * 999 + b"eq\x02") + b"h\x02" * 999 + b"es."  # 10⁹ leaves
    for content in (
        shared,
        wide,
        b"N" * 1_100_000 + b".",
        b"(" * 1_100_000 + b".",
        b"ca\nb\n" * 1_100_000 + b".",
        b"]" * 90_000 + b"a" * 89_999 + b".",
    ):
        (tmp_path / "a.pkl").write_bytes(content)
        assert run_limited(lambda: read_motion(tmp_path / "a.pkl")).error
    (tmp_path / "a.pkl").write_bytes(zlib.compress(bytes(300 << 20), 1))
    assert "unpacks to more" in run_limited(lambda: read_motion(tmp_path / "a.pkl")).error


JOBLIB = (  # what joblib 1.6 makes of {7: {pose (2, 72), trans, betas, frame_ids [3, 4], names of objects}}
    "c-pO$e{2(F7{~i-UDplRh5_RuBMdU8u5$^7Vc+LPsS47iLnZ!5!0xWSc{i`Ua(5LQC9o{rkL<{@>@A857+og85Mq{PS;#_=OrvBFH5jsxWiiXL7$ra^QG*"
    "LU*REwaMgQ>q<L=(~o*$p@`#$e;$dPKcTGGQP3@NfKgmg)XYRo7M3r$>H*27XrXT8jD@o`DkCG(eKVJ*pCWX7s!JQ7QIf+0l}JP~w|I925m%y4QUPUck8H!p32"
    "@35YT3FeATs$-oU?HFLA-)>k53j_i?@8C#3{1%<@K39GQ%);8x?f~0pIAV$>Fk@x2!pjoxNk<LFq|lo(u9gJM>C<NNS5z(*6U@|AEon!W7Ux4Ur)f+qH1eb2"
    "45CS<i5wF7ZT=l?I8)Rxx*1kqj#XS{*qS!oWfe=7k{WJKmX-a%NQ8^A4x=o?mCh05Wa*7)M2PA^KA{U5^B2c?_nq7@<te4DPb#H$?<alFc=6lozS581W8Q6zGd"
    "Q=CQGF$GU#TFkZrMc8hWs+Wn`~<oNcZ_TL3?t<*M&B{WO|?v?fOZr>lE4!k%P^nXg@|Sj*p|yWl~l%iGDLg?74=%x5)6^Jo?+g_GmsF@fAYVo)v((VAtW*"
    "Fg;KP`_GmG=7r<eE1}l)7<{qzaX<$6`Gq<-*i4|b^(jCe*fO*OE{@kj<IFBVHfUe<8kE)Sh11(PKu-AnZ3)Dl2>fw!A0RVSTus36+yU6&Yysqlku^zVXovdE"
    "oygGzQw@iar5iM{2YGtI*^)x0_uzx0N0F-!st1oD+lTP^g^!T0A9ha<Ama&`y?qinPr*A6oJQ8qV0rZ*@(#hr&kiH=2t4un8RQ;?uirY0?B`%l_j%+WgBvHl"
    "L=9g->$wZ4V;ojbTtY41z^6CALp_%Plc1&v_;%e@)HMlV?-XkL0e*XF8uiUUmpqFae}wYnPpI=63?93VT5rO0!*i(j7EE0F6*d13k=fg*dmiw}=?15j?kuuV"
    "+<)5ppo5OA$)l6&ofOZ4R@S;`{pJF?58M>bg`Ro7h)y*uqmGxCQ#>OY;ESmymeBX3r8L#Ba7T<hUFGm{iVtN<UVK<A7uRB4+uNA9POK2urz^Sc{*^3Nb%>9c"
    "C7QpeJ}s6TTmS1jRh{GE1)cjF9(RtXGMBC3p8N2Bj#N#Sr=UsYB0^9KFJ($*iHeu#w=cLmvhnWjcND|jCl>B@!#zFj-M{p>t?B*l%;Y<im+H<&{>P456jX%}"
    "HfLRpXL@qBuP*9neoK=1tUSx4wWfjWiyQC1Lv`-Oj%npsK){J7u6h0hgDF#5"
)


def test_joblib(tmp_path: Path) -> None:
    (tmp_path / "a.pkl").write_bytes(zlib.decompress(base64.b85decode(JOBLIB)))
    motion = read_motion(tmp_path / "a.pkl", fps=30, axes="smpl")
    np.testing.assert_array_equal(motion.poses.reshape(2, 72), np.arange(144, dtype=np.float32).reshape(2, 72) / 1000)
    np.testing.assert_array_equal(motion.transl, np.ones((2, 3)))


def test_torch(tmp_path: Path) -> None:
    def tensors(turn: Rotation | None = None) -> dict[str, torch.Tensor]:
        poses = turned(POSES, turn) if turn else POSES
        whole = torch.tensor(poses.reshape(T, 72), dtype=torch.float32)
        return {"global_orient": whole[:, :3], "body_pose": whole[:, 3:66], "betas": torch.zeros(T, 10)}

    content = {"smpl_params_incam": tensors(CAMERA), "smpl_params_global": tensors(), "net": torch.nn.Linear(2, 2)}
    torch.save(content, tmp_path / "a.pt")
    motion = read_motion(tmp_path / "a.pt", fps=30)
    same(motion, joints=22)
    data = (tmp_path / "a.pt").read_bytes()
    for cut in range(0, len(data), 997):
        (tmp_path / "cut.pt").write_bytes(data[:cut])
        with pytest.raises(MotionFileError):
            read_motion(tmp_path / "cut.pt", fps=30)


def test_frames_of_a_tracker(tmp_path: Path) -> None:
    """PHALP: a dictionary a frame, lists of people in it; two frames without anybody."""
    content: dict[str, Any] = {}
    for i in range(T):
        body = {"global_orient": R[i, :1], "body_pose": R[i, 1:], "betas": np.zeros(10)}
        lost = i in (10, 11)
        content[f"{i:06}.jpg"] = {"smpl": [] if lost else [body], "tid": [] if lost else [4], "camera": [np.ones(3)]}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    motion = read_motion(tmp_path / "a.pkl", fps=30)
    assert len(motion) == T
    off = Rotation.from_rotvec(motion.poses.reshape(-1, 3)).inv() * Rotation.from_rotvec(POSES.reshape(-1, 3))
    assert off.magnitude().reshape(T, 24)[[9, 12]].max() < 1e-3
    assert off.magnitude().max() < 0.2
    assert "2 of 30 frames are missing: interpolated" in motion.notes


def test_arrays_alone(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", POSES)
    same(read_motion(tmp_path / "a.npy", fps=30))
    np.save(tmp_path / "a.npy", {"pred_rotmat": R, "pred_trans": TRANSL[:, None], "pred_shape": np.zeros((T, 10))})
    np.testing.assert_array_equal(read_motion(tmp_path / "a.npy", fps=30).transl, TRANSL)
    np.save(tmp_path / "a.npy", np.pad(POSES[:, :22].reshape(T, 66), ((0, 0), (0, 256))))
    same(read_motion(tmp_path / "a.npy", fps=30), joints=22)
    np.save(tmp_path / "a.npy", np.zeros((T, 263)))
    with pytest.raises(MotionFileError, match="HumanML3D"):
        read_motion(tmp_path / "a.npy", fps=30)


# BVH --------------------------------------------------------------------------------------------------------------

MIXAMO = "Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase RightToeBase "
MIXAMO += "Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand "
MIXAMO += "LeftHandIndex1 RightHandIndex1"
UNREAL = "pelvis thigh_l thigh_r spine_01 calf_l calf_r spine_02 foot_l foot_r spine_03 ball_l ball_r neck_01 "
UNREAL += "clavicle_l clavicle_r head upperarm_l upperarm_r lowerarm_l lowerarm_r hand_l hand_r index_l index_r"
POSER = "hip lThigh rThigh abdomen lShin rShin chest lFoot rFoot chest2 lToe rToe neck lCollar rCollar head lShldr "
POSER += "rShldr lForeArm rForeArm lHand rHand lThumb rThumb"
XSENS = "Hips LeftHip RightHip Chest LeftKnee RightKnee Chest2 LeftAnkle RightAnkle Chest3 LeftToe RightToe Neck "
XSENS += "LeftCollar RightCollar Head LeftShoulder RightShoulder LeftElbow RightElbow LeftWrist RightWrist LH RH"


def bvh(
    names: list[str],
    unit: float,
    n: int = 8,
    *,
    moved: Mapping[str, tuple[float, float, float]] | None = None,
    axes: NDArray[np.float64] | None = None,
    hips: NDArray[np.float64] | None = None,
) -> tuple[str, NDArray[np.float64]]:
    """A file of the male body's skeleton, and its joints in metres, shape (n, 24, 3).

    Joints at rest may be `moved` [m], and have `axes` (24, 3, 3) of their own. Legs may hang on a joint of their own,
    beside the spine; its axes are `hips` (3, 3).
    """
    body = load_body("male", dtype=torch.float64)
    rest = body.rest_joints(torch.zeros(1, 10, dtype=torch.float64))[0].numpy()
    for name, way in (moved or {}).items():
        rest[JOINT_NAMES.index(name)] += way
    own = np.broadcast_to(np.eye(3), (24, 3, 3)) if axes is None else axes
    lines, order = ["HIERARCHY"], []

    def above(joint: int) -> NDArray[np.float64]:
        """Axes of the joint that one hangs on."""
        if joint in (1, 2) and hips is not None:
            return hips
        return own[PARENTS[joint]] if joint else np.eye(3)

    def add(joint: int) -> None:
        order.append(joint)
        offset = above(joint).T @ (unit * (rest[joint] - rest[max(PARENTS[joint], 0)]))
        kind, channels = ("JOINT", "3") if joint else ("ROOT", "6 Xposition Yposition Zposition")
        lines.extend([f"{kind} {names[joint]}", "{", f"OFFSET {' '.join(map(str, offset))}"])
        lines.append(f"CHANNELS {channels} Zrotation Yrotation Xrotation")
        children = [i for i, parent in enumerate(PARENTS) if parent == joint]
        if joint == 0 and hips is not None:
            order.append(-1)
            lines.extend(["JOINT Waist", "{", "OFFSET 0 0 0", "CHANNELS 3 Zrotation Yrotation Xrotation"])
            add(1)
            add(2)
            lines.append("}")
            children = [3]
        for child in children:
            add(child)
        if not children:
            lines.extend(["End Site", "{", "OFFSET 0 0 0", "}"])
        lines.append("}")

    add(0)
    lines += ["MOTION", f"Frames: {n}", "Frame Time: 0.0333333"]
    for pose, transl in zip(POSES[:n], TRANSL[:n], strict=True):
        row = [*(unit * (transl + rest[0]))]
        for joint in order:
            if joint < 0:
                matrix = own[0].T @ hips
            else:
                matrix = above(joint).T @ Rotation.from_rotvec(pose[joint]).as_matrix() @ own[joint]
            row += [*Rotation.from_matrix(matrix).as_euler("ZYX", degrees=True)]
        lines.append(" ".join(f"{number:.6f}" for number in row))
    return "\n".join(lines), body(POSES[:n], transl=TRANSL[:n]).joints.numpy()


@pytest.mark.parametrize(
    ("names", "prefix", "unit", "said"),
    [
        (MIXAMO, "mixamorig:", 100.0, "centimetres"),
        (UNREAL, "", 1.0, "metres"),
        (POSER, "", 1 / 0.0254, "inches"),
        (XSENS, "Skeleton1|", 1000.0, "millimetres"),
    ],
)
def test_bvh(tmp_path: Path, names: str, prefix: str, unit: float, said: str) -> None:
    text, joints = bvh([prefix + name for name in names.split()], unit)
    (tmp_path / "a.bvh").write_text(text)
    motion = read_motion(tmp_path / "a.bvh")
    assert said in "; ".join(motion.notes)
    assert motion.fps == pytest.approx(30, abs=1e-3)
    body = load_body("neutral")
    got = body(motion.poses, motion.betas[None], motion.transl.astype(np.float32)).joints.numpy()
    limbs = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in
             ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")]  # fmt: skip
    assert np.linalg.norm(got - joints, axis=2)[:, limbs].max() < 0.012


ELSEWHERE = {
    "pelvis": (0.0, 0.09, 0.0),
    "spine1": (0.0, 0.05, 0.02),
    "neck": (0.0, -0.06, 0.03),
    "head": (0.0, 0.04, -0.03),
    "left_shoulder": (0.02, -0.03, 0.0),
    "right_shoulder": (-0.02, -0.03, 0.0),
    "left_hip": (0.03, 0.0, 0.0),
    "right_hip": (-0.03, 0.0, 0.0),
}


@pytest.mark.parametrize("along_bones", [False, True])
@pytest.mark.parametrize("longer", [-0.08, 0.0, 0.08])
def test_bvh_of_a_skeleton_that_is_not_smpl(tmp_path: Path, longer: float, along_bones: bool) -> None:
    """Somebody who stands isn't bent because tools put joints elsewhere, or make longer trunks (by so much [m])."""
    upper = [i for i, name in enumerate(JOINT_NAMES) if "spine" in name or i > 11]
    moved = {JOINT_NAMES[i]: np.array([0.0, longer, 0.0]) for i in upper}
    moved = {name: tuple(moved.get(name, 0.0) + np.array(ELSEWHERE.get(name, (0.0, 0.0, 0.0)))) for name in JOINT_NAMES}
    axes = None
    if along_bones:  # of the trunk x is up, from the chest on turned by 90°; elsewhere they are any
        axes = Rotation.random(24, random_state=0).as_matrix()
        axes[[0, 3, 6]] = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        axes[[9, 12, 15]] = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    text, _ = bvh(MIXAMO.split(), 100.0, moved=moved, axes=axes)
    (tmp_path / "a.bvh").write_text(text)
    motion = read_motion(tmp_path / "a.bvh")
    body = load_body("neutral")
    got, wanted = (world_turns(poses) for poses in (motion.poses, POSES[:8]))
    for joint in ("pelvis", "spine3", "head"):
        i = JOINT_NAMES.index(joint)
        off = np.degrees((Rotation.from_matrix(got[:, i]).inv() * Rotation.from_matrix(wanted[:, i])).magnitude())
        assert off.max() < (12 if along_bones and joint == "head" else 5), joint
    posed, true = (body(poses).joints.numpy() for poses in (motion.poses, POSES[:8]))
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist")):
        ways = [j[:, JOINT_NAMES.index(f"left_{b}")] - j[:, JOINT_NAMES.index(f"left_{a}")] for j in (posed, true)]
        cosine = (ways[0] * ways[1]).sum(1) / np.linalg.norm(ways[0], axis=1) / np.linalg.norm(ways[1], axis=1)
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 15, (a, b)


def world_turns(poses: NDArray[np.floating]) -> NDArray[np.float64]:
    """The rotation of each joint in the world, shape (n, 24, 3, 3)."""
    turns = np.stack([Rotation.from_rotvec(pose).as_matrix() for pose in poses])
    for i in range(1, 24):
        turns[:, i] = turns[:, PARENTS[i]] @ turns[:, i]
    return turns


@pytest.mark.parametrize(("pitch", "most"), [(0, 5), (-35, 12), (35, 12)])
def test_bvh_whose_legs_and_spine_hang_side_by_side(tmp_path: Path, pitch: float, most: float) -> None:
    """Where every bone has axes of its own, legs rise at rest; how the joint leans that bears them says nothing."""
    axes = np.tile(np.eye(3), (24, 1, 1))
    if pitch:
        axes[[1, 2, 4, 5]] = np.diag([1.0, -1.0, -1.0])
    text, _ = bvh(MIXAMO.split(), 100.0, axes=axes, hips=Rotation.from_euler("X", pitch, degrees=True).as_matrix())
    (tmp_path / "a.bvh").write_text(text)
    motion = read_motion(tmp_path / "a.bvh")
    got, wanted = (Rotation.from_matrix(world_turns(poses)[:, 0]) for poses in (motion.poses, POSES[:8]))
    assert np.degrees((got.inv() * wanted).magnitude()).max() < most


def test_bvh_of_somebody_with_one_hand(tmp_path: Path) -> None:
    """It ended in a traceback: the other side of the hand was looked for."""
    for n, name in enumerate(("LeftHand", "RightFoot")):
        text, joints = bvh(MIXAMO.replace(name, "Hook").split(), 100.0)
        (tmp_path / f"{n}.bvh").write_text(text)
        motion = read_motion(tmp_path / f"{n}.bvh")
        body = load_body("neutral")
        got = body(motion.poses, motion.betas[None], motion.transl.astype(np.float32)).joints.numpy()
        limbs = [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("knee", "elbow")]
        assert np.linalg.norm(got - joints, axis=2)[:, limbs].max() < 0.02


def test_bvh_that_is_refused(tmp_path: Path) -> None:
    text, _ = bvh(MIXAMO.split(), 100.0, n=2)
    path = tmp_path / "a.bvh"
    path.write_text(text.replace("}", "", 1))
    with pytest.raises(MotionFileError, match="cut short"):
        read_motion(path)
    path.write_text(text.rstrip().rpartition(" ")[0] + " nan")
    with pytest.raises(MotionFileError, match=r"of (\d+) finite numbers, got"):
        read_motion(path)
    for content, said in [
        (text.replace("LeftUpLeg", "Tail"), "no l_hip among Hips"),
        (text.replace("Zrotation", "Wrotation"), "unknown channel 'wrotation'"),
        (text.replace("OFFSET 0 0 0", "OFFSET 0 1e300 0", 1), r"below 1e\+09, got 1e\+300"),
        (text.replace("OFFSET 0 0 0", "OFFSET nan 0 0", 1), "below 1e.09, got nan"),
        (text[: len(text) // 3], "not a BVH file"),
        (text[:-40], "finite numbers, got"),
        (text.replace("Frame Time: 0.0333333", "Frame Time: 0"), "frame rate"),
    ]:
        path.write_text(content)
        with pytest.raises(MotionFileError, match=said):
            read_motion(path)


# SAM 3D Body ------------------------------------------------------------------------------------------------------

BODY = "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow left_hip "
BODY += "right_hip left_knee right_knee left_ankle right_ankle"
MHR_JOINTS = {BODY.split().index(name): name for name in BODY.split()[5:]}
MHR_JOINTS |= {41: "right_wrist", 62: "left_wrist", 69: "neck"}
"""Those of the 70 keypoints that are joints of SMPL, too."""


def mhr() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Keypoints (T, 70, 3) about the body and places (T, 3) in a camera's axes, y down; the joints (T, 24, 3) there."""
    joints = load_body("male")(POSES, transl=TRANSL).joints.numpy()
    joints = CAMERA.apply(joints.reshape(-1, 3)).reshape(T, 24, 3) + np.array([0.0, 0.0, 3.0])
    place = joints[:, 0]
    points = np.full((T, 70, 3), np.nan)
    for index, name in MHR_JOINTS.items():
        points[:, index] = joints[:, JOINT_NAMES.index(name)] - place
    return points.astype(np.float32), place.astype(np.float32), joints


def limbs_of(motion: Any) -> NDArray[np.float64]:
    """Joints of arms and legs of a motion that was left in its file's axes [m], shape (T, 24, 3)."""
    joints = load_body("neutral")(motion.poses, motion.betas[None], motion.transl.astype(np.float32)).joints
    return joints.numpy().astype(np.float64)


@pytest.mark.parametrize("form", ["stacked", "frames", "images", "objects"])
def test_sam_3d_body_is_followed_by_its_keypoints(tmp_path: Path, form: str) -> None:
    points, place, joints = mhr()
    one = [
        {"pred_keypoints_3d": seen, "pred_cam_t": at, "mhr_model_params": np.zeros(204)}
        for seen, at in zip(points, place, strict=True)
    ]
    away = [body | {"pred_cam_t": body["pred_cam_t"] + np.array([2.0, 0, 0])} for body in one]
    path = tmp_path / "a.pkl"
    if form == "stacked":
        path = save(tmp_path / "a.npz", pred_keypoints_3d=points, pred_cam_t=place)
    elif form == "frames":  # the second person comes late, and is first in every other list
        both = [[a] if i < 2 else [a, b][:: 1 - 2 * (i % 2)] for i, (a, b) in enumerate(zip(one, away, strict=True))]
        path.write_bytes(pickle.dumps({"frames": [[], *both], "fps": 30.0}))
    elif form == "images":
        path.write_bytes(pickle.dumps({f"{i:04}.jpg": [body] for i, body in enumerate(one)}))
    else:
        path = tmp_path / "a.npz"
        np.savez(path, outputs=np.array([[body] for body in one], dtype=object))
    motion = read_motion(path, fps=30, axes="frame")
    assert len(motion.poses) == T
    assert "followed by its keypoints" in "; ".join(motion.notes)
    limbs = [i for i in range(24) if JOINT_NAMES[i] in MHR_JOINTS.values() and JOINT_NAMES[i] != "neck"]
    assert np.linalg.norm(limbs_of(motion) - joints, axis=2)[:, limbs].max() < 0.03
    upright = read_motion(path, fps=30)
    assert "-y: taken as y down" in "; ".join(upright.notes)
    if form == "frames":
        assert read_motion(path).fps == 30
        assert "2 persons: 0 (" in "; ".join(upright.notes)
        second = read_motion(path, person="1", axes="frame")
        assert len(second.poses) == T - 2
        assert np.linalg.norm(limbs_of(second) - joints[2:] - [2.0, 0, 0], axis=2)[:, limbs].max() < 0.03


SOMA = {"Hips": 0, "Spine1": 3, "Spine2": 6, "Chest": 9, "Neck2": 12, "Head": 15}
SOMA |= {
    f"{side}{name}": joint + (side == "Right")
    for side in ("Left", "Right")
    for name, joint in (
        *(("Leg", 1), ("Shin", 4), ("Foot", 7), ("ToeBase", 10)),
        *(("Shoulder", 13), ("Arm", 16), ("ForeArm", 18), ("Hand", 20)),
    )
}


def soma(**changed: Any) -> dict[str, Any]:
    """The walk as SOMA's package saves it: 77 joints by their names, half of the neck's turn in each of its bones."""
    poses, transl = walk()
    names = [*SOMA, "Neck1", *(f"LeftHandIndex{i}" for i in range(54))]
    turns = np.zeros((len(poses), 77, 3), np.float32)
    turns[:, : len(SOMA)] = poses[:, [*SOMA.values()]]
    turns[:, names.index("Neck1")] = turns[:, names.index("Neck2")] = poses[:, 12] / 2
    places = transl + load_body("neutral").joint_template[0].numpy()
    arrays = {"poses": turns, "transl": 100 * places, "unit": np.array("centimeters"), "joint_names": np.array(names)}
    arrays |= {"absolute_pose": np.bool_(False), "rotation_repr": np.array("rotvec"), "keep_root": np.bool_(False)}
    return {**arrays, "identity_model_type": np.array("mhr"), "identity_coeffs": np.ones((1, 45)), **changed}


@pytest.mark.parametrize("as_matrices", [False, True])
def test_soma_turns_the_joints_that_smpl_has(tmp_path: Path, *, as_matrices: bool) -> None:
    arrays = soma()
    if as_matrices:
        arrays["poses"] = Rotation.from_rotvec(arrays["poses"].reshape(-1, 3)).as_matrix().reshape(-1, 77, 3, 3)
    motion = read_motion(save(tmp_path / "soma.npz", **arrays), fps=30)
    same(motion, joints=22)
    assert np.abs(motion.transl - walk()[1]).max() < 0.02
    assert any("SOMA's 77 joints" in note for note in motion.notes)
    assert any("identity of the kind 'mhr'" in note for note in motion.notes)
    assert not motion.betas.any()
    betas = np.linspace(-1, 1, 10)[None]
    of_smpl = soma(identity_model_type=np.array("smpl"), identity_coeffs=betas)
    np.testing.assert_allclose(read_motion(save(tmp_path / "s.npz", **of_smpl), fps=30).betas, betas[0], atol=1e-6)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"absolute_pose": np.bool_(True)}, "relative to the T-pose"),
        ({"joint_names": np.array(["Hand", "Thumb1"]), "poses": np.zeros((4, 2, 3))}, "without Hips"),
        ({"unit": np.array("parsecs")}, "wanted meters"),
        ({"poses": np.zeros((4, 78, 3))}, "poses must be"),
        ({"transl": np.zeros((4, 2))}, "transl"),
        ({"joint_names": np.zeros(0)}, "without Hips"),
    ],
)
def test_soma_that_is_refused(tmp_path: Path, changed: dict[str, Any], said: str) -> None:
    assert said in refusal(lambda: read_motion(save(tmp_path / "soma.npz", **soma(**changed)), fps=30))


def test_keypoints_of_others_are_not_taken_for_mhr(tmp_path: Path) -> None:
    points, place, _ = mhr()
    path = save(tmp_path / "a.npz", pred_keypoints_3d=points[:, :44], pred_cam_t=place)
    with pytest.raises(MotionFileError, match="no poses; wanted"):
        read_motion(path, fps=30)
    with pytest.raises(MotionFileError, match=r"must be \(30, 3\) like the pose"):
        read_motion(save(path, pred_keypoints_3d=points, pred_cam_t=place[:2]), fps=30)
    path.with_suffix(".pkl").write_bytes(pickle.dumps({"pred_keypoints_3d": points}))
    with pytest.raises(MotionFileError, match="no frame rate"):
        read_motion(path.with_suffix(".pkl"))
    with pytest.raises(MotionFileError, match="in no order"):
        read_motion(save(path, pred_keypoints_3d=np.full((4, 70, 3), np.nan)), fps=30)
