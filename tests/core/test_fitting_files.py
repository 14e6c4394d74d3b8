"""Meshes as people's files have them: every dialect of OBJ, polygons of any form, strays, patterns, tight clothes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from outside_meshes import Wanted, cloth, placed, quads_of_a_skirt, together
from scipy.spatial.transform import Rotation

from refu_core import FrameError, GarmentError, load_body, load_garment
from refu_core.fitting import GarmentDetails, Placing, SurfaceMesh, fit_garment, read_surface
from refu_core.fitting._clean import clean, split_long_edges
from refu_core.fitting._mesh_file import _cut_quads, _ears
from refu_core.fitting._place import find_places
from refu_core.garments import UvMap, save_garment

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n"
TSHIRT = Wanted(sleeve=0.35, step=0.028)


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + SQUARE,
        SQUARE.replace("\n", "\r\n"),
        SQUARE.replace("v ", "v\t").replace("f ", "f\t"),
        SQUARE.replace("\n", "  # said beside it\n"),
        SQUARE.replace("v ", "  v  ").replace(" 0\n", " 0 0.5 0.5 0.5\n"),
        SQUARE.replace("f 1 2 3 4", "f 1//7 2//7 \\\n 3//7 4//7"),
        SQUARE.replace("f 1 2 3 4", "f 1//7 2//7 \\\n 3//7 4//7").replace("\n", "\r\n"),
    ],
    ids=["mark", "line ends", "tabs", "comments", "colours", "broken line", "broken line with other ends"],
)
def test_dialects_of_obj(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(text.encode())
    mesh = read_surface(tmp_path / "a.obj")
    assert (len(mesh.vertices), len(mesh.faces)) == (4, 2)
    np.testing.assert_array_equal(mesh.vertices[2], [1, 1, 0])


@pytest.mark.parametrize("seed", range(5))
def test_polygons_that_are_not_convex(seed: int, tmp_path: Path) -> None:
    """A star of any corners is covered once: its triangles' areas add up, and none is turned over."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 90))
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    flat = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) * rng.uniform(0.2, 1.0, (n, 1))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = flat @ turn.T
    lines = ["v {:.9f} {:.9f} {:.9f}".format(*point) for point in points]
    (tmp_path / "a.obj").write_text("\n".join([*lines, "f " + " ".join(str(k + 1) for k in range(n))]))
    mesh = read_surface(tmp_path / "a.obj")
    assert len(mesh.faces) == n - 2
    cross = np.cross(flat, np.roll(flat, -1, axis=0))[:, 2].sum() / 2
    corners = flat[mesh.faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert areas.min() > -1e-9
    assert areas.sum() == pytest.approx(cross)


def test_a_gltf_whose_numbers_are_elsewhere_is_said(tmp_path: Path) -> None:
    parts = trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box()))
    for name, content in parts.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(GarmentError, match=r"in a file beside it; save it as one file, \.glb"):
        read_surface(tmp_path / "model.gltf")


def test_a_compressed_glb_is_said(tmp_path: Path) -> None:
    """It was said to be 0 large."""
    text = b'{"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]}'
    text += b" " * (-len(text) % 4)
    content = np.array([0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A], "<u4").tobytes() + text
    (tmp_path / "model.glb").write_bytes(content)
    with pytest.raises(GarmentError, match=r"compressed .* export it without"):
        read_surface(tmp_path / "model.glb")


