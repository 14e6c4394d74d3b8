"""What robots ask of dressed people: openings, a planner's mesh, clearance, contacts of limbs, visibility."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import igl
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msg_adapters.outputs._topics import Moment, Obstacles
from refu_core import (
    ExactSdf,
    GarmentPipeline,
    GarmentTemplate,
    MeshError,
    RefuError,
    SmplFrame,
    load_body,
    load_garment,
)
from refu_core.garments import BUILTIN_GARMENTS
from refu_core.observation import Observer
from refu_core.outputs import (
    Clearance,
    DressedPerson,
    Fittings,
    LimbContacts,
    Openings,
    PinholeCamera,
    PlannerMesh,
    Sigma,
    all_visible,
    depth_image,
    fit_sigma,
    load_sigma,
    visible,
)
from refu_core.outputs._visible import BUFFER_WIDTH, _buffered
from refu_lab.stress._frames import everyday_pose

GARMENTS = ["tshirt-male", "short-pant-male"]


def standing(*, arms: float = 1.1) -> SmplFrame:
    pose = np.zeros((24, 3))
    pose[16, 2], pose[17, 2] = -arms, arms
    return SmplFrame(pose=pose, transl=[3.0, 1.0, -2.0])


@pytest.fixture(scope="module")
def pipeline() -> GarmentPipeline:
    return GarmentPipeline.load(GARMENTS)


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("REFU_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


WANTED = {
    "shirt": ("neck", "left_sleeve", "right_sleeve", "hem"),
    "tshirt": ("neck", "left_sleeve", "right_sleeve", "hem"),
    "longsleeve": ("neck", "left_sleeve", "right_sleeve", "hem"),
    "dress": ("neck", "left_sleeve", "right_sleeve", "hem"),
    "skirt": ("waist", "hem"),
    "short-pant": ("waist", "left_leg", "right_leg"),
    "trousers": ("waist", "left_leg", "right_leg"),
}


@pytest.mark.parametrize("name", BUILTIN_GARMENTS)
def test_openings_are_found_and_named(name: str) -> None:
    garment = load_garment(name)
    openings = Openings(garment)
    assert openings.names == WANTED[name.rsplit("-", 1)[0]]
    for opening in openings.frames(garment.v_template):
        assert np.allclose(opening.rotation @ opening.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(opening.rotation) > 0
        out, up = opening.rotation[:, 2], {"neck": 1, "waist": 1, "hem": -1, "left_leg": -1, "right_leg": -1}
        if opening.name.endswith("sleeve"):
            assert out[0] * (1 if opening.name.startswith("left") else -1) > 0.9
            assert opening.rotation[2, 0] > 0.9  # x to the front
        else:
            assert out[1] * up[opening.name] > 0.8
            assert opening.rotation[0, 0] > 0.9  # x to the left
        # Outwards: most of the garment is behind it.
        behind = (garment.v_template.numpy() - opening.centre) @ out
        assert np.median(behind) < -0.1
        rim = np.linalg.norm(opening.ring - np.roll(opening.ring, -1, axis=0), axis=1).sum()
        assert opening.perimeter == pytest.approx(rim)
        assert 2 * max(opening.width, opening.height) < opening.perimeter + 1e-9


def test_a_name_says_nothing_of_what_it_is() -> None:
    garment = replace(load_garment("trousers-neutral"), name="hat")
    assert Openings(garment).names == WANTED["trousers"]


def without(garment: GarmentTemplate, gone: np.ndarray) -> GarmentTemplate:
    """The garment without the vertices that are `gone`, bool (V,)."""
    kept = np.flatnonzero(~gone)
    faces = garment.faces.numpy()
    faces = faces[~gone[faces].any(1)]
    kept = np.intersect1d(kept, faces)
    number = np.full(len(gone), -1)
    number[kept] = np.arange(len(kept))
    shapes = garment.shapedirs.view(len(gone), 3, -1)[kept].reshape(3 * len(kept), -1)
    return replace(
        garment,
        faces=torch.from_numpy(number[faces]),
        v_template=garment.v_template[kept],
        weights=garment.weights[kept],
        shapedirs=shapes,
        styledirs=None,
        uv=None,
    )


def test_an_open_coat_has_a_neck_a_hem_and_a_front() -> None:
    whole = load_garment("longsleeve-male")
    rest = whole.v_template.numpy()
    coat = without(whole, (np.abs(rest[:, 0]) < 0.02) & (rest[:, 2] > 0.05))
    openings = Openings(coat)
    assert openings.names == ("neck", "left_sleeve", "right_sleeve", "hem", "front")
    closed = {one.name: one for one in Openings(whole).frames(rest)}
    for one in openings.frames(coat.v_template):
        if one.name == "front":
            assert one.rotation[2, 2] > 0.8
        else:
            assert np.linalg.norm(one.centre - closed[one.name].centre) < 0.025


def test_flaws_of_a_mesh_are_no_openings_and_other_holes_have_numbers() -> None:
    whole = load_garment("tshirt-male")
    rest = whole.v_template.numpy()
    back = np.array([0.0, 0.1, rest[:, 2].min()])
    away = np.linalg.norm(rest - back, axis=1)
    assert Openings(without(whole, away < 0.008)).names == WANTED["tshirt"]
    assert Openings(without(whole, away < 0.05)).names == (*WANTED["tshirt"], "opening_0")
    box = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    closed = replace(
        whole,
        faces=torch.from_numpy(box.faces.astype(np.int64)),
        v_template=torch.from_numpy(box.vertices).float(),
        weights=torch.full((len(box.vertices), 24), 1 / 24),
    )
    assert Openings(closed).names == ()
    assert Openings(closed).frames(closed.v_template) == ()


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-50, 50)] * 3))
def test_openings_go_along_with_rigid_motion(turn: tuple[float, ...], shift: tuple[float, ...]) -> None:
    garment, rotation = TSHIRT, Rotation.from_rotvec(turn).as_matrix()
    rest = garment.v_template.double().numpy()
    here, there = OPENINGS.frames(rest), OPENINGS.frames(rest @ rotation.T + shift)
    for a, b in zip(here, there, strict=True):
        assert np.allclose(rotation @ a.centre + shift, b.centre, atol=1e-9)
        assert np.allclose(rotation @ a.rotation, b.rotation, atol=1e-9)
        assert (a.width, a.height, a.perimeter) == pytest.approx((b.width, b.height, b.perimeter), abs=1e-9)


TSHIRT = load_garment("tshirt-male")
OPENINGS = Openings(TSHIRT)


def test_axes_do_not_flip_however_a_rim_is_pulled() -> None:
    """A round rim has no longest axis: x is that of the cloth all the same. A rim drawn flat keeps its normal."""
    rest = TSHIRT.v_template.double().numpy()
    for pull in ([1.4, 1, 1], [1, 1, 1.4], [1, 1, 0.02]):
        for before, after in zip(OPENINGS.frames(rest), OPENINGS.frames(rest * pull), strict=True):
            if before.name == "neck" and pull[2] < 1:
                continue  # that one is tilted, and turns to the front
            cosines = (before.rotation * after.rotation).sum(0)
            assert cosines[[0, 2]].min() > 0.8, (after.name, pull)


def test_openings_of_a_still_person_are_still(pipeline: GarmentPipeline) -> None:
    """Noise of a tenth of a degree a joint moves a rim no more than 2 mm beyond what it moves the skin below."""
    rng = np.random.default_rng(0)
    places, skins = [], []
    for _ in range(10):
        frame = standing()
        wrong = rng.normal(0, np.radians(0.1), (24, 3))
        wrong[0] = 0
        out = pipeline(replace(frame, pose=frame.pose + wrong))
        rims = OPENINGS.frames(out["tshirt-male"].local)
        if not skins:
            near = [np.linalg.norm(out.skin[:, None] - rim.ring, axis=2).argmin(0) for rim in rims]
        places.append([rim.centre for rim in rims])
        skins.append([out.skin[rows].mean(0) for rows in near])
    step = np.linalg.norm(np.diff(np.subtract(places, skins), axis=0), axis=2)
    assert step.max() < 2e-3


SHORTS = load_garment("short-pant-male")


def test_a_planners_mesh_is_closed_small_and_near(pipeline: GarmentPipeline) -> None:
    worn = pipeline(standing())[SHORTS.name].vertices
    coarse = PlannerMesh.of(pipeline, SHORTS.name)
    mesh = trimesh.Trimesh(coarse.solid(worn), coarse.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert len(coarse.faces) <= 2000
    full = trimesh.Trimesh(worn, SHORTS.faces.numpy(), process=False)
    for one, other in ((mesh, full), (full, mesh)):
        square = igl.point_mesh_squared_distance(one.triangles_center, other.vertices, other.faces)[0]
        assert np.sqrt(square).max() - coarse.half_thickness < 5e-3


def test_a_planners_mesh_is_recalled_and_moves_with_the_garment() -> None:
    first, again = PlannerMesh(SHORTS), PlannerMesh(SHORTS)
    assert (first.faces == again.faces).all()
    rest = SHORTS.v_template.double().numpy()
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    assert np.allclose(first.solid(rest @ turn.T + 7.0), again.solid(rest) @ turn.T + 7.0, atol=1e-9)


def test_a_planners_mesh_is_not_that_of_other_networks(pipeline: GarmentPipeline) -> None:
    """The cache knew a garment by its rest pose: whichever networks came first made the mesh of all."""
    rest, skinned = SHORTS.v_template, GarmentPipeline.load([SHORTS], backbone="skinned", certify=False)
    first, other, again = (PlannerMesh.of(one, SHORTS.name, 400).middle(rest) for one in (pipeline, skinned, pipeline))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_garment_that_planners_cannot_have_keeps_no_other_from_them() -> None:
    """A hundred loose pieces can't be drawn with 2,000 triangles; shorts beside them can."""
    shorts, shirt = load_garment("short-pant-male"), load_garment("tshirt-male")
    loose = np.arange(3 * 2400).reshape(-1, 3)
    rows = shirt.faces[: len(loose)].reshape(-1)
    torn = replace(
        shirt,
        faces=torch.as_tensor(loose),
        weights=shirt.weights[rows],
        v_template=shirt.v_template[rows],
        shapedirs=shirt.shapedirs.view(-1, 3, 10)[rows].reshape(-1, 10),
        styledirs=None,
    )
    worn = GarmentPipeline.load([torn, shorts], backbone="skinned", sdf="none", collider=False)
    fittings, obstacles = Fittings(worn), Obstacles()
    frame = SmplFrame(pose=np.zeros((24, 3)))
    dressed = DressedPerson("", frame, worn(frame), fittings, np.eye(3), np.zeros(3))
    moment = Moment("map", 0, (), 0.0, lambda _: 1, 0)
    deadline = time.monotonic() + 120
    while not (sent := list(obstacles.messages([dressed], moment))) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert list(fittings.without_planner) == ["tshirt-male"]
    assert "triangles" in fittings.without_planner["tshirt-male"]
    assert len(sent) == 1


