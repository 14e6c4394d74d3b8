"""SmplBody against a slow reference, its derivatives, and what loading refuses."""

from __future__ import annotations

import pickle
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core import BodyError, FrameError, RefuError, load_body
from refu_core.body import (
    ARMS,
    BUILTIN_BODIES,
    JOINT_NAMES,
    LEGS,
    MIRRORED_JOINTS,
    PARENTS,
    SEGMENTS,
    SmplBody,
    part_of_faces,
    rotvec_to_rotmat,
    up_in,
    weight_of_parts,
)
from refu_core.body._model import BodyArrays
from refu_core.realtime import RootTurn

ASSETS = Path(__file__).parents[2] / "refu_core" / "assets"


def asset(name: str = "male") -> dict[str, NDArray[np.float64]]:
    with np.load(ASSETS / f"body_{name}.npz") as file:
        return {key: file[key] for key in file.files}


def reference(
    data: dict[str, NDArray[np.float64]], pose: NDArray[np.float64], betas: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """SMPL as its paper writes it: 4x4 matrices, one joint and one vertex at a time, float64."""
    shaped = data["v_template"].astype(float) + data["shapedirs"].astype(float) @ betas
    joints = data["J_regressor"].astype(float) @ shaped
    rotations = Rotation.from_rotvec(pose).as_matrix()
    shaped = shaped + data["posedirs"].astype(float) @ (rotations[1:] - np.eye(3)).ravel()
    world: list[NDArray[np.float64]] = []
    for j, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        world.append(world[parent] @ local if parent >= 0 else local)
    posed = np.array([m[:3, 3] for m in world])
    rest = np.tile(np.eye(4), (24, 1, 1))
    rest[:, :3, 3] = -joints
    transforms = np.array(world) @ rest
    vertices = np.empty_like(shaped)
    for i, w in enumerate(data["weights"].astype(float)):
        vertices[i] = (np.tensordot(w, transforms, 1) @ np.append(shaped[i], 1))[:3]
    return vertices, posed


def random_model(rng: np.random.Generator, n: int = 60) -> dict[str, NDArray[np.float64]]:
    """A model with pose blend shapes, which the built-in bodies have none of."""
    weights, regressor = rng.random((n, 24)) ** 4, rng.random((24, n)) ** 4
    return {
        "v_template": rng.normal(size=(n, 3)),
        "f": rng.integers(0, n, (2 * n, 3)),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)]),
        "shapedirs": 0.1 * rng.normal(size=(n, 3, 10)),
        "posedirs": 0.1 * rng.normal(size=(n, 3, 207)),
    }


def model(data: dict[str, NDArray[np.float64]], dtype: torch.dtype = torch.float64) -> SmplBody:
    return SmplBody(BodyArrays.from_mapping(data, source="test"), name="test", dtype=dtype)


@pytest.mark.parametrize("name", BUILTIN_BODIES)
def test_built_in_bodies_match_the_reference(name: str) -> None:
    rng = np.random.default_rng(1)
    pose, betas = rng.normal(0, 0.5, (24, 3)), rng.normal(size=10)
    vertices, joints = reference(asset(name), pose, betas)
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 2e-6)):
        out = load_body(name, dtype=dtype)(pose[None], betas[None])
        np.testing.assert_allclose(out.vertices[0].numpy(), vertices, atol=tolerance)
        np.testing.assert_allclose(out.joints[0].numpy(), joints, atol=tolerance)


@given(seed=st.integers(0, 2**32 - 1))
def test_full_model_matches_the_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = random_model(rng)
    pose, betas = rng.normal(0, 1.5, (24, 3)), rng.normal(0, 2, 10)
    vertices, joints = reference(data, pose, betas)
    out = model(data)(pose.reshape(1, 72), betas[None])
    np.testing.assert_allclose(out.vertices[0].numpy(), vertices, atol=1e-9)
    np.testing.assert_allclose(out.joints[0].numpy(), joints, atol=1e-9)


