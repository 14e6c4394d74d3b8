"""Where garments belong that were modelled loosely, lying down, or upside down; and what is doubted."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from outside_meshes import Wanted, button, cloth, together
from scipy.spatial.transform import Rotation

from refu_core import GarmentError, load_body, load_garment
from refu_core.body import apply_transforms, blend_transforms
from refu_core.fitting import Placing, SurfaceMesh, _fit, fit_garment, standing_pose
from refu_core.fitting._clean import components, no_opening, open_pieces
from refu_core.fitting._found import Place
from refu_core.fitting._pieces import without_floor, without_specks
from refu_core.fitting._place import _at, _Search, _Way, find_places
from refu_core.fitting._posed import PosedBody
from refu_core.fitting._surround import opens_behind, parts_legs
from refu_core.fitting._ways import ROUND
from refu_core.mesh import rim_of, vertex_normals

SHIRT = Wanted(low=0.66, sleeve=0.6, step=0.028)
F64 = NDArray[np.float64]


def cone(low: tuple[float, float], high: tuple[float, float], *, rows: int = 40, n: int = 64) -> SurfaceMesh:
    """An open cone round the body, facing outward, of radii at heights above a floor at 0 [m]."""
    t, angle = np.linspace(0, 1, rows)[:, None], np.linspace(0, 2 * np.pi, n, endpoint=False)
    radius, height = low[0] + (high[0] - low[0]) * t, low[1] + (high[1] - low[1]) * t
    v = np.stack((radius * np.sin(angle), height + 0 * angle, 0.035 + 0.9 * radius * np.cos(angle)), -1).reshape(-1, 3)
    a = np.arange(n * (rows - 1)).reshape(rows - 1, n)
    b = np.roll(a, -1, axis=1)
    return SurfaceMesh(v, np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((a, b, b + n), (a, b + n, a + n))]))


@pytest.mark.parametrize("turn", ["x 180", "z 90"])
def test_a_shirt_that_lies_or_stands_on_its_head_is_put_upright(turn: str) -> None:
    """It was worn on one hand, like a bucket."""
    v, f = cloth(SHIRT)
    axis, angle = turn.split()
    lies = Rotation.from_euler(axis, int(angle), degrees=True).apply(v)
    made = fit_garment(SurfaceMesh(lies, f), load_body("neutral"), name="shirt", longest_edge=0.1)
    assert made.warnings == []
    assert any("x is up" in note or "-y is up" in note for note in made.notes)
    worn = made.template.v_template.double().numpy()
    sleeves = worn[np.abs(worn[:, 0]) > 0.3]
    assert sleeves[:, 1].mean() - worn[:, 1].mean() > 0.15
    assert worn[:, 1].mean() == pytest.approx(0.04, abs=0.06)


def test_a_shirt_isnt_worn_on_a_hand() -> None:
    v, f = cloth(SHIRT)
    lies = Rotation.from_euler("z", 90, degrees=True).apply(v)
    with pytest.raises(GarmentError, match="doesn't surround the body"):
        fit_garment(SurfaceMesh(lies, f), load_body("neutral"), name="shirt", placing=Placing(unit=1.0, up="y"))


@pytest.mark.parametrize("name", ["trousers-female", "short-pant-male", "skirt-female", "dress-female"])
@pytest.mark.parametrize("legs", [0.0, 0.1, 0.3])
def test_cloth_between_legs_is_seen_however_they_stand(name: str, legs: float) -> None:
    garment = load_garment(name)
    body = load_body(garment.body)
    transforms = body(torch.as_tensor(standing_pose(0.0, legs), dtype=torch.float32)[None]).transforms
    posed = apply_transforms(garment.v_template[None], blend_transforms(garment.weights, transforms))[0]
    assert parts_legs(posed.double().numpy(), garment.faces.numpy(), body) == (
        "skirt" not in name and "dress" not in name
    )


@pytest.mark.parametrize(("low", "high"), [((0.45, 0.02), (0.16, 1.0)), ((0.8, 0.02), (0.16, 1.0))])
def test_a_wide_skirt_says_nothing_of_legs(low: tuple[float, float], high: tuple[float, float]) -> None:
    """A cone was taken for one that was modelled round spread legs, and creased when they were put together."""
    place = next(find_places(cone(low, high), load_body("neutral"), Placing()))
    assert not place.pose[1:3].any()
    assert (place.unit, place.kind) == (1.0, "floor")


@pytest.mark.parametrize(("low", "high"), [((0.30, 0.3), (0.155, 1.0)), ((0.42, 0.85), (0.075, 1.43))])
def test_what_is_loose_is_not_made_smaller(low: tuple[float, float], high: tuple[float, float]) -> None:
    """A skirt and a poncho in metres, each with its origin in its middle, fit better if they are smaller."""
    mesh = cone(low, high)
    centred = SurfaceMesh(mesh.vertices - (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2, mesh.faces)
    made = fit_garment(centred, load_body("neutral"), name="loose", longest_edge=0.1)
    assert not any("scaled by" in note for note in made.notes)


def narrow_tube(high: float) -> SurfaceMesh:
    """A dress that is narrower than the chest, in metres, on a floor, up to some height [m]."""
    mesh = cone((0.18, 0.13), (0.155, high), rows=60)
    return SurfaceMesh(mesh.vertices * [1, 1, 0.75 / 0.9], mesh.faces)


def test_a_narrow_dress_in_metres_is_not_made_larger() -> None:
    """It was made a quarter larger, and the arms went through it."""
    made = fit_garment(narrow_tube(1.26), load_body("neutral"), name="strapless", longest_edge=0.1)
    assert made.warnings == []
    assert "it stood with the floor at 0 and was moved to the body's feet" in made.notes
    assert not any("scaled by" in note for note in made.notes)


@pytest.mark.parametrize("off", [0.02, 0.05, 0.08])
def test_a_ring_around_the_hips_stays_there(off: float) -> None:
    """Of so low a band hardly any skin is within; a wide one was taken down to the feet."""
    skin = load_body("female").v_template.double().numpy()
    hips = skin[(skin[:, 1] > -0.18) & (skin[:, 1] < -0.1) & (np.abs(skin[:, 0]) < 0.3)]
    middle, half = (hips.max(0) + hips.min(0)) / 2, (hips.max(0) - hips.min(0)) / 2 + off
    band = cone((1.0, -0.18), (1.0, -0.1), rows=4, n=24)
    v = band.vertices * (half[0], 1, half[2] / 0.9) + (middle[0], 0, middle[2] - 0.035 * half[2] / 0.9)
    place = next(find_places(SurfaceMesh(v, band.faces), load_body("female"), Placing()))
    assert place.unit == 1
    np.testing.assert_array_equal(place.turn, np.eye(3))
    np.testing.assert_array_equal(place.shift, 0)


def test_what_cannot_be_where_it_belongs_is_worn_nowhere_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dress that is narrower than the shoulders, and reaches over them, was worn on the head, and above it: in metres
    on a floor it has its middle there, if its origin is taken for the body's."""
    tried = []

    def told(*asked: Any) -> Iterator[Place]:
        for place in find_places(*asked):
            tried.append(place)
            yield place

    monkeypatch.setattr(_fit, "find_places", told)
    body = load_body("neutral")
    with pytest.raises(GarmentError, match="was made for another body or pose"):
        fit_garment(narrow_tube(1.38), body, name="tube", longest_edge=0.1)
    assert tried
    head = float(body.v_template[:, 1].max())
    assert max(place.top for place in tried) < head + 0.35
    with pytest.raises(GarmentError, match=r"it reaches higher than it can.* or leave --as-placed out"):
        next(find_places(narrow_tube(1.38), body, Placing(unit=1.0, up="y", is_placed=True)))