def test_openings_are_those_of_a_garment() -> None:
    with pytest.raises(MeshError, match=r"wanted a garment, as pipeline.garments\[name\], got str"):
        Openings("tshirt-male")  # type: ignore[arg-type]


def test_a_planners_mesh_of_fewer_triangles() -> None:
    coarse = PlannerMesh(SHORTS, 400, half_thickness=0.01)
    assert len(coarse.faces) <= 400
    assert trimesh.Trimesh(coarse.solid(SHORTS.v_template), coarse.faces, process=False).is_watertight
    with pytest.raises(MeshError, match="wanted 100 triangles or more and a positive half thickness, got 2"):
        PlannerMesh(SHORTS, 2)


def test_a_planners_mesh_of_several_poses_is_nearer_in_others(pipeline: GarmentPipeline) -> None:
    stride, sitting = np.zeros((2, 24, 3))
    stride[1, 0], stride[2, 0], stride[5, 0] = 0.4, -0.8, 0.9
    sitting[1:3, 0], sitting[4:6, 0] = -1.4, 1.4
    rng = np.random.default_rng(0)
    meshes = PlannerMesh(SHORTS, 400), PlannerMesh.of(pipeline, SHORTS.name, 400)
    far = []
    for pose in (stride, sitting, *(everyday_pose(rng) for _ in range(8))):
        worn = pipeline(SmplFrame(pose=pose))[SHORTS.name].local.astype(np.float64)
        squares = [
            igl.point_mesh_squared_distance(worn, coarse.middle(worn), coarse.sheet.astype(np.int64))[0]
            for coarse in meshes
        ]
        far.append([np.sqrt(square).mean() for square in squares])
    one, several = np.mean(far, axis=0)
    assert several < 0.98 * one, far
    with pytest.raises(MeshError, match="has no garment 'cape': wanted one of"):
        PlannerMesh.of(pipeline, "cape")