def test_matches_smplx_where_it_is_installed(tmp_path: Path) -> None:
    smplx = pytest.importorskip("smplx", reason="smplx isn't installed: its licence forbids to depend on it")
    rng = np.random.default_rng(2)
    data = random_model(rng, 6890)
    (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(data))
    other = smplx.SMPL(str(tmp_path / "SMPL_NEUTRAL.pkl"), dtype=torch.float64)
    pose, betas = torch.as_tensor(rng.normal(size=(4, 24, 3))), torch.as_tensor(rng.normal(size=(4, 10)))
    theirs = other(global_orient=pose[:, 0], body_pose=pose[:, 1:].flatten(1), betas=betas)
    # smplx keeps some of its arrays in float32
    torch.testing.assert_close(model(data)(pose, betas).vertices, theirs.vertices, atol=2e-6, rtol=0)


def test_batch_equals_single_frames() -> None:
    body = load_body("female")
    rng = np.random.default_rng(3)
    pose, betas, transl = rng.normal(0, 0.4, (3, 24, 3)), rng.normal(size=(3, 10)), rng.normal(size=(3, 3))
    batch = body(pose, betas, transl)
    assert batch.vertices.dtype == torch.float64, "the translation's precision is kept"
    for i in range(3):
        single = body(pose[i : i + 1], betas[i : i + 1], transl[i : i + 1])
        torch.testing.assert_close(batch.vertices[i], single.vertices[0], atol=1e-6, rtol=0)
        torch.testing.assert_close(batch.joints[i], single.joints[0], atol=1e-6, rtol=0)


def test_translation_far_away_loses_no_precision() -> None:
    body = load_body("male")
    pose = np.random.default_rng(4).normal(0, 0.4, (1, 24, 3))
    far = np.array([[1e5, -2e5, 3e5]])
    here, there = body(pose, transl=np.zeros((1, 3))), body(pose, transl=far)
    torch.testing.assert_close(there.vertices - torch.as_tensor(far), here.vertices, atol=1e-9, rtol=0)


def test_derivatives() -> None:
    rng = np.random.default_rng(5)
    body = model(random_model(rng, 12))
    pose = torch.as_tensor(rng.normal(0, 0.7, (1, 24, 3)))
    pose[0, 3] = 0  # the zero rotation, where a careless formula has NaN derivatives
    pose[0, 4] *= 1e-9
    betas = torch.as_tensor(rng.normal(size=(1, 10)))
    inputs = (pose.requires_grad_(), betas.requires_grad_())
    assert torch.autograd.gradcheck(lambda p, b: body(p, b).vertices, inputs)


LENGTHS = st.one_of(
    st.sampled_from([0.0, 1e-30, 1e-12, 1e-6, 1e-4, 1e-3, 0.01, np.pi, 2 * np.pi, 1e3]), st.floats(0, 10)
)


