"""Garments of one's own: reading and cleaning meshes, finding their place, what they take over from the skin."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from outside_meshes import Outside, Wanted, cloth, quads_of_a_skirt, write_obj

from refu_core import GarmentError, GarmentPipeline, SmplFrame, load_body, load_garment
from refu_core.fitting import (
    GarmentDetails,
    Placing,
    PosedBody,
    SurfaceMesh,
    Transfer,
    fit_garment,
    read_surface,
    standing_pose,
)
from refu_core.fitting._clean import clean, components, split_long_edges
from refu_core.fitting._pieces import slivers, unsewn, without_bodies
from refu_core.fitting._place import find_places
from refu_core.garments import UvMap, save_garment
from refu_core.mesh import Connectivity, vertex_normals


def tube(rows: int = 12, columns: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """An open cylinder of triangles, its faces outward."""
    angle, height = np.meshgrid(2 * np.pi * np.arange(columns) / columns, np.linspace(0, 1, rows))
    v = np.stack((0.2 * np.sin(angle), height, 0.2 * np.cos(angle)), -1).reshape(-1, 3)
    a = np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    b = np.roll(a, -1, 1)
    quads = np.stack((a, b, b + columns, a + columns), -1).reshape(-1, 4)
    return v, np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]))


def volume_of_edges(f: np.ndarray) -> int:
    """How many edges two faces run through in the same direction."""
    pairs = np.stack((f, np.roll(f, -1, 1)), -1).reshape(-1, 2)
    return len(pairs) - len(np.unique(pairs, axis=0))


AS_IS = Placing(1.0, "y", standing_pose(0.0), is_placed=True)


# -- cleaning


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_mesh_that_was_taken_apart_is_put_together(seed: int) -> None:
    """A soup of faces, some turned over, some double, in any order, at any size, is the surface that it was."""
    rng = np.random.default_rng(seed)
    v, f = tube()
    scale = 10.0 ** rng.uniform(-3, 3)
    soup = v[f] * scale
    turned = rng.random(len(f)) < 0.4
    soup[turned] = soup[turned][:, ::-1]
    soup = np.concatenate((soup, soup[rng.choice(len(f), 9, replace=False)]))[rng.permutation(len(f) + 9)]
    mesh, notes = clean(SurfaceMesh(soup.reshape(-1, 3), np.arange(3 * len(soup)).reshape(-1, 3)))
    assert len(mesh.vertices) == len(v)
    assert len(mesh.faces) == len(f)
    assert volume_of_edges(mesh.faces) == 0
    connectivity = Connectivity.of(mesh.faces)
    assert connectivity.n_faces_of_edge.max() == 2
    assert len(connectivity.boundary) == 2 * 24
    assert any("9 faces were there twice" in note for note in notes)


def test_a_clean_mesh_is_left_alone() -> None:
    garment = load_garment("short-pant-male")
    v, f = garment.v_template.double().numpy(), garment.faces.numpy()
    mesh, notes = clean(SurfaceMesh(v, f))
    assert notes == []
    np.testing.assert_array_equal(mesh.vertices, v)
    np.testing.assert_array_equal(mesh.faces, f)


def test_edges_of_three_faces_are_cut_open() -> None:
    v, f = tube()
    ruffle = np.array([[v[60, 0] * 2, v[60, 1], v[60, 2] * 2]])
    mesh, notes = clean(SurfaceMesh(np.concatenate((v, ruffle)), np.concatenate((f, [[60, 61, len(v)]]))))
    assert Connectivity.of(mesh.faces).n_faces_of_edge.max() == 2
    assert components(mesh.faces, len(mesh.vertices))[0] == 2
    assert len(mesh.vertices) == len(v) + 3
    assert any("more than two faces" in note for note in notes)


def test_what_has_one_side_is_refused() -> None:
    n = 30
    t = 2 * np.pi * np.arange(n) / n
    along = np.stack((np.cos(t), np.sin(t), 0 * t), 1)
    across = 0.2 * np.stack((np.cos(t / 2) * np.cos(t), np.cos(t / 2) * np.sin(t), np.sin(t / 2)), 1)
    v = np.concatenate((along - across, along + across))
    a, b = np.arange(n), (np.arange(n) + 1) % n
    c, d = a + n, b + n
    b[-1], d[-1] = n, 0  # half a turn
    f = np.concatenate((np.stack((a, b, d), 1), np.stack((a, d, c), 1)))
    with pytest.raises(GarmentError, match="one side only"):
        clean(SurfaceMesh(v, f))


def test_long_edges_are_split_with_their_texture() -> None:
    v, f = tube(4, 12)
    uv = v[:, :2].astype(np.float32)  # linear in the place: it must stay so
    mesh = SurfaceMesh(v, f, type(load_uv(v, f))(uv, f))
    fine = split_long_edges(mesh, 0.04)
    assert fine.uv is not None
    ends = fine.vertices[Connectivity.of(fine.faces).edges]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() <= 0.04
    np.testing.assert_allclose(fine.uv.coordinates[fine.uv.faces], fine.vertices[fine.faces][..., :2], atol=1e-6)
    assert volume_of_edges(fine.faces) == 0

    def area(m: SurfaceMesh) -> float:
        return float(trimesh.Trimesh(m.vertices, m.faces, process=False).area)

    assert area(fine) == pytest.approx(area(mesh), rel=1e-9)


def load_uv(v: np.ndarray, f: np.ndarray):
    """Texture coordinates of each vertex."""
    from refu_core.garments import UvMap

    return UvMap(v[:, :2].astype(np.float32), f)


# -- files


def test_polygons_and_textures_of_an_obj(tmp_path: Path) -> None:
    places = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    text = places + "f 1/1 2/2 3/3 4/4\nf -4/2 -1/1 -3/3\n"
    (tmp_path / "a.obj").write_text(text)
    mesh = read_surface(tmp_path / "a.obj")
    assert len(mesh.faces) == 3
    assert mesh.faces[2].tolist() == [1, 4, 2]
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.uv.coordinates[mesh.uv.faces[:2]], mesh.vertices[mesh.faces[:2]][..., :2])


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        ("", "an empty file"),
        ("v 0 0 0\n", "it has no faces"),
        ("v 0 0 0\nv 1 0 0\nf 1 2 3\n", "a face names vertex 3 of 2"),
        ("v 0 0 x\n", "line 1"),
        ("v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n", "NaN or infinite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -9\n", "line 4"),
    ],
)
def test_files_that_hold_no_mesh_are_refused(content: str, wanted: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(content)
    with pytest.raises(GarmentError, match=wanted):
        read_surface(tmp_path / "a.obj")
    (tmp_path / "a.ply").write_text("ply\n" + content)
    with pytest.raises(GarmentError, match=r"a\.ply"):
        read_surface(tmp_path / "a.ply")
    with pytest.raises(GarmentError, match=r"wanted a mesh \(\.obj"):
        read_surface(tmp_path / "a.txt")


# -- what is taken over


@pytest.fixture(scope="module")
def at_rest() -> dict[str, PosedBody]:
    return {name: PosedBody(load_body(name), np.zeros((24, 3))) for name in ("male", "female")}


@pytest.mark.parametrize("name", ["tshirt-male", "skirt-female"])
def test_weights_and_shapes_are_those_of_garments_that_were_made_by_hand(name: str, at_rest) -> None:
    garment = load_garment(name)
    posed = at_rest[garment.body]
    transfer = Transfer.of(garment.v_template.double().numpy(), garment.faces.numpy(), posed)
    weights = transfer(posed.body.weights.double().numpy(), length=0.012)
    assert weights.min() > -1e-9
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-9)
    differs = np.abs(weights - garment.weights.numpy()).sum(1)
    assert differs.mean() < 0.15
    assert np.quantile(differs, 0.95) < 0.35
    shaped = (posed.body.rest_vertices(torch.eye(10)) - posed.body.v_template).permute(1, 2, 0).double().numpy()
    found = transfer(shaped.reshape(len(shaped), -1), length=0.03).reshape(-1, 3, 10)
    wanted = garment.shapedirs.view(-1, 3, 10).numpy()
    assert np.linalg.norm(found - wanted, axis=1).mean() < 0.002  # [m]
    # No arm moves the trunk more than the tailor lets it.
    arms = weights[:, 16:].sum(1) - garment.weights[:, 16:].sum(1).numpy()
    assert arms[np.abs(garment.v_template[:, 0].numpy()) < 0.15].max(initial=0) < 0.15


def test_what_is_constant_stays_so_and_what_is_linear_is_followed(at_rest) -> None:
    posed = at_rest["female"]
    garment = load_garment("tshirt-female")
    transfer = Transfer.of(garment.v_template.double().numpy(), garment.faces.numpy(), posed)
    skin = posed.vertices.double().numpy()
    np.testing.assert_allclose(transfer(np.ones((len(skin), 1)), length=0.02), 1, atol=1e-9)
    height = transfer(skin[:, 1:2], length=0.012)[:, 0]
    assert np.abs(height - garment.v_template[:, 1].numpy()).mean() < 0.01


@pytest.mark.parametrize(("joints", "reach"), [((20, 21, 22, 23), 0.0), ((7, 8, 10, 11), 0.0), ((1, 2, 4, 5), 0.5)])
def test_pairs_of_pieces_follow_what_each_of_them_is_on(joints: tuple[int, ...], reach: float, at_rest) -> None:
    """Gloves, socks, and stockings up to where thighs touch: the left one's weights are those of the left one alone."""
    posed = at_rest["female"]
    weights = posed.body.weights.double().numpy()
    skin, faces = posed.vertices.double().numpy(), posed.body.faces.numpy()
    skin = skin + 0.01 * vertex_normals(skin, faces.astype(np.int32))
    is_on = (weights[:, list(joints)].sum(1) > 0.5) & (skin[:, 1] < skin[:, 1].max() * (1 - reach))
    is_on &= np.abs(skin[:, 0]) > 0.01 + 0.02 * (reach > 0)  # 6 cm apart at least
    kept = faces[is_on[faces].all(1)]
    side = skin[kept].mean(1)[:, 0] > 0

    def found(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        used, local = np.unique(f, return_inverse=True)
        return used, Transfer.of(skin[used], local.reshape(-1, 3), posed)(weights, length=0.012)

    both, alone = found(kept), found(kept[side])
    np.testing.assert_allclose(both[1][np.isin(both[0], alone[0])], alone[1], atol=1e-6)


# -- placing


@pytest.mark.parametrize(("unit", "up", "arms"), [(100.0, "z", 0.0), (1000.0, "y", 0.75), (39.37, "z", 0.75)])
def test_unit_axes_floor_and_pose_are_found(unit: float, up: str, arms: float) -> None:
    garment, body = load_garment("tshirt-male"), load_body("male")
    posed = body(torch.as_tensor(standing_pose(arms), dtype=torch.float32)[None])
    there = garment.pose(garment.v_template[None], posed.transforms)[0].double().numpy()
    v = there - [0, float(posed.vertices[0, :, 1].min()), 0]
    if up == "z":
        v = np.stack((v[:, 0], -v[:, 2], v[:, 1]), 1)
    mesh = SurfaceMesh(unit * v, garment.faces.numpy())
    place = next(find_places(mesh, body, Placing()))
    np.testing.assert_allclose(place(mesh.vertices), there, atol=0.004)
    assert place.pose[17, 2] == pytest.approx(arms, abs=0.12)


def test_a_mesh_that_says_what_it_is_isnt_moved() -> None:
    garment, body = load_garment("tshirt-male"), load_body("male")
    mesh = SurfaceMesh(garment.v_template.double().numpy(), garment.faces.numpy())
    fitted = fit_garment(mesh, body, name="mine", details=GarmentDetails(layer=3, held_at="shoulders"))
    assert fitted.notes == []
    torch.testing.assert_close(fitted.template.v_template, garment.v_template, atol=1e-6, rtol=0)
    assert (fitted.template.card.layer, fitted.template.card.held_at_waist) == (3, False)


@pytest.mark.parametrize(
    ("mesh", "placing", "wanted"),
    [
        (trimesh.creation.box(extents=(0.3, 0.3, 0.3)), AS_IS, "surround the body|had to move|mm inside"),
        (trimesh.creation.icosphere(radius=0.4), AS_IS, "surround the body male|had to move by"),
        (trimesh.creation.icosphere(radius=50), Placing(unit=1.0), "100 units = 100 m large: wanted a garment of"),
    ],
    ids=["box", "ball", "huge"],
)
def test_what_is_no_garment_is_refused(mesh: trimesh.Trimesh, placing: Placing, wanted: str) -> None:
    surface = SurfaceMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
    with pytest.raises(GarmentError, match=wanted):
        fit_garment(surface, load_body("male"), name="ball", placing=placing)


def test_a_pose_that_it_isnt_in_is_refused() -> None:
    v, f = cloth(Wanted(sleeve=0.9, arms=1.0, step=0.025))
    body = load_body("neutral")
    v = v + np.array([0, float(body.v_template[:, 1].min()), 0])
    with pytest.raises(GarmentError, match="--pose"):
        fit_garment(SurfaceMesh(v, f), body, name="coat", placing=Placing(1.0, "y", standing_pose(0.0), is_placed=True))


# -- pieces


def test_a_character_s_body_is_left_out_of_its_clothes_and_is_no_garment() -> None:
    """Of other proportions than the wearer's, in centimetres, with a texture."""
    shirt, body, wearer = load_garment("tshirt-male"), load_body("male"), load_body("neutral")
    betas = torch.zeros(1, 10)
    betas[0, 1] = 1.0
    parts = [
        (shirt.rest(betas, torch.zeros(1, 4))[0].numpy(), shirt.faces.numpy()),
        (body.rest_vertices(betas)[0].numpy(), body.faces.numpy()),
    ]
    v = 100 * np.concatenate([part for part, _ in parts]).astype(np.float64)
    f = np.concatenate((parts[0][1], parts[1][1] + len(parts[0][0])))
    both = SurfaceMesh(v, f, UvMap(np.zeros((len(v), 2), np.float32), f.copy()))
    fitted = fit_garment(both, wearer, name="character", longest_edge=0.05)
    assert [note for note in fitted.notes if "left out" in note] == [
        "a piece with head, hands and feet was taken for the wearer's body and left out"
    ]
    assert fitted.template.n_vertices == shirt.n_vertices
    assert fitted.template.uv is not None
    assert len(fitted.template.uv.faces) == len(shirt.faces)
    with pytest.raises(GarmentError, match="it is a body with head, hands and feet"):
        fit_garment(SurfaceMesh(parts[1][0].astype(np.float64), parts[1][1], None), wearer, name="body", placing=AS_IS)
    skin, faces = wearer.v_template.double().numpy(), wearer.faces.numpy()
    overall = SurfaceMesh(1.01 * skin, faces[skin[faces][:, :, 1].max(1) < 0.36]).compact()  # its collar is at the chin
    assert without_bodies(overall, overall.vertices, PosedBody(wearer, np.zeros((24, 3))))[1] == []


@pytest.mark.parametrize(("gap", "is_said"), [(0.0, False), (0.002, True), (0.03, False)])
def test_panels_that_nobody_sewed_are_said(gap: float, is_said: bool) -> None:
    v, f = tube()
    is_left = v[f].mean(1)[:, 0] < 0
    panels = [np.unique(f[part], return_inverse=True) for part in (is_left, ~is_left)]
    v = np.concatenate([v[used] + (side * gap / 2, 0, 0) for (used, _), side in zip(panels, (-1, 1), strict=True)])
    f = np.concatenate([panels[0][1].reshape(-1, 3), panels[1][1].reshape(-1, 3) + len(panels[0][0])])
    notes = unsewn(clean(SurfaceMesh(v, f, None))[0])
    said = [note.partition(", and")[0] for note in notes]
    assert said == (["2 pieces lie along each other, 2.0 mm apart"] if is_said else [])


def test_slivers_are_said() -> None:
    assert slivers(SurfaceMesh(*tube())) == []
    (note,) = slivers(SurfaceMesh(*cloth(Wanted(step=0.014))))
    assert note.startswith("it has slivers: 1 % of its edges are shorter than 0.5 mm, half are longer than 14")


# -- the whole way


def test_a_skirt_of_quads_is_worn_saved_and_loaded(tmp_path: Path) -> None:
    v, quads = quads_of_a_skirt(24, 72)
    angle = np.arctan2(v[:, 0], v[:, 2])
    uv = np.stack((angle, v[:, 1]), 1)
    path = write_obj(tmp_path / "kilt.obj", Outside(v, quads, uv, quads))
    fitted = fit_garment(read_surface(path), load_body("female"), name="kilt", longest_edge=0.03)
    template = fitted.template
    assert template.card.held_at_waist
    assert template.uv is not None
    saved = save_garment(template, tmp_path / "kilt.npz")
    loaded = load_garment(saved)
    np.testing.assert_allclose(loaded.v_template, template.v_template, atol=1e-6)
    np.testing.assert_allclose(loaded.weights, template.weights, atol=3e-5)
    np.testing.assert_array_equal(loaded.uv.faces, template.uv.faces)
    assert loaded.card == template.card
    worn = GarmentPipeline.load([loaded, "tshirt-female"])
    assert worn.untrained == ("kilt",)
    output = worn(SmplFrame(pose=standing_pose(0.9)))
    assert {stats.n_unresolved for stats in output.stats.garments.values()} == {0}
    assert np.isfinite(output["kilt"].local).all()
    with pytest.raises(GarmentError, match=r"wanted the path of an \.npz"):
        save_garment(replace(template, name="x"), tmp_path / "kilt.obj")


def test_what_is_held_at_the_waist_is_no_poncho() -> None:
    """A wide cone fits round the shoulders, too, and nearer there; its origin is elsewhere."""
    angle, down = (grid.ravel() for grid in np.meshgrid(np.arange(60) * np.pi / 30, np.linspace(0, 1, 30)))
    radius, away = 0.19 + 0.16 * down, np.array((3.0, 7.0, -2.0))
    places = np.stack((radius * np.cos(angle), -0.12 - 0.63 * down, 0.85 * radius * np.sin(angle)), 1) + away
    row, column = (grid.ravel() for grid in np.mgrid[:29, :60])
    a, b = 60 * row + column, 60 * row + (column + 1) % 60
    mesh = SurfaceMesh(places, np.concatenate((np.stack((a, b, a + 60), 1), np.stack((b, b + 60, a + 60), 1))))
    made = fit_garment(
        mesh, load_body("female"), name="cone", placing=Placing(unit=1.0), details=GarmentDetails(held_at="waist")
    )
    np.testing.assert_allclose(made.template.v_template.mean(0), (places - away).mean(0), atol=0.06)


def test_a_childs_shirt_is_made_larger_and_not_worn_round_the_ankles() -> None:
    v, f = cloth(Wanted(low=0.80, ease=0.018, sleeve=0.4, step=0.02))
    made = fit_garment(SurfaceMesh(0.7 * v, f), load_body("neutral"), name="shirt")
    assert any("scaled by" in note for note in made.notes)
    heights = made.template.v_template[:, 1]
    assert float(heights.min()) > -0.5
    assert float(heights.max()) > 0.25  # the collar


def test_shreds_are_refused_before_they_take_minutes() -> None:
    v, f = cloth(Wanted(low=0.80, ease=0.018, step=0.025))
    apart = v[f].reshape(-1, 3) + np.random.default_rng(0).normal(0, 1e-4, (f.size, 3))
    shreds = SurfaceMesh(apart, np.arange(f.size).reshape(-1, 3))
    begun = time.process_time()
    said = r"it is in \d+ pieces, at most 1000 are worn: merge the vertices .*, or leave out what is tiny"
    with pytest.raises(GarmentError, match=said):
        fit_garment(shreds, load_body("neutral"), name="shreds")
    assert time.process_time() - begun < 10


def test_a_hat_isnt_held_at_the_waist() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.13)
    upper = ball.vertices[ball.faces].mean(axis=1)[:, 1] > 0
    hat = SurfaceMesh(ball.vertices + np.array([0, 1.60, 0.04]), ball.faces[upper])
    made = fit_garment(hat, load_body("neutral"), name="hat")
    assert not made.template.card.held_at_waist