def test_clearance_is_exact_where_it_says_so(pipeline: GarmentPipeline) -> None:
    out = pipeline(standing(arms=1.4))
    ask = Clearance.of(pipeline)
    slow = ExactSdf(pipeline.body.faces)
    slow.update(torch.tensor(out.body))
    for name, found in ask(out).items():
        true = slow.query(torch.tensor(out[name].local)).distance.numpy()
        near = true < ask.reach
        assert near.any()
        assert np.abs(found[near] - true[near]).max() < 1e-6
        assert (found[~near] == np.float32(ask.reach)).all()
        squeezed = out[name].local * np.array([0.9, 1, 0.9], np.float32)  # into the body
        raw = ask.of_garment(name, squeezed)
        inside = slow.query(torch.tensor(squeezed)).distance.numpy()
        assert (inside < 0).any()
        assert np.abs(raw[inside < 0] - inside[inside < 0]).max() < 1e-6
    with pytest.raises(MeshError, match="no garment 'cap' here: wanted one of tshirt-male, short-pant-male"):
        ask.of_garment("cap", out["tshirt-male"].local)


def test_what_another_pipeline_put_out_is_refused(pipeline: GarmentPipeline) -> None:
    frame = standing(arms=1.4)
    other = GarmentPipeline.load(["shirt-male"], backbone="skinned", sdf="none")(frame)
    clearance, contacts, sigma = Clearance.of(pipeline), LimbContacts.of(pipeline), Sigma(pipeline)
    asked: list[Callable[[Any], object]] = [clearance, contacts, lambda output: sigma(frame, output)]
    for ask in asked:
        with pytest.raises(MeshError, match="no garment 'shirt-male' here: wanted one of tshirt-male, short-pant-male"):
            ask(other)
        with pytest.raises(MeshError, match="wanted a pipeline's output of one person, got NoneType"):
            ask(None)


