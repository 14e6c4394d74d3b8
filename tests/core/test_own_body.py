"""Bodies of one's own: the built-in mesh on them, garments that follow, betas that are theirs, and what is refused."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from smpl_file import N_FACES, N_VERTICES, smpl_arrays, write_smpl

from refu_core import BodyError, GarmentError, GarmentPipeline, SmplFrame, WeightsError, load_body, load_garment
from refu_core._cache import cache_folder, keep, recall
from refu_core.body import BodyFit, SmplBody, Surface, _fit, load_fit
from refu_core.garments import worn_on
from refu_core.mesh import Connectivity
from refu_core.metrics import CollisionChecker

MM = 1e-3
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bodies")


@pytest.fixture(scope="module")
def female(folder: Path) -> Path:
    return write_smpl(folder, "female")


@pytest.fixture(scope="module")
def fit(female: Path) -> BodyFit:
    return load_fit(female)


def distances(to: SmplBody, vertices: Array, points: Array) -> Array:
    """Of points (N, 3) from the surface of vertices (V, 3) [m], shape (N,)."""
    return np.abs(Surface(vertices, to.faces.numpy().astype(np.int32)).heights(points)[0])


def renumbered(name: str) -> SmplBody:
    """A built-in body whose vertices are in another order: the same surface, and another file."""
    known = load_body(name).arrays
    order = np.random.default_rng(0).permutation(len(known.v_template))
    place = np.argsort(order)
    made = type(known)(
        v_template=known.v_template[order],
        faces=place[known.faces],
        weights=known.weights[order],
        joint_regressor=known.joint_regressor[:, order],
        shapedirs=known.shapedirs[order],
        posedirs=None,
    )
    return SmplBody(made, name="renumbered")


# Registration


def test_the_built_in_mesh_lies_on_a_file(folder: Path, fit: BodyFit) -> None:
    """As SMPL's files are, the one with 10 betas and the other with 300."""
    pickled = load_fit(write_smpl(folder, "male", suffix=".pkl", n_betas=300))
    for found in (fit, pickled):
        assert (found.body.n_vertices, len(found.body.faces)) == (N_VERTICES, N_FACES)
        assert found.registration.mean_distance < 1 * MM
        assert found.registration.far_distance < 5 * MM
        assert not found.warnings


def test_a_file_is_registered_once(female: Path, fit: BodyFit, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any) -> Any:
        pytest.fail("registered again")

    monkeypatch.setattr(_fit.Registrar, "run", never)
    again = load_fit(female)
    np.testing.assert_array_equal(again.registration.vertices, fit.registration.vertices)
    np.testing.assert_array_equal(again.registration.place.weight, fit.registration.place.weight)