@pytest.mark.parametrize("seed", range(3))
def test_quads_are_halved_as_any_polygon_is(seed: int) -> None:
    """Convex or not, flat or not: those that are cut at once are cut where their ears would be."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(200, 4, 3)) * [1, 1, 0.1]
    is_convex, cuts = _cut_quads(places)
    assert 20 < is_convex.sum() < 150
    for quad, cut in zip(places[is_convex], cuts[is_convex], strict=True):
        assert [tuple(corners) for corners in cut.tolist()] == list(_ears(quad))


def test_a_mesh_that_is_too_fine_is_refused_before_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("no vertex at all" + "\nf 1 2 3" * 400_001)
    with pytest.raises(GarmentError, match="400001 triangles or more, at most 400000 are read"):
        read_surface(tmp_path / "a.obj")


def test_what_is_too_fine_once_it_is_split_may_be_decimated() -> None:
    v, f = cloth(TSHIRT)
    with pytest.raises(GarmentError, match=f"{len(v)} of them its own: .* or decimate it"):
        split_long_edges(SurfaceMesh(v, f), 0.002)


def test_a_crowd_at_one_place_is_one_vertex() -> None:
    """Faces without area, and tiny ones, by the thousand: pairs of all of them would be hundreds of millions."""
    v, f = cloth(TSHIRT)
    n = 5000
    flat = np.tile([0.0, 1.0, 0.1], (3 * n, 1))
    tiny = flat + [0.05, 0, 0] + np.random.default_rng(0).uniform(-1, 1, flat.shape) * 2e-6
    faces = [f, len(v) + np.arange(6 * n).reshape(-1, 3)]
    cleaned, notes = clean(SurfaceMesh(np.concatenate([v, flat, tiny]), np.concatenate(faces)))
    assert (len(cleaned.vertices), len(cleaned.faces)) == (len(v), len(f))
    assert notes == [f"{2 * n} faces without area were left out"]


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_textures_of_no_numbers_are_left_out(wrong: float) -> None:
    v, f = cloth(TSHIRT)
    uv = v[:, :2].astype(np.float32)
    uv[7, 1] = wrong
    cleaned, notes = clean(SurfaceMesh(v, f, UvMap(uv, f)))
    assert cleaned.uv is None
    assert notes == ["the texture coordinates were left out: some are NaN or infinite"]


def test_a_stray_face_takes_nothing_with_it() -> None:
    v, f = cloth(TSHIRT)
    stray = np.array([[1000.0, 0, 0], [1000, 0.1, 0], [1000, 0, 0.1]])
    mesh = SurfaceMesh(np.concatenate([v, stray]), np.concatenate([f, [np.arange(3) + len(v)]]))
    cleaned, notes = clean(mesh)
    assert (len(cleaned.vertices), len(cleaned.faces)) == (len(v), len(f))
    assert notes == ["1 faces far off all others were left out"]


def test_where_inside_becomes_outside_a_few_faces_are_left_out() -> None:
    """A strip with half a turn closes the hole around a vertex, as in scans and bows. The whole mesh was refused."""
    v, f = cloth(TSHIRT)
    for middle in range(len(v) // 2, len(v)):
        after = {
            int(a): int(b)
            for face in f[(f == middle).any(1)]
            for a, b in [np.roll(face, -list(face).index(middle))[1:]]
        }
        if len(after) == 6 and set(after) == set(after.values()):
            break
    ring = [next(iter(after))]
    while len(ring) < 6:
        ring.append(after[ring[-1]])
    quads = [(ring[k], ring[k + 1], ring[(k + 4) % 6], ring[k + 3]) for k in range(3)]
    strip = np.array([half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))])
    rest = f[(f != middle).all(1)]
    cleaned, notes = clean(SurfaceMesh(v, np.concatenate((rest, strip))))
    assert any("on which inside became outside were left out" in note for note in notes)
    assert len(rest) - 6 <= len(cleaned.faces) < len(rest) + 6
    runs = np.stack((cleaned.faces, np.roll(cleaned.faces, -1, 1)), -1).reshape(-1, 2)
    assert len(np.unique(runs, axis=0)) == len(runs)  # neighbours face the same way


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_a_sewing_pattern_is_refused(turn: float) -> None:
    panel = trimesh.creation.box(extents=(0.5, 0.7, 0.0)).subdivide().subdivide()
    v = np.concatenate([panel.vertices, panel.vertices + np.array([0.6, 0, 0])])
    f = np.concatenate([panel.faces, panel.faces + len(panel.vertices)]).astype(np.int64)
    c, s = np.cos(turn), np.sin(turn)
    with pytest.raises(GarmentError, match="it is flat, as a sewing pattern is"):
        fit_garment(SurfaceMesh(v @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]), f), load_body("neutral"), name="a")


def test_cloth_on_a_table_is_refused() -> None:
    """A folded shirt was scaled until it lay under one foot."""
    v, f = cloth(TSHIRT)
    with pytest.raises(GarmentError, match="or cloth on a table"):
        fit_garment(SurfaceMesh(v * [1, 1, 0.1], f), load_body("neutral"), name="a")


@pytest.mark.parametrize("ease", [0.002, -0.003])
def test_tight_clothes_are_not_made_larger(ease: float) -> None:
    """They lie on the skin, and in it where the wearer isn't whom they were made for: that is no other unit."""
    v, f = cloth(replace(TSHIRT, ease=ease))
    place = next(find_places(SurfaceMesh(100 * v, f), load_body("neutral"), Placing()))
    assert place.unit == pytest.approx(0.01)
    assert not place.pose.any()
    assert place.notes == ["lengths are cm", "it stood with the floor at 0 and was moved to the body's feet"]


F64 = NDArray[np.float64]


def _rings(radii: F64, heights: F64, n: int = 90) -> tuple[F64, NDArray[np.int64]]:
    """A surface of revolution about y, a ring each, open at both ends and facing outward."""
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    around = np.stack((np.cos(angle), np.sin(angle)), 1)
    flat = radii[:, None, None] * around
    v = np.stack((flat[..., 0], np.broadcast_to(heights[:, None], flat.shape[:2]), flat[..., 1]), -1).reshape(-1, 3)
    k, j = np.divmod(np.arange(n * (len(radii) - 1)), n)
    p, q = k * n + j, k * n + (j + 1) % n
    return v, np.concatenate((np.stack((p, q, p + n), 1), np.stack((q, q + n, p + n), 1)))