def fitted_at(places: list[Place], mesh: SurfaceMesh, monkeypatch: pytest.MonkeyPatch) -> _fit.FittedGarment:
    monkeypatch.setattr(_fit, "find_places", lambda *_: iter(places))
    return fit_garment(mesh, load_body("neutral"), name="shirt", longest_edge=0.1)


def test_a_place_that_fits_much_worse_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A two-piece suit was worn as a rag between the legs, because an arm went through a sleeve where it belongs."""
    mesh = SurfaceMesh(*cloth(SHIRT))
    there = next(find_places(mesh, load_body("neutral"), Placing()))
    beside = replace(there, shift=there.shift + np.array([0.08, 0.0, 0.0]))
    wide = replace(there, fit=replace(there.fit, distance=0.4))
    assert fitted_at([beside, there], mesh, monkeypatch).warnings == []
    with pytest.raises(GarmentError, match="was made for another body or pose"):
        fitted_at([beside, wide], mesh, monkeypatch)


def test_cloth_that_is_torn_is_worn_where_it_fits_better(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dresses in no unit were worn as tents in metres, with hanging arms in them, and torn as the arms were lifted."""
    mesh = SurfaceMesh(*cloth(SHIRT))
    there = next(find_places(mesh, load_body("neutral"), Placing()))
    middle = there.unit * mesh.vertices.mean(0)
    tent = replace(there, unit=2.5 * there.unit, pose=standing_pose(1.2), shift=there.shift - 1.5 * middle)
    tent = replace(tent, fit=replace(there.fit, distance=0.3))
    assert fitted_at([tent, there], mesh, monkeypatch).warnings == []
    made = fitted_at([tent, replace(there, fit=replace(there.fit, distance=0.9))], mesh, monkeypatch)
    assert any("bringing it into the T-pose stretched" in text for text in made.warnings)