@given(length=LENGTHS, seed=st.integers(0, 1000))
def test_rotation_matrices(length: float, seed: int) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    rotvec = length * axis / np.linalg.norm(axis)
    wanted = Rotation.from_rotvec(rotvec).as_matrix()
    double = rotvec_to_rotmat(torch.as_tensor(rotvec)).numpy()
    np.testing.assert_allclose(double, wanted, atol=1e-12 * max(1, length))
    single = rotvec_to_rotmat(torch.as_tensor(rotvec, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(single, wanted, atol=4e-7 * max(1, length))
    np.testing.assert_allclose(single @ single.T, np.eye(3), atol=2e-6)


def test_up_does_not_tell_the_heading_and_has_derivatives() -> None:
    rng = np.random.default_rng(0)
    tilt = Rotation.from_rotvec(rng.uniform(-1, 1, (300, 3)))
    turned = Rotation.from_euler("y", rng.uniform(-np.pi, np.pi, (300, 1))) * tilt
    ups = [up_in(rotvec_to_rotmat(torch.tensor(r.as_rotvec(), dtype=torch.float32))) for r in (tilt, turned)]
    assert (ups[0] == ups[1]).all(1).sum() >= 297  # on the border between two places of the grid rounding decides
    assert (ups[0] - torch.tensor(tilt.as_matrix()[:, 1], dtype=torch.float32)).abs().max() < 2**-15 + 1e-6
    rotvec = torch.tensor(tilt.as_rotvec()[:4], requires_grad=True)
    assert torch.autograd.gradcheck(lambda r: up_in(rotvec_to_rotmat(r)), rotvec)


@pytest.mark.parametrize(
    ("pose", "betas", "transl", "wanted"),
    [
        (np.zeros((1, 23, 3)), None, None, r"pose must have the shape \(B, 24, 3\)"),
        (np.zeros((24, 3)), None, None, r"pose must have the shape \(B, 24, 3\)"),
        (np.zeros((1, 72), complex), None, None, "pose must be real numbers, got torch.complex128"),
        (np.zeros((1, 72)), np.zeros((1, 11)), None, r"betas must have the shape \(B, 10\)"),
        (np.zeros((3, 72)), np.zeros((2, 10)), None, r"betas must have the shape \(3, 10\)"),
        (np.zeros((1, 72)), None, np.zeros((1, 3), complex), "transl must be real numbers, got torch.complex128"),
        (np.zeros((3, 72)), None, np.zeros((3, 2)), r"transl must have the shape \(3, 3\)"),
    ],
)
def test_wrong_shapes(
    pose: NDArray[np.float64], betas: NDArray[np.float64] | None, transl: NDArray[np.float64] | None, wanted: str
) -> None:
    with pytest.raises(FrameError, match=wanted):
        load_body("male")(pose, betas, transl)


def test_arrays_may_lie_in_memory_as_they_please() -> None:
    pose = np.random.default_rng(0).normal(scale=0.3, size=(2, 24, 3)).astype(np.float32)
    body = load_body("male")
    wanted = body(pose).vertices
    for same in (pose[::-1].copy()[::-1], pose.astype(">f4"), np.asfortranarray(pose), list(torch.tensor(pose))):
        assert torch.equal(body(same).vertices, wanted)


@pytest.mark.parametrize("wanted", [torch.float16, torch.int64, np.float32, "float32"])
def test_a_body_is_single_or_double(wanted: Any) -> None:
    for make in (partial(load_body, "male"), load_body("male").to):
        with pytest.raises(BodyError, match=r"wanted a body in torch.float32 or torch.float64, got "):
            make(dtype=wanted)
    with pytest.raises(RefuError, match="no device"):
        load_body("male").to(device="tpu")


def test_fingerprint_tells_bodies_apart() -> None:
    prints = {load_body(name).fingerprint for name in BUILTIN_BODIES}
    assert len(prints) == len(BUILTIN_BODIES)
    assert load_body("male", dtype=torch.float64).fingerprint == load_body("male").fingerprint


# ---- files ----------------------------------------------------------------------------------------------------------


def test_loads_an_npz_of_the_user(tmp_path: Path) -> None:
    np.savez(tmp_path / "mine.npz", **asset("female"))
    assert load_body(tmp_path / "mine.npz").fingerprint == load_body("female").fingerprint


def save(path: Path, **changes: object) -> Path:
    data: dict[str, object] = dict(random_model(np.random.default_rng(9)))
    data.update(changes)
    np.savez(path, **{key: value for key, value in data.items() if value is not None})  # type: ignore[arg-type]
    return path


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"weights": None, "f": None}, "lacks f, weights"),
        ({"f": None, "faces": np.zeros((9, 3), int)}, "lacks f: SMPL's files call their faces f"),
        ({"weights": None, "shapedirs": None}, "a mesh or a scan has no joints and no shapes; fit SMPL to it"),
        ({"f": np.arange(1, 61).reshape(-1, 3)}, "got 1 to 60: they count from 1, wanted from 0"),
        ({"v_template": np.zeros((60, 2))}, r"v_template must have the shape"),
        ({"v_template": np.zeros(60)}, r"v_template must have the shape"),
        ({"v_template": np.full((60, 3), np.nan)}, "NaN or infinite"),
        ({"v_template": np.array(["a"] * 60)}, "not an array of numbers"),
        ({"v_template": np.array([{}])}, "can't be read as .npz"),
        ({"f": np.full((9, 3), 0.5)}, "f must hold whole numbers"),
        ({"posedirs": np.ones((60, 3, 93))}, "posedirs .* STAR's"),
        ({"f": np.full((9, 3), 60)}, "faces must index 60 vertices"),
        ({"weights": np.ones((60, 24))}, "must sum to one.* got sums from 24 to 24 .*divide each vertex's weights"),
        ({"weights": np.ones((60, 55))}, r"weights must have the shape \(60, 24\)"),
        ({"shapedirs": np.zeros((60, 3, 9))}, "shapedirs must be"),
        ({"posedirs": np.ones((60, 3, 486))}, r"posedirs must have the shape \(60, 3, 207\)"),
        ({"kintree_table": np.zeros((2, 55))}, "kintree_table must be the tree of SMPL's 24 joints"),
        ({"kintree_table": np.zeros((24, 2))}, r"got the shape \(24, 2\): transpose it"),
        ({"kintree_table": np.zeros((2, 16))}, "the file is MANO's, a hand; give SMPL's own file"),
        ({"kintree_table": np.zeros((2, 5))}, "the file is FLAME's, a head"),
        ({"v_template": None, "f": None, "skin_template_v": np.zeros((60, 3))}, "lacks f, v_template: it is SKEL's"),
        ({"v_template": np.zeros((3, 60))}, r"v_template must .* \(60, 3\), got \(3, 60\): transpose it"),
        ({"f": np.zeros((3, 9))}, r"f must have the shape \(9, 3\), got \(3, 9\): transpose it"),
        ({"weights": np.zeros((24, 60))}, r"weights must .*: transpose it"),
        ({"J_regressor": np.zeros((60, 24))}, r"J_regressor must .* \(24, 60\), got \(60, 24\): transpose it"),
        ({"shapedirs": np.zeros((10, 3, 60))}, r"shapedirs .*got \(10, 3, 60\).*: transpose it"),
        ({"shapedirs": np.zeros((180, 10))}, r"shapedirs .*got \(180, 10\): reshape it to \(60, 3, 10\)"),
        ({"posedirs": np.ones((207, 180))}, r"posedirs .*transpose it, and reshape it to \(60, 3, 207\)"),
    ],
)
def test_bad_models_are_named(tmp_path: Path, changes: dict[str, object], wanted: str) -> None:
    with pytest.raises(BodyError, match=wanted) as caught:
        load_body(save(tmp_path / "bad.npz", **changes))
    assert "bad.npz" in str(caught.value)
    assert "…" not in str(caught.value), "all of it is told"