def test_limbs_that_touch_are_told_with_what_they_gave_way(pipeline: GarmentPipeline) -> None:
    ask = LimbContacts.of(pipeline)
    assert ask(pipeline(standing(arms=0.8))) == ()
    depth = []
    for arms in (1.4, 1.45, 1.5):
        contacts = {contact.parts: contact for contact in ask(pipeline(standing(arms=arms)))}
        left, right = (contacts["trunk", f"{side}_upper_arm"] for side in ("left", "right"))
        assert left.centre[0] > 0.1 > -0.1 > right.centre[0]
        assert left.area == pytest.approx(right.area, rel=0.25)  # a body and a mesh aren't quite symmetric
        assert 0 < left.mean_depth <= left.depth < 0.07
        assert 5e-4 < left.area < 0.05
        depth.append(left.depth)
    assert depth == sorted(depth)


def test_a_squat_presses_cloth_between_thigh_and_trunk(pipeline: GarmentPipeline) -> None:
    pose = standing().pose.copy()
    pose[1, 0] = pose[2, 0] = -1.9
    pose[4, 0] = pose[5, 0] = 2.2
    parts = {contact.parts for contact in LimbContacts.of(pipeline)(pipeline(SmplFrame(pose=pose)))}
    assert {("trunk", "left_thigh"), ("trunk", "right_thigh")} <= parts