@pytest.mark.parametrize("what", ["gown", "poncho"])
@pytest.mark.parametrize("is_placed", [False, True])
def test_wide_garments_are_worn_and_no_toys_beside_a_foot(what: str, is_placed: bool) -> None:
    """On average they are farther off the skin than a small thing that lies near a limb."""
    body = load_body("female")
    joints, floor = body.joint_template.numpy(), float(body.v_template[:, 1].min())
    if what == "gown":
        heights = np.linspace(joints[9, 1] + 0.05, floor + 0.06, 60)
        radii = np.interp(heights, [floor + 0.06, joints[3, 1], joints[9, 1]], [0.5, 0.2, 0.2])
    else:
        radii = np.linspace(0.11, 0.62, 40)
        heights = joints[16, 1] + 0.12 - 0.4 * np.maximum(0, radii - 0.25)
    v, f = _rings(radii, heights)
    placing = Placing(unit=1.0, up="y", is_placed=True) if is_placed else Placing()
    place = next(find_places(SurfaceMesh(v, f), body, placing))
    assert (place.unit, place.fit.around > 0.1) == (1.0, True)
    assert np.abs(place.shift).max() < 0.1


def test_a_poncho_of_two_panels_is_not_flat() -> None:
    """Nearly all of it faces forward or back, as cloth on a table faces up or down: it was refused."""
    v, f = _rings(np.linspace(0.16, 0.24, 30), np.linspace(1.40, 0.85, 30))
    mesh = SurfaceMesh(v * [2.6, 1, 0.8] + [0, 0, 0.035], f)
    notes = fit_garment(mesh, load_body("neutral"), name="poncho", longest_edge=0.1).notes
    assert any("modelled with arms" in note for note in notes)


def test_lids_on_the_openings_are_named() -> None:
    shirt = load_garment("tshirt-male")
    v, f = shirt.v_template.double().numpy(), shirt.faces.numpy()
    mesh = trimesh.Trimesh(v, f, process=False)
    for loop in mesh.outline().entities:
        ring = loop.points[:-1] if loop.points[0] == loop.points[-1] else loop.points
        v = np.concatenate((v, v[ring].mean(0, keepdims=True)))
        f = np.concatenate((f, [(a, b, len(v) - 1) for a, b in zip(ring, np.roll(ring, -1), strict=True)]))
    closed = trimesh.Trimesh(v, f, process=False)
    closed.fix_normals()
    with pytest.raises(GarmentError, match="It has no opening: if faces close"):
        fit_garment(SurfaceMesh(closed.vertices, closed.faces), load_body("male"), name="capped")


def test_what_is_placed_is_not_turned() -> None:
    """A cape, placed behind the back, would be nearer to the skin in front."""
    body = load_body("male")
    v, f = _rings(np.linspace(0.16, 0.28, 30), np.linspace(float(body.joint_template[12, 1]), -0.4, 30))
    behind = v[f].mean(1)[:, 2] < 0.02
    used, f = np.unique(f[behind], return_inverse=True)
    mesh = SurfaceMesh(v[used] - [0, 0, 0.03], f.reshape(-1, 3))
    place = next(find_places(mesh, body, Placing(unit=1.0, up="y", is_placed=True)))
    np.testing.assert_array_equal(place.turn, np.eye(3))


@pytest.mark.parametrize(
    ("v", "f", "wanted"),
    [
        (np.eye(3), [[0, 1, 3]], "names vertex 4 of 3"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "NaN or infinite"),
        (np.zeros((3, 3)), np.zeros((0, 3), int), "no faces"),
        (np.zeros((3, 3)), [[0.0, 1.0, 2.0]], "Cannot cast"),
        ("cloth", [[0, 1, 2]], "could not convert"),
        (1e300 * np.eye(3), [[0, 1, 2]], r"it is 1e\+300 large and reaches to 1e\+300: wanted sizes from"),
        (1e-200 * np.eye(3), [[0, 1, 2]], "it is 1e-200 large"),
        (np.ones((3, 3)), [[0, 1, 2]], "it is 0 large"),
        (np.ma.masked_equal(np.eye(3), 1.0), [[0, 1, 2]], "vertices that are NaN or infinite"),
        (np.eye(3), np.ma.masked_equal([[0, 1, 2]], 2), "Cannot cast"),
        (np.eye(3) + 0j, [[0, 1, 2]], "values of the type complex128"),
    ],
)
def test_meshes_that_make_no_sense_are_refused_where_they_are_made(v: Any, f: Any, wanted: str) -> None:
    with pytest.raises(GarmentError, match=wanted):
        SurfaceMesh(v, f)