@pytest.mark.parametrize("damage", ["cut short", "of another mesh"])
def test_what_was_kept_and_is_damaged_is_made_again(
    fit: BodyFit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    (kept,) = (path for path in cache_folder().glob("fit-*.npz") if fit.body.fingerprint in path.name)
    here = tmp_path / kept.name
    if damage == "cut short":
        here.write_bytes(kept.read_bytes()[:1000])
    else:
        with np.load(kept) as arrays:
            np.savez(here, **{**arrays, "face": np.full_like(arrays["face"], N_FACES)})
    made = []
    monkeypatch.setenv("REFU_CACHE", str(tmp_path))
    monkeypatch.setattr(_fit.Registrar, "run", lambda *_: made.append(1) or fit.registration)
    assert load_fit(fit.body).registration.mean_distance == pytest.approx(fit.registration.mean_distance, rel=1e-5)
    assert made


def test_a_relative_cache_stays_where_it_was_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("REFU_CACHE", f"kept/{tmp_path.name}")
    keep("ones", {"ones": np.ones(3)})
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    assert recall("ones", keys=("ones",)) is not None
    keep("twos", {"twos": np.ones(3)})
    assert not list(Path().iterdir())
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("REFU_CACHE", f"~/kept/{tmp_path.name}")  # as an env file gives it, which no shell reads
    assert recall("twos", keys=("twos",)) is not None


def test_a_cache_in_a_working_directory_that_was_removed_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    monkeypatch.setenv("REFU_CACHE", "first/asked/for/here")
    assert cache_folder().is_absolute()


def test_nowhere_to_keep_anything(fit: BodyFit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REFU_CACHE", str(tmp_path / "file" / "folder"))
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr(_fit.Registrar, "run", lambda *_: fit.registration)
    assert load_fit(fit.body).registration.vertices.shape == fit.registration.vertices.shape


def test_a_folder_that_may_not_be_searched_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REFU_CACHE", str(tmp_path / "home" / "refu"))
    (tmp_path / "home").mkdir(mode=0)
    user = os.geteuid()
    if user == 0:  # who may search everything
        os.seteuid(65534)
    try:
        keep("ones", {"ones": np.ones(3)})
        assert recall("ones", keys=("ones",)) is None
    finally:
        os.seteuid(user)


# Garments


def test_a_garment_stays_as_it_is_on_its_own_body() -> None:
    """And nearly so where that body's vertices are numbered otherwise; networks are told nearly the same betas.

    A unit that moves skin by a millimetre isn't told from noise.
    """
    garment, again = load_garment("tshirt-male"), load_fit(renumbered("male"))
    assert worn_on(garment, load_fit("male")) is garment
    worn = worn_on(garment, again)
    betas = torch.eye(10).mul(2)
    gap = (worn.rest(betas) - garment.rest(betas)).norm(dim=-1)
    assert gap.mean() < 0.5 * MM
    assert gap.max() < 5 * MM
    assert (worn.weights - garment.weights).abs().mean() < 0.001
    known = again.difference("male").betas
    seen = load_body("male").arrays.shapedirs.reshape(-1, 10).std(0) > 2 * MM
    assert known.offset[seen].abs().max() < 0.1
    matrix = known.matrix.numpy()[np.ix_(seen, seen)]
    np.testing.assert_allclose(matrix, np.eye(len(matrix)), atol=0.2)
    assert known(torch.full((1, 10), 50.0)).abs().max() == 3, "nothing was trained beyond"


@pytest.mark.parametrize("name", ["short-pant-male", "skirt-female"])
def test_a_garment_is_outside_of_the_body_that_it_is_transferred_to(fit: BodyFit, name: str) -> None:
    garment = load_garment(name)
    worn = worn_on(garment, fit)
    betas = torch.cat((torch.zeros(1, 10), 2 * torch.eye(10), -2 * torch.eye(10)))
    checker = CollisionChecker(fit.body.faces.numpy())
    inside = []
    for body, cloth in zip(fit.body.rest_vertices(betas), worn.rest(betas), strict=True):
        checker.update(body.numpy())
        inside.append(checker.check(cloth.numpy(), worn.faces.numpy()).n_inside)
    assert inside[0] == 0, "at rest, as it was cut"
    assert np.mean(inside) < 0.005 * worn.n_vertices
    lengths = [(v[worn.edges[:, 0]] - v[worn.edges[:, 1]]).norm(dim=1) for v in (garment.v_template, worn.v_template)]
    ratio = np.percentile((lengths[1] / lengths[0]).numpy(), (1, 50, 99))
    assert 0.7 < ratio[0] < ratio[2] < 1.4
    assert 0.9 < ratio[1] < 1.1
    torch.testing.assert_close(worn.weights.sum(1), torch.ones(worn.n_vertices))
    assert (worn.weights > 0).sum(1).max() <= 6


# Betas


@settings(max_examples=10)
@given(st.lists(st.floats(-2, 2, width=32), min_size=10, max_size=10))
def test_the_built_in_mesh_follows_a_files_betas(betas: list[float]) -> None:
    follower, body = _follower()
    beta = torch.tensor([betas])
    pose = 0.3 * torch.sin(torch.arange(72.0)).view(1, 24, 3)
    for at in (torch.zeros(1, 24, 3), pose):
        mine, theirs = follower(at, beta), body(at, beta)
        there = distances(body, theirs.vertices[0].double().numpy(), mine.vertices[0].double().numpy())
        assert there.mean() < 1 * MM  # wanted: 5 mm
        torch.testing.assert_close(mine.joints, theirs.joints, atol=1e-4, rtol=0)


_MADE: list[tuple[SmplBody, SmplBody]] = []


def _follower() -> tuple[SmplBody, SmplBody]:
    if not _MADE:
        body = SmplBody(type(load_body("male").arrays).from_mapping(smpl_arrays("female"), source="test"), name="test")
        _MADE.append((load_fit(body, betas_from=True).body, body))
    return _MADE[0]


# The pipeline


def frames() -> list[SmplFrame]:
    made = []
    for k in range(4):
        pose = np.zeros((24, 3), np.float32)
        pose[16, 2], pose[17, 2] = -1.0, 1.0
        pose[1, 0], pose[2, 0], pose[4, 0], pose[5, 0] = -0.3 * k, 0.2 * k, 0.3 * k, 0.1
        made.append(SmplFrame(pose, betas=np.roll([1.5, -1, 0.5, 0, 0, 1, 0, 0, -1, 0], k)))
    return made


def test_shipped_garments_and_weights_on_an_own_body(female: Path) -> None:
    """A garment of each gender's body, together."""
    garments = ["tshirt-male", "skirt-female"]
    pipeline = GarmentPipeline.load(garments, body=female)
    body, checker = load_body(female), CollisionChecker(pipeline.body.faces.numpy())
    for frame, out in zip(frames(), pipeline(frames()), strict=True):
        theirs = body(frame.pose[None], frame.betas[None]).vertices[0].numpy()
        np.testing.assert_allclose(out.skin, theirs, atol=1e-5, err_msg="the betas are the file's")
        checker.update(out.body)
        for name in garments:
            found = checker.check(out[name].local, pipeline.garments[name].faces.numpy())
            assert found.n_inside == found.n_pairs == 0
            assert out.stats.garments[name].n_unresolved == 0


def test_a_built_in_body_wears_what_is_cut_for_another() -> None:
    garments = ["tshirt-male", "skirt-female"]
    with pytest.raises(GarmentError, match="name a body to have them transferred"):
        GarmentPipeline.load(garments)
    pipeline = GarmentPipeline.load(garments, body="neutral", sdf="none", backbone="skinned", collider=False)
    assert pipeline.body.name == "neutral"
    assert not torch.equal(pipeline.garments["skirt-female"].v_template, load_garment("skirt-female").v_template)


def test_weights_of_a_third_body_are_refused(tmp_path: Path, female: Path) -> None:
    from refu_core.weights import load_weights, save_weights, weights_folder

    name = "short-pant-male"
    for stem in ("basis", "tailornet-hybrid"):
        known = load_weights(weights_folder(name) / stem)
        card = {**known.card, "body_fingerprint": "0123456789abcdef"}
        save_weights(tmp_path / name / stem, known.tensors, card)
    for chosen in ({}, {"body": female}):
        with pytest.raises(WeightsError, match="trained on the body 0123456789abcdef, wanted"):
            GarmentPipeline.load([name], weights=tmp_path, **chosen)


def test_one_of_body_and_betas_from(female: Path) -> None:
    with pytest.raises(BodyError, match="leave betas_from out"):
        GarmentPipeline.load(["tshirt-male"], body=female, betas_from=female)


# What is refused


def _turned(arrays: dict[str, Any], matrix: Any) -> dict[str, Any]:
    """v_template, shapedirs and posedirs in other axes or units."""
    matrix = np.asarray(matrix, np.float64)
    moved = {key: np.einsum("ab,vb...->va...", matrix, arrays[key]) for key in ("v_template", "shapedirs", "posedirs")}
    return {**arrays, **moved}


def _moved(arrays: dict[str, Any], by: list[float]) -> dict[str, Any]:
    return {**arrays, "v_template": arrays["v_template"] + np.outer(np.arange(len(arrays["v_template"])) == 5, by)}


def _without(arrays: dict[str, Any], n: int) -> dict[str, Any]:
    return {**arrays, "f": arrays["f"][n:]}


def _arms_hanging(arrays: dict[str, Any]) -> dict[str, Any]:
    """Shoulders at +-1.3 rad at rest."""
    body = SmplBody(type(load_body("male").arrays).from_mapping(arrays, source="test"), name="test")
    pose = torch.zeros(1, 24, 3)
    pose[0, 16, 2], pose[0, 17, 2] = -1.3, 1.3
    return {**arrays, "v_template": body(pose).vertices[0].double().numpy()}


def _headless(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """What follows neck and head, on the chest."""
    moved = weights.copy()
    moved[:, 9] += moved[:, 12] + moved[:, 15]
    moved[:, [12, 15]] = 0
    return moved


_ARMS_EXCHANGED = [*range(16), 17, 16, 19, 18, 21, 20, 23, 22]
WRONG: dict[str, tuple[Any, str]] = {
    "millimetres": (lambda a: _turned(a, 1000 * np.eye(3)), r"millimetres\? Divide v_template, .* by 1000"),
    "centimetres": (lambda a: _turned(a, 100 * np.eye(3)), r"centimetres\? Divide v_template, .* by 100"),
    "shapes in millimetres": (
        lambda a: {**a, "shapedirs": 1000 * a["shapedirs"]},
        "shapedirs moves a vertex by",
    ),
    "bends in millimetres": (lambda a: {**a, "posedirs": 1000 * a["posedirs"]}, "posedirs moves a vertex by"),
    "no head": (lambda a: {**a, "weights": _headless(a["weights"])}, "no face follows its neck"),
    "a face twice at a vertex": (lambda a: {**a, "f": np.append(a["f"], [[5, 5, 6]], 0)}, r"repeat one, number \d+"),
    "a vertex far off": (lambda a: _moved(a, [5, 5, 5]), "vertex 5 of v_template is .* m from every joint"),
    "a vertex out of place": (lambda a: _moved(a, [0, 0, 0.25]), r"the edge between its vertices .*\b5\b.* is 0.2. m"),
    "z up": (lambda a: _turned(a, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]), r"up is \+z.*y up"),
    "lies on its side": (lambda a: _turned(a, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), r"up is \+x"),
    "faces backwards": (lambda a: _turned(a, np.diag([-1, 1, -1])), r"left is -x, front is -z"),
    "askew": (lambda a: _turned(a, [[0.7, -0.7, 0], [0.7, 0.7, 0], [0, 0, 1]]), "askew"),
    "mirrored": (lambda a: _turned(a, np.diag([-1, 1, 1])), r"mirrored \(up is \+y, left is -x"),
    "mirrored front to back": (lambda a: _turned(a, np.diag([1, 1, -1])), "mirrored"),
    "inside out": (lambda a: {**a, "f": a["f"][:, ::-1]}, "turned inward"),
    "holes": (lambda a: _without(a, 50), "open edges.*betas_from"),
    "other joints": (lambda a: {**a, "J_regressor": np.roll(a["J_regressor"], 3, axis=0)}, "body mine"),
    "arms exchanged": (lambda a: {**a, "weights": a["weights"][:, _ARMS_EXCHANGED]}, "left_shoulder is .* from there"),
    "no limbs": (lambda a: {**a, "weights": np.full_like(a["weights"], 1 / 24)}, "no vertex follows its left_hip"),
    "arms hang": (_arms_hanging, "arm isn't stretched out"),
}


@pytest.mark.parametrize("what", WRONG)
def test_bodies_that_stand_otherwise_are_refused(what: str) -> None:
    change, message = WRONG[what]
    arrays = change(smpl_arrays("female"))
    body = SmplBody(type(load_body("male").arrays).from_mapping(arrays, source=what), name="mine")
    with pytest.raises(BodyError, match=message) as told:
        load_fit(body)
    assert str(told.value).startswith("body mine: ")
    assert "\n" not in str(told.value)


def test_vertices_of_no_face_are_refused() -> None:
    """One a few metres off would make every grid around the body as large."""
    arrays = dict(smpl_arrays("female"))
    for key in ("v_template", "shapedirs", "posedirs", "weights"):
        arrays[key] = np.concatenate((arrays[key], arrays[key][:1] + (4.0 if key == "v_template" else 0.0)))
    arrays["J_regressor"] = np.pad(arrays["J_regressor"], ((0, 0), (0, 1)))
    body = SmplBody(type(load_body("male").arrays).from_mapping(arrays, source="mine"), name="mine")
    with pytest.raises(BodyError, match=r"body mine: 1 of .* vertices belong to no face: leave them out"):
        load_fit(body)


def test_how_arrays_lie_in_memory_plays_no_role() -> None:
    arrays = {key: np.asfortranarray(value) for key, value in smpl_arrays("female").items()}
    body = SmplBody(type(load_body("male").arrays).from_mapping(arrays, source="mine"), name="mine")
    GarmentPipeline.load(["short-pant-male"], body=body, backbone="skinned")(SmplFrame(pose=np.zeros((24, 3))))


def test_a_body_may_stand_beside_its_origin() -> None:
    """On legs of either side of x = 0, which then isn't its middle."""
    worn = []
    for beside in (0.0, 0.2):
        arrays = dict(smpl_arrays("female"))  # the other tests get the same one
        arrays["v_template"] = arrays["v_template"] + np.array((beside, 0, 0))
        body = SmplBody(type(load_body("male").arrays).from_mapping(arrays, source="beside"), name="beside")
        worn.append(worn_on(load_garment("short-pant-male"), load_fit(body)).v_template - torch.tensor((beside, 0, 0)))
    assert (worn[1] - worn[0]).norm(dim=1).max() < 2 * MM


def test_a_body_may_stand_far_from_its_origin() -> None:
    """A hundred metres away it was said to be turned inside out: rounding decided."""
    arrays = smpl_arrays("female")
    arrays = arrays | {"v_template": arrays["v_template"] + 100}
    body = SmplBody(type(load_body("male").arrays).from_mapping(arrays, source="far"), name="far")
    done = GarmentPipeline.load(["short-pant-male"], body=body)(SmplFrame(pose=np.zeros((24, 3))))
    assert done.stats.garments["short-pant-male"].n_unresolved == 0


def test_a_file_with_holes_can_say_what_betas_mean() -> None:
    arrays = _without(smpl_arrays("female"), 50)
    body = SmplBody(type(load_body("male").arrays).from_mapping(arrays, source="holes"), name="holes")
    found = load_fit(body, betas_from=True)
    assert found.registration.mean_distance < 1 * MM
    Connectivity.of(found.body.faces.numpy()).require_closed()


@pytest.mark.parametrize("n_joints", [52, 55])
def test_fingers_and_faces_are_folded_into_hands_and_heads(n_joints: int) -> None:
    """SMPL-H's 15 finger joints a hand; SMPL-X's jaw and eyes before them. Where no finger bends, nothing changes."""
    arrays = dict(smpl_arrays("male"))
    faces = [15, 15, 15] if n_joints == 55 else []
    first = 22 + len(faces)
    fingers = [
        parent
        for hand, wrist in enumerate((20, 21))
        for finger in range(5)
        for parent in (wrist, first + 15 * hand + 3 * finger, first + 15 * hand + 3 * finger + 1)
    ]
    parents = [*arrays["kintree_table"][0, :22].tolist(), *faces, *fingers]
    weights, regressor = np.zeros((N_VERTICES, n_joints)), np.zeros((n_joints, N_VERTICES))
    weights[:, :22], regressor[:22] = arrays["weights"][:, :22], arrays["J_regressor"][:22]
    for hand in range(2):
        of = slice(first + 15 * hand, first + 15 * hand + 15)
        weights[:, of] = arrays["weights"][:, 22 + hand, None] / 15
        regressor[of] = arrays["J_regressor"][22 + hand]
    poses = np.random.default_rng(0).normal(size=(N_VERTICES, 3, 9 * (n_joints - 1)))
    poses[:, :, :189] = arrays["posedirs"][:, :, :189]
    changed = {"weights": weights, "J_regressor": regressor, "posedirs": poses}
    changed["kintree_table"] = np.array([parents, range(n_joints)])
    kind = type(load_body("male").arrays)
    folded = SmplBody(kind.from_mapping({**arrays, **changed}, source="fingers"), name="fingers")
    plain_poses = arrays["posedirs"].copy()
    plain_poses[:, :, 189:] = 0
    plain = SmplBody(kind.from_mapping({**arrays, "posedirs": plain_poses}, source="plain"), name="plain")
    pose = 0.3 * torch.sin(torch.arange(72.0)).view(1, 24, 3)
    torch.testing.assert_close(folded(pose).vertices, plain(pose).vertices, atol=1e-5, rtol=0)
    torch.testing.assert_close(folded(pose).joints, plain(pose).joints, atol=1e-5, rtol=0)