def first_hits(eye: np.ndarray, targets: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """How far along the way from eye to each target the first triangle is, in units of that way: slow and obvious."""
    a, b, c = (vertices[faces] - eye).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    height = (a * normal).sum(1)
    found = []
    for way in targets - eye:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = height / (normal @ way)
            there = t[:, None] * way
            hit = t > 0
            for p, q in ((a, b), (b, c), (c, a)):
                hit &= (np.cross(q - p, there - p) * normal).sum(1) >= 0
        found.append(t[hit].min() if hit.any() else np.inf)
    return np.array(found)


def test_where_nobody_is_nothing_is_seen() -> None:
    camera = PinholeCamera.looking_at(np.zeros(3), np.array([0.0, 0.0, 2.0]))
    assert all_visible([], camera) == []
    assert np.isinf(depth_image([], camera)).all()
    assert depth_image([], camera).shape == (camera.height, camera.width)
    assert depth_image([], PinholeCamera.looking_at((0, 0, 0), (0, 0, 1), width=8.0, height=6.0)).shape == (6, 8)


def test_visible_agrees_with_rays(pipeline: GarmentPipeline) -> None:
    out = pipeline(standing())
    meshes = [(out[name].vertices, out[name].faces) for name in out]
    meshes.append((out.body + out.transl, pipeline.body.faces.numpy()))
    middle = out["tshirt-male"].vertices.mean(0)
    camera = PinholeCamera.looking_at(middle, middle + np.array([0.8, 0.5, 1.8]))
    seen = all_visible(meshes, camera, buffer_width=640)
    vertices = np.concatenate([v for v, _ in meshes])
    starts = np.cumsum([0, *(len(v) for v, _ in meshes)])
    faces = np.concatenate([f + start for (_, f), start in zip(meshes, starts, strict=False)])
    rows = np.random.default_rng(0).choice(starts[2], 150, replace=False)
    length = np.linalg.norm(vertices[rows] - camera.eye, axis=1)
    true = first_hits(camera.eye, vertices[rows], vertices, faces) * length > length - 2e-3
    assert 0.2 < true.mean() < 0.8
    assert (np.concatenate(seen)[rows] == true).mean() >= 0.96
    assert (visible(*meshes[0], camera, meshes[1:], buffer_width=640) == seen[0]).all()


@pytest.mark.parametrize(
    ("width", "height", "columns", "rows"),
    [(640, 480, 480, 360), (1080, 1920, 480, 853), (480, 32768, 28, 1911), (1, 32768, 1, 32768), (32768, 1, 480, 1)],
)
def test_no_picture_makes_a_huge_depth_buffer(width: int, height: int, columns: int, rows: int) -> None:
    """A camera of 480 x 32,768 pixels, as anybody can publish, held up the node by a second for each frame."""
    camera = PinholeCamera.looking_at([0, 0, 0], [0, 0, 4], width=width, height=height)
    drawn = _buffered(camera, BUFFER_WIDTH)
    assert (drawn.width, drawn.height) == (columns, rows)


def test_what_is_seen_of_two_squares() -> None:
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    camera = PinholeCamera.looking_at([0, 0, 0], [0, 0, 4], fov=1.2)
    behind = 0.5 * square - [0, 0, 1]
    assert visible(square, faces, camera).all()
    assert not visible(behind, faces, camera, [(square, faces)]).any()
    assert visible(behind, faces, camera, [(square + np.array([2.5, 0, 0]), faces)]).all()
    assert not visible(square + np.array([0, 0, 5]), faces, camera).any()  # behind the camera
    assert not visible(square + np.array([50, 0, 0]), faces, camera).any()  # beside the picture
    depth = depth_image([(behind, faces), (square, faces)], camera)
    assert depth[camera.height // 2, camera.width // 2] == pytest.approx(4.0, abs=1e-5)
    assert (np.isinf(depth) | (depth < 4.001)).all()
    assert np.isinf(depth[0, 0])
    far = np.array([2e6, 0, -3e6])
    moved = replace(camera, translation=camera.translation - camera.rotation @ far)
    assert visible(square + far, faces, moved).all()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: OPENINGS.frames(np.zeros((3, 3))), r"the garment's vertices must have the shape \(7662, 3\), got"),
        (lambda: OPENINGS.frames("x"), "must be numbers of the shape"),
        (lambda: OPENINGS.frames(np.full((7662, 3), np.nan)), "must be finite, got 7662 of 7662"),
        (lambda: PinholeCamera.looking_at([0, 0, 0], [0, 1, 0]), "can't have .* in the middle and the y axis up"),
        (lambda: PinholeCamera(0, 1, (1, 1), (0, 0), np.eye(3), np.zeros(3)), "a camera has a size in pixels"),
        (lambda: PinholeCamera(9, 9.5, (1, 1), (0, 0), np.eye(3), np.zeros(3)), "a camera has a size in pixels"),
        (lambda: PinholeCamera(9, 9, (1, 1), (0, 0), 2 * np.eye(3), np.zeros(3)), "a camera has a size in pixels"),
        (lambda: PinholeCamera(9, 9, (1, 1), (0, 0), np.diag([1, 1, -1]), np.zeros(3)), "a camera has .* a rotation"),
    ],
)
def test_bad_input_gets_a_sentence(call, said: str) -> None:
    with pytest.raises(MeshError, match=said):
        call()


@pytest.mark.parametrize("wrong", [None, 5, "x", b"y", [], {}, np.zeros((2, 2)), np.array(["a"]), len])
@pytest.mark.parametrize(
    "call",
    [
        *(Clearance.of, LimbContacts.of, Fittings, Sigma, Observer, lambda x: PlannerMesh.of(x, "tshirt-male")),
        *(Openings, PlannerMesh, load_sigma, lambda x: fit_sigma(x, np.ones((40, 5)), np.zeros((40, 24, 3)))),
        *(lambda x: Clearance(x, {}), lambda x: LimbContacts(load_body("male"), {"tshirt-male": x})),
        *(lambda x: visible(np.zeros((3, 3)), [[0, 1, 2]], x), lambda x: depth_image([], x)),
        lambda x: PlannerMesh(load_garment("tshirt-male"), half_thickness=[x]),
        lambda x: PinholeCamera.looking_at((0, 0, 0), (0, 0, 3), fov=x),
        lambda x: PinholeCamera(9, 9, x, (0, 0), np.eye(3), np.zeros(3)),
        lambda x: PinholeCamera(9, 9, (1, 1), (0, 0), x, np.zeros(3)),
    ],
)
def test_another_type_gets_a_sentence(call, wrong: object) -> None:
    with pytest.raises(RefuError):
        call(wrong)