def test_cloth_that_is_torn_as_arms_are_lifted_is_doubted() -> None:
    """A loose cone over arms that hang: what lies on them goes with them, and what is beside them doesn't."""
    placing = Placing(unit=1.0, pose=standing_pose(1.2))
    mesh = cone((0.42, 0.85), (0.085, 1.43))
    made = fit_garment(mesh, load_body("neutral"), name="loose", placing=placing, longest_edge=0.1)
    assert any("bringing it into the T-pose stretched" in text for text in made.warnings)


@pytest.mark.parametrize(
    ("name", "angles"),
    [
        ("longsleeve-male", (0.7, 0.0, 0.18)),
        ("longsleeve-male", (0.8, 0.0, 0.8, 0.25)),
        ("trousers-female", (0.0, 0.1)),
        ("trousers-female", (0.6, 0.44)),
    ],
)
def test_bent_elbows_and_spread_legs_are_found(name: str, angles: tuple[float, ...]) -> None:
    """Sleeves round bent elbows were worn on straight ones, and trousers of spread legs were scaled, or refused."""
    garment = load_garment(name)
    body, pose = load_body(garment.body), standing_pose(*angles)
    transforms = body(torch.as_tensor(pose, dtype=torch.float32)[None]).transforms
    posed = apply_transforms(garment.v_template[None], blend_transforms(garment.weights, transforms))[0]
    place = next(find_places(SurfaceMesh(posed.double().numpy(), garment.faces.numpy()), body, Placing()))
    assert place.unit == 1
    joints = [17, 19] if "sleeve" in name else [1]
    np.testing.assert_allclose(place.pose[joints], pose[joints], atol=0.09)


@pytest.mark.parametrize(
    ("name", "scale", "up", "arms"),
    [
        ("tshirt-female", 1.055, 1.079, 0.0),
        ("tshirt-female", 0.95, 1.079, 0.8),
        ("longsleeve-male", 1.0, -0.06, 0.0),
        ("tshirt-female", 1.0, -0.12, 0.8),
    ],
)
@pytest.mark.parametrize("is_said", [False, True])
def test_other_wearers_and_origins(name: str, scale: float, up: float, arms: float, is_said: bool) -> None:
    """A T-shirt of a taller woman was taken to have hanging arms, that of a shorter one spread legs; a shirt with its
    origin 6 cm off was worn around the ankles."""
    garment = load_garment(name)
    body, pose = load_body(garment.body), standing_pose(arms)
    transforms = body(torch.as_tensor(pose, dtype=torch.float32)[None]).transforms
    posed = apply_transforms(garment.v_template[None], blend_transforms(garment.weights, transforms))[0]
    mesh = SurfaceMesh(scale * (posed.double().numpy() + np.array([0, up, 0])), garment.faces.numpy())
    place = next(find_places(mesh, body, Placing(pose=pose if is_said else None)))
    shoulders = float(body.joint_template[[16, 17], 1].mean())
    assert place.unit == 1
    assert scale * (shoulders + up) + place.shift[1] == pytest.approx(shoulders, abs=0.02)
    np.testing.assert_allclose(place.pose, pose, atol=0.12)