def test_texture_coordinates_of_other_faces_are_refused() -> None:
    uv = UvMap(np.zeros((4, 2), np.float32), np.array([[0, 1, 2], [0, 2, 3]]))
    with pytest.raises(GarmentError, match=r"corners must be \(1, 3\), got \(2, 3\)"):
        SurfaceMesh(np.eye(3), [[0, 1, 2]], uv)


@pytest.mark.parametrize(("file", "name"), [("my shirt", "my shirt"), ("garment_-x", "-x")])
def test_what_is_saved_can_be_loaded_again(tmp_path: Path, file: str, name: str) -> None:
    with pytest.raises(GarmentError, match=f"no garment is called '{name}'"):
        save_garment(load_garment("tshirt-male"), tmp_path / f"{file}.npz")
    assert not list(tmp_path.iterdir())


def test_names_and_bodies_that_garments_cannot_have() -> None:
    v, quads = quads_of_a_skirt(6, 20)
    mesh = SurfaceMesh(v, np.array([[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads]))
    with pytest.raises(GarmentError, match="no garment is called 'my skirt': wanted letters"):
        fit_garment(mesh, load_body("neutral"), name="my skirt")
    own = load_body("neutral")
    own.name = "SMPL_NEUTRAL"
    with pytest.raises(
        GarmentError, match=r"cut for a built-in body \(male, female, neutral\), got another, SMPL_NEUTRAL: add it for"
    ):
        fit_garment(mesh, own, name="skirt")
    own = load_body("male")
    own.name = "female"
    with pytest.raises(GarmentError, match="got another, female: add it for"):
        fit_garment(mesh, own, name="skirt")


def test_a_body_of_double_precision_and_a_pose_of_any_numbers_will_do() -> None:
    skirt = load_garment("skirt-female")
    mesh = SurfaceMesh(skirt.v_template.numpy(), skirt.faces.numpy())
    placing = Placing(np.float32(1.0), "y", np.zeros((24, 3)), is_placed=True)
    wanted = fit_garment(mesh, load_body("female"), name="skirt", placing=placing).template
    placing = Placing(1.0, "y", np.zeros((24, 3)).tolist(), is_placed=True)
    made = fit_garment(mesh, load_body("female", dtype=torch.float64), name="skirt", placing=placing).template
    torch.testing.assert_close(made.v_template, wanted.v_template, rtol=0, atol=0)
    details = GarmentDetails(color=np.array((0.1, 0.2, 0.3)))  # JSON has no arrays
    with pytest.raises(GarmentError, match="three numbers from 0 to 1, as a tuple"):
        fit_garment(mesh, load_body("female"), name="skirt", placing=placing, details=details)
    with pytest.raises(FrameError, match=r"the mesh's pose must have the shape \(24, 3\)"):
        Placing(pose=np.zeros((2, 24, 3)))


@pytest.mark.parametrize(
    ("askew", "axis", "front"), [(30, "y", "+z"), (-20, "z", "-y"), (200, "y", "-z"), (65, "y", "+x")]
)
def test_a_garment_that_stands_askew_is_put_straight(askew: float, axis: str, front: str) -> None:
    """As a scanner leaves it: it was made a fifth larger until it went round the body as it stood."""
    wanted = replace(TSHIRT, turn=(axis, 100))
    v, f = cloth(wanted)
    turn = Rotation.from_euler("y", askew, degrees=True)
    place = next(find_places(SurfaceMesh(placed(turn.apply(v), wanted), f), load_body("neutral"), Placing()))
    assert place.unit == pytest.approx(0.01)
    assert place.turn[1] @ np.eye(3)["xyz".index(axis)] == pytest.approx(1)
    assert any(f"{axis} is up and" in note and f"° off {front} is in front" in note for note in place.notes)
    moved = place(placed(turn.apply(v), wanted))
    assert np.abs(moved - v - place.shift).max() < 0.03  # as it was before it was turned


def test_clothes_worn_together_are_said() -> None:
    top, shorts = (
        cloth(Wanted(low=1.12, high=1.30, step=0.03)),
        cloth(Wanted(low=0.72, high=0.97, legs=True, step=0.03)),
    )
    v, f = together([top, shorts])
    notes = fit_garment(SurfaceMesh(v, f), load_body("neutral"), name="set", longest_edge=0.1).notes
    assert "2 parts of it are one above the other and touch nowhere: add each as a garment of its own" in notes
    notes = fit_garment(SurfaceMesh(*shorts), load_body("neutral"), name="shorts", longest_edge=0.1).notes
    assert not any("touch nowhere" in note for note in notes)