def test_a_folder_and_a_suffix_in_capitals(tmp_path: Path) -> None:
    with pytest.raises(BodyError, match=r"is a folder: wanted a body model in it, as .*SMPL_FEMALE\.pkl"):
        load_body(tmp_path)
    (tmp_path / "SMPL_MALE.PKL").write_bytes(pickle.dumps({"f": np.zeros((1, 3))}))
    with pytest.raises(BodyError, match="not an SMPL-layout model"):
        load_body(tmp_path / "SMPL_MALE.PKL")


def test_files_that_are_no_models(tmp_path: Path) -> None:
    with pytest.raises(BodyError, match="wanted one of male, female, neutral"):
        load_body("mail")
    (tmp_path / "model.obj").write_text("v 0 0 0\n")
    with pytest.raises(BodyError, match=r"must be an .npz or an official .pkl file, got '.obj': a mesh or a scan"):
        load_body(tmp_path / "model.obj")
    for suffix in ("npz", "pkl"):
        for content in (b"", b"garbage", b"PK\x03\x04garbage", pickle.dumps([1, 2])):
            path = tmp_path / f"bad.{suffix}"
            path.write_bytes(content)
            with pytest.raises(BodyError, match=f"bad.{suffix}"):
                load_body(path)


def test_a_decompression_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    import zipfile

    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("v_template.npy", "w", force_zip64=True) as entry,
    ):
        for _ in range(1100):
            entry.write(bytes(1 << 20))
    with pytest.raises(BodyError, match="unpacks to 1100 MiB"):
        load_body(tmp_path / "bomb.npz")