def test_what_stands_far_off_is_not_lifted() -> None:
    """Trousers with their origin near their middle were put a third of a metre up from the floor, below the hips."""
    garment = load_garment("trousers-neutral")
    v = garment.v_template.double().numpy()
    middle = (v.min(0) + v.max(0)) / 2
    places = find_places(SurfaceMesh(v - middle + 0.005, garment.faces.numpy()), load_body("neutral"), Placing())
    assert [place.lift for place in itertools.islice(places, 2)] == [0, 0]


@pytest.mark.parametrize("size", [None, 1.0])
def test_an_origin_in_the_middle_says_nothing_of_the_place(size: float | None) -> None:
    """The T-shirt was worn back to front, 6 cm too high, as if its origin were the body's; or was 1 m long."""
    garment = load_garment("tshirt-female")
    body = load_body("female")
    transforms = body(torch.as_tensor(standing_pose(0.5), dtype=torch.float32)[None]).transforms
    v = apply_transforms(garment.v_template[None], blend_transforms(garment.weights, transforms))[0].double().numpy()
    extent = np.ptp(v, axis=0).max()
    v = (v - (v.min(0) + v.max(0)) / 2) * (1 if size is None else size / extent)
    place = next(find_places(SurfaceMesh(v, garment.faces.numpy()), body, Placing()))
    np.testing.assert_array_equal(place.turn, np.eye(3))
    assert place.unit * np.ptp(v, axis=0).max() == pytest.approx(extent, rel=0.05)


def test_the_origin_of_what_has_no_unit_says_nothing() -> None:
    """A jacket of size 2 whose origin was nearly its middle was taken to be 2 m wide and to stand where it belongs."""
    v, f = cloth(SHIRT)
    v = (v - (v.min(0) + v.max(0)) / 2) * 2 / np.ptp(v, axis=0).max() + [0.0, 0.005, 0.0]
    place = next(find_places(SurfaceMesh(v, f), load_body("neutral"), Placing()))
    assert place.kind == "searched"


def test_a_round_length_on_the_body_is_no_norm() -> None:
    """A pair of socks was refused whose outer sides were 0.4997 m apart, and a skirt 0.5 m long was scaled."""
    assert next(find_places(cone((0.22, 0.46), (0.175, 0.96)), load_body("female"), Placing())).kind == "floor"


def test_what_is_said_is_not_overruled() -> None:
    """A tube of which a third faces the other way was refused, although all was said."""
    body, mesh = load_body("neutral"), cone((0.3, -0.6), (0.3, -0.1))
    kept = np.arange(len(mesh.faces)) % 3 > 0
    flipped = np.where(kept[:, None], mesh.faces, mesh.faces[:, ::-1])
    soup = SurfaceMesh(mesh.vertices[flipped].reshape(-1, 3), np.arange(flipped.size).reshape(-1, 3))
    said = Placing(1.0, "y", standing_pose(0.0), is_placed=True)
    place = next(find_places(soup, body, said))
    assert not place.fit.is_good
    beside = SurfaceMesh(soup.vertices + np.array([1.5, 0, 0]), soup.faces)
    with pytest.raises(GarmentError, match="doesn't surround the body"):
        next(find_places(beside, body, said))


def test_only_a_ball_has_no_opening() -> None:
    ball, ring = trimesh.creation.icosphere(subdivisions=2), trimesh.creation.torus(1.0, 0.3)
    assert no_opening(np.asarray(ball.faces, dtype=np.int64))
    assert not no_opening(np.asarray(ball.faces[1:], dtype=np.int64))
    assert not no_opening(np.asarray(ring.faces, dtype=np.int64))


@pytest.mark.parametrize("taller", [1.0, 1.04])
def test_a_taller_wearer_s_clothes_are_as_large_as_they_were_for_him(taller: float) -> None:
    """In centimetres, with eyes: with him, they were made larger than the body, until his skin was outside of it."""
    shirt, body = load_garment("tshirt-male"), load_body("male")
    skin = body.v_template.double().numpy()
    front = float(skin[skin[:, 1] > skin[:, 1].max() - 0.2, 2].max())
    eyes = [np.array([side * 0.032, skin[:, 1].max() - 0.11, front - 0.02]) for side in (-1, 1)]
    v, f = together(
        [
            (shirt.v_template.double().numpy(), shirt.faces.numpy()),
            (skin, body.faces.long().numpy()),
            *(button(at, 0.012) for at in eyes),
        ]
    )
    mesh = SurfaceMesh(100 * taller * (v - [0, skin[:, 1].min(), 0]), f)
    made = fit_garment(mesh, body, name="shirt", longest_edge=0.1)
    assert made.template.n_vertices == shirt.n_vertices
    assert "2 small pieces nearer to it than to its clothes, as eyes are, were left out, too" in made.notes
    assert ("lengths are cm" in made.notes) == (taller == 1)
    assert float((made.template.v_template - shirt.v_template).norm(dim=1).mean()) < 0.01


def test_a_floor_is_left_out() -> None:
    v, f = cloth(Wanted(low=0.66, sleeve=0.6, step=0.028))
    slab = trimesh.creation.box((4, 0.02, 4))
    parts = [(v, f), (np.asarray(slab.vertices), np.asarray(slab.faces, dtype=np.int64))]
    kept, notes = without_floor(SurfaceMesh(*together(parts)))
    assert len(kept.faces) == len(f)
    assert notes == ["a flat piece, wider than all the rest, was taken for a floor and left out"]
    for part in (parts[:1], [(v, f), button(np.array([0, 1.2, 0.15]))]):
        assert without_floor(SurfaceMesh(*together(part)))[1] == []


def test_specks_of_a_scan_are_left_out_and_buttons_are_not() -> None:
    parts = [cloth(replace(SHIRT, step=0.05)), button(np.array([0.03, 1.1, 0.17])), button(np.array([0.4, 0.9, 0.3]))]
    kept, notes = without_specks(SurfaceMesh(*together(parts)))
    assert notes == ["1 tiny pieces that float far from all the rest, as a scan's specks do, were left out"]
    np.testing.assert_array_equal(kept.vertices, together(parts[:2])[0])
    assert without_specks(kept)[1] == []