@pytest.mark.parametrize("betas_of", [1, 3])
def test_kernels_pose_as_the_differentiable_code_does(betas_of: int) -> None:
    body = load_body("female")
    generator = torch.Generator().manual_seed(0)
    pose = torch.randn(3, 24, 3, generator=generator)
    pose[0, :5] *= 1e-3  # where Rodrigues' formula is a series
    betas = torch.randn(betas_of, 10, generator=generator)
    fast, slow = body(pose, betas), body(pose.clone().requires_grad_(), betas)
    assert slow.vertices.requires_grad
    assert not fast.vertices.requires_grad
    for got, wanted in zip((*fast[:2], *fast.transforms), (*slow[:2], *slow.transforms), strict=True):
        torch.testing.assert_close(got, wanted.detach(), atol=2e-6, rtol=0)


def test_each_joint_is_of_one_segment() -> None:
    assert sorted(joint for joints in SEGMENTS.values() for joint in joints) == list(range(24))
    assert [JOINT_NAMES[joint] for joint in (*ARMS[0], *LEGS[0])] == [
        *("left_shoulder", "left_elbow", "left_wrist", "left_hand"),
        *("left_hip", "left_knee", "left_ankle", "left_foot"),
    ]
    assert tuple(MIRRORED_JOINTS[joint] for joint in ARMS[0] + LEGS[0]) == ARMS[1] + LEGS[1]
    assert all(MIRRORED_JOINTS[MIRRORED_JOINTS[joint]] == joint for joint in range(24))


def test_faces_are_of_the_segment_that_moves_them() -> None:
    body = load_body("neutral")
    parts = tuple(SEGMENTS.values())
    middles = body.v_template[body.faces].mean(1)
    part = part_of_faces(body.weights, body.faces, parts)
    head, left_forearm = (middles[part == list(SEGMENTS).index(name)] for name in ("head", "left_forearm"))
    joints = body.rest_joints(torch.zeros(1, 10))[0]
    assert head[:, 1].min() > joints[3, 1]  # above the lowest vertebra
    assert left_forearm[:, 0].min() > joints[16, 0]  # farther out than the shoulder
    torch.testing.assert_close(weight_of_parts(body.weights, parts).sum(1), torch.ones(body.n_vertices))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_body_posed_in_its_roots_axes_is_turned_to_where_it_is(dtype: torch.dtype) -> None:
    """About the root, which stays; by kernels, and where derivatives are wanted."""
    drawn = torch.Generator().manual_seed(0)
    pose, betas = (torch.randn(2, *row, generator=drawn, dtype=dtype) for row in ((24, 3), (10,)))
    body = load_body("male", dtype=dtype)
    shape = body.shape(betas)
    wanted = body.posed(pose, shape)
    for told in (pose, pose.clone().requires_grad_()):
        at_root = body.posed(told, shape, in_root=True)
        torch.testing.assert_close(at_root.rotations, wanted.rotations)
        torch.testing.assert_close(at_root.joints[:, 0], shape.joints[:, 0])
        for turn, inside, outside in zip(RootTurn.taken_off(at_root), at_root.vertices, wanted.vertices, strict=True):
            torch.testing.assert_close(turn(inside), outside, atol=1e-5, rtol=0)
            torch.testing.assert_close(turn(inside[::2]), turn(inside)[::2])
            assert turn(inside).requires_grad == told.requires_grad
            with pytest.raises(RuntimeError):
                turn(inside.T)