def test_pinholes_are_no_openings() -> None:
    """The inner side of a hoodie with pinholes was taken for cloth that faces the wrong way."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    sock = ball.vertices[ball.faces].mean(1)[:, 1] < 0.8
    for kept, is_open in ((slice(None), False), (slice(1, None), False), (sock, True)):
        label = np.zeros(len(ball.vertices), np.int64)
        assert open_pieces(ball.vertices, ball.faces[kept].astype(np.int64), label).tolist() == [is_open]


@pytest.mark.parametrize("n_panels", [1, 2])
def test_cloth_with_two_sides_is_worn_with_its_outer_one(n_panels: int) -> None:
    """Trousers 3 mm thick, closed along their hems, in one piece or in panels that touch; a button on them is whole."""
    v, f = cloth(Wanted(low=0.13, high=0.99, legs=True, step=0.03))
    ball, thick = button(np.array([0.0, 0.93, float(v[np.abs(v[:, 1] - 0.93) < 0.03, 2].max()) + 0.004])), []
    for k in range(n_panels):
        used, own = np.unique(f[(v[f].mean(1)[:, 2] > 0.03) % n_panels == k], return_inverse=True)
        own = own.reshape(-1, 3)
        on_rim = rim_of(own)
        a, b = own[on_rim], np.roll(own, -1, axis=1)[on_rim]
        n = len(used)
        walls = np.concatenate((np.stack((b, a, a + n), 1), np.stack((b, a + n, b + n), 1)))
        inner = (v - 0.003 * vertex_normals(v, f))[used]
        thick.append((np.concatenate((v[used], inner)), np.concatenate((own, own[:, ::-1] + n, walls))))
    made = fit_garment(SurfaceMesh(*together([*thick, ball])), load_body("male"), name="jeans")
    pieces = f"{n_panels} of {n_panels + 1} pieces"
    assert f"cloth with two sides, of which the outer one is worn ({pieces})" in made.notes
    plain = fit_garment(SurfaceMesh(*together([(v, f), ball])), load_body("male"), name="plain").template
    assert made.template.faces.shape == plain.faces.shape
    assert components(made.template.faces.numpy(), made.template.n_vertices)[0] == 2
    assert float((made.template.v_template - plain.v_template).norm(dim=1).median()) < 1e-3


@pytest.mark.parametrize("is_open", [False, True])
def test_what_opens_in_front_is_seen(is_open: bool) -> None:
    """Robes and jackets were worn back to front: they fit as well like that."""
    garment = load_garment("tshirt-male")
    v, f, body = garment.v_template.double().numpy(), garment.faces.numpy(), load_body("male")
    middle = v[f].mean(1)
    f = f[~(is_open & (np.abs(middle[:, 0]) < 0.03) & (middle[:, 2] > 0.04))]
    assert not opens_behind(v, f, body)
    assert opens_behind(v * [-1, 1, -1], f, body)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_coat_opens_in_front(up: str) -> None:
    """It is the mirror image of a shirt: its back is where a chest is. Robes and jackets were worn back to front."""
    garment = load_garment("longsleeve-male")
    v, f, body = garment.v_template.double().numpy(), garment.faces.numpy(), load_body("male")
    middle = v[f].mean(1)
    f = f[~((np.abs(middle[:, 0]) < 0.03) & (middle[:, 2] < -0.02))][:, ::-1]
    v = (v - v.mean(0)) * [1.6, 1.6, -1.6]
    base = {"y": np.eye(3), "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}[up]
    place = next(find_places(SurfaceMesh(v @ base, f), body, Placing()))
    np.testing.assert_allclose(place.turn, base, atol=1e-9)


def test_what_is_turned_round_is_posed_anew() -> None:
    """A blouse stayed back to front: its arms, brought forward for that, were behind it as it was turned round."""
    body, mesh = load_body("neutral"), SurfaceMesh(*cloth(replace(SHIRT, sleeve=0.9, is_open=True, arms=0.6)))
    search = _Search(mesh, body, Placing(), [1.0])
    way = _Way(1.0, ROUND, "searched", np.array([0.0, -1.117, 0.07]))
    place = search.told(_at(search.samples, [way], PosedBody(body, standing_pose(0.6, forward=0.5)))[0])
    np.testing.assert_array_equal(place.turn, np.eye(3))
    assert place.pose[17, 1] == pytest.approx(0.0, abs=0.1)


def test_a_scanned_person_stands_askew() -> None:
    """Sleeves of somebody scanned, forearms forward and trunk turned, lay beside the arms, and were found too long."""
    garment = load_garment("longsleeve-male")
    body, pose = load_body("male"), standing_pose(0.8, 0.0, 0.5, 0.2)
    transforms = body(torch.as_tensor(pose, dtype=torch.float32)[None]).transforms
    v = apply_transforms(garment.v_template[None], blend_transforms(garment.weights, transforms))[0].double().numpy()
    turn = Rotation.from_euler("y", 14, degrees=True).as_matrix()
    place = next(find_places(SurfaceMesh(0.93 * (v - v.mean(0)) @ turn.T, garment.faces.numpy()), body, Placing()))
    assert place.unit == pytest.approx(1 / 0.93, rel=0.05)
    np.testing.assert_allclose(place.turn, turn.T, atol=0.05)
    np.testing.assert_allclose(place.pose[[17, 19]], pose[[17, 19]], atol=0.09)
