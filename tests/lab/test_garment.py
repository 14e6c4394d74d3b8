"""`refu garment` and `refu export`: from a mesh to a garment that is worn, simulated, trained and exported."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from outside_meshes import MESHES, Outside, quads_of_a_skirt, write_obj
from scipy.spatial import cKDTree
from small_set import write_set

from refu_core import GarmentError, GarmentPipeline, RefuError, SmplFrame, load_body, load_garment
from refu_core.fitting import fit_garment, read_surface
from refu_core.garments import GarmentTemplate, garment_files, save_garment
from refu_core.simulation import open_dataset, simulate_dataset
from refu_core.training import PretrainSettings, pretrain
from refu_lab.cli import main
from refu_lab.commands.garment import AddOptions
from refu_lab.export import ExportMesh, meshes_of, usd_names, write_meshes
from refu_lab.garment import add_garment, list_garments, warnings_of
from refu_ros._settings import NodeSettings
from tests.lab.test_own_body_commands import HURRIED

ROOT = Path(__file__).parents[2]
WALK = ROOT / "bags" / "walk"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of the user's garments."""
    monkeypatch.setenv("REFU_GARMENTS", str(tmp_path / "mine"))
    return tmp_path / "mine"


@pytest.fixture(scope="module")
def kilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh file: a coarse skirt of quads with texture coordinates, in metres, on a floor."""
    v, quads = quads_of_a_skirt(12, 40)
    uv = np.stack((np.arctan2(v[:, 0], v[:, 2]), v[:, 1]), 1)
    return write_obj(tmp_path_factory.mktemp("mesh") / "kilt.obj", Outside(v, quads, uv, quads))


@pytest.fixture(scope="module")
def template(kilt: Path) -> GarmentTemplate:
    """The garment that it makes."""
    return fit_garment(read_surface(kilt), load_body("female"), name="kilt", longest_edge=0.1).template


@pytest.mark.parametrize("name", MESHES)
def test_meshes_from_elsewhere_are_worn(name: str, tmp_path: Path) -> None:
    """Whatever their unit, axes, place, pose and faults: nothing of them is inside the body in any of three poses."""
    mesh = MESHES[name](tmp_path, 1.5)
    result = add_garment(AddOptions(mesh=mesh, output=tmp_path / "worn.npz", longest_edge=0.035))
    inside = sum(pose["inside"] for pose in result["worn"].values())
    assert inside <= 0.002 * result["vertices"]  # an armhole's rim
    assert result["uv"] == ("texture" in name)
    garment = load_garment(tmp_path / "worn.npz")
    body = load_body("neutral")
    posed = body(torch.zeros(1, 24, 3), torch.tensor([[1.5, 1.0] + 8 * [0.0]]))
    rest = garment.rest(torch.tensor([[1.5, 1.0] + 8 * [0.0]]))
    assert posed.vertices.isfinite().all()
    # It grows with the body, and its triangles don't tear as it moves.
    assert float((rest - garment.v_template).norm(dim=-1).mean()) > 0.01
    edges = garment.edges
    was = (garment.v_template[edges[:, 0]] - garment.v_template[edges[:, 1]]).norm(dim=-1)
    pipeline = GarmentPipeline.load([garment], sdf="none")
    pose = np.zeros((24, 3), np.float32)
    pose[16, 2], pose[17, 2], pose[1, 0], pose[2, 0] = -1.0, 1.0, -0.5, 0.4
    now = torch.tensor(pipeline(SmplFrame(pose=pose))["worn"].local)
    stretch = (now[edges[:, 0]] - now[edges[:, 1]]).norm(dim=-1) / was
    assert float(stretch.quantile(0.99)) < 1.8


@pytest.mark.usefixtures("little_light")
def test_a_garment_is_added_listed_and_worn_by_name(folder: Path, kilt: Path, tmp_path: Path, capsys) -> None:
    arguments = ["garment", "add", str(kilt), "--body", "female", "--layer", "2", "--color", "0.1,0.2,0.9"]
    assert main([*arguments, "--longest-edge", "0.05", "--picture", str(tmp_path / "kilt.png")]) == 0
    said = capsys.readouterr().out
    assert "it stood with the floor at 0" in said
    assert "worn in the pose walk: 0 vertices inside" in said
    assert (tmp_path / "kilt.png").stat().st_size > 10_000
    assert garment_files()["kilt"] == folder / "kilt.npz"
    card = load_garment("kilt").card
    assert (card.layer, card.color, card.held_at_waist) == (2, (0.1, 0.2, 0.9), True)
    assert main(["garment", "list", "--json", str(tmp_path / "list.json")]) == 0
    rows = {row["garment"]: row for row in json.loads((tmp_path / "list.json").read_text())["garments"]}
    assert rows["kilt"]["body"] == "female"
    assert (rows["kilt"]["networks"], rows["kilt"]["uv"], rows["tshirt-male"]["uv"]) == ([], True, False)
    assert rows["tshirt-male"]["networks"] == ["tailornet-hybrid"]
    arguments = ["replay", str(WALK), "--garments", "kilt,tshirt-female", "--max-frames", "2", "--quiet"]
    assert main([*arguments, "--json", str(tmp_path / "replay.json"), "--output", str(tmp_path / "out.mcap")]) == 0
    result = json.loads((tmp_path / "replay.json").read_text())
    assert set(result["garments"]) == {"kilt", "tshirt-female"}
    assert "kilt has no trained weights: worn by skinning" in result["warnings"]
    assert main(["garment", "add", str(kilt)]) == 2
    assert "is there already" in capsys.readouterr().err
    (folder / "torn.npz").write_bytes(b"no garment")
    assert [row["garment"] for row in list_garments() if "fault" in row] == ["torn"]
    assert main(["info"]) == 0
    assert "torn: can't be loaded: " in capsys.readouterr().out


@pytest.mark.usefixtures("folder")
def test_what_is_worn_badly_is_said_last(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A loose cone over arms that hang: it is worn, and the last lines say that it is torn as they are lifted."""
    rows, n = 40, 64
    t, angle = np.linspace(0, 1, rows)[:, None], 2 * np.pi * np.arange(n) / n
    radius = 0.42 - 0.335 * t
    v = np.stack((radius * np.sin(angle), 0.85 + 0.58 * t + 0 * angle, 0.03 + radius * np.cos(angle)), -1).reshape(
        -1, 3
    )
    a = np.arange(n * (rows - 1)).reshape(rows - 1, n)
    quads = np.stack((a, np.roll(a, -1, 1), np.roll(a, -1, 1) + n, a + n), -1).reshape(-1, 4)
    path = write_obj(tmp_path / "loose.obj", Outside(v, quads.tolist()))
    arguments = ["--unit", "m", "--pose", "69", "--longest-edge", "0.1", "--json", str(tmp_path / "told.json")]
    assert main(["garment", "add", str(path), *arguments]) == 0
    warnings = json.loads((tmp_path / "told.json").read_text())["warnings"]
    assert "bringing it into the T-pose stretched" in warnings[0]
    told = capsys.readouterr().out.splitlines()
    assert told[-len(warnings) :] == [f"warning: {text}" for text in warnings]


@pytest.mark.parametrize(("pairs", "long", "n"), [(20, 3.5, 0), (21, 1.0, 1), (0, 3.6, 1), (300, 9.0, 2)])
def test_what_cuts_the_body_and_what_is_torn_is_warned_of(pairs: int, long: float, n: int) -> None:
    good = {"inside": 0, "pairs": 0, "stretch": 1.0}
    assert len(warnings_of({"stand": good, "walk": {"inside": 0, "pairs": pairs, "stretch": long}})) == n


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["--name", "tshirt-male"], "is a garment that ships"),
        (["--name", "body"], "is what the wearer's is called"),
        (["--unit", "furlong"], "no unit 'furlong': wanted m, dm"),
        (["--unit", "mm"], "wanted a garment of"),
        (["--pose", "sitting"], "no pose 'sitting': wanted t, the angle"),
        (["--body", "robot"], "no body 'robot'"),
        (["--name", "my kilt"], "no garment is called 'my kilt'"),
        (["--name", "a/b"], "no garment is called 'a/b'"),
        (["--name", "kilt", "--output", "no/skirt.npz"], "leave --name out, or write kilt.npz"),
        (["--color", "2,0,0"], "color: wanted three numbers"),
        (["--layer", "-1"], "layer: wanted a whole number"),
    ],
)
def test_what_makes_no_garment_is_said(arguments: list[str], wanted: str, folder: Path, kilt: Path, capsys) -> None:
    assert main(["garment", "add", str(kilt), "--longest-edge", "0.1", *arguments]) == 2
    assert wanted in capsys.readouterr().err
    assert not folder.exists()


def test_a_colour_has_three_numbers(kilt: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        main(["garment", "add", str(kilt), "--color", "0.5"])
    assert "--color: wanted 3 finite numbers with commas between them, got '0.5'" in capsys.readouterr().err


def test_what_is_wrong_is_said_of_its_file(folder: Path, kilt: Path, tmp_path: Path, capsys) -> None:
    """Of many meshes in a loop, or of a mesh and a pose, a sentence alone doesn't say which."""
    flat, lost = tmp_path / "flat.obj", tmp_path / "lost.npz"
    flat.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert main(["garment", "add", str(flat), "--quiet"]) == 2
    assert f"{flat}: it is flat" in capsys.readouterr().err
    np.savez(lost, poses=np.full((2, 72), np.nan), trans=np.zeros((2, 3)))
    assert main(["garment", "add", str(kilt), "--pose", str(lost), "--quiet"]) == 2
    assert f"{lost}: its first frame isn't finite" in capsys.readouterr().err
    assert not folder.exists()


def test_a_file_of_any_name_makes_a_garment_that_can_be_worn(folder: Path, kilt: Path, tmp_path: Path, capsys) -> None:
    mesh = tmp_path / "Männer-Kilt (1).obj"
    mesh.write_bytes(kilt.read_bytes())
    assert main(["garment", "add", str(mesh), "--longest-edge", "0.1"]) == 0
    assert garment_files()["Manner-Kilt-1"] == folder / "Manner-Kilt-1.npz"
    assert load_garment("Manner-Kilt-1").n_vertices
    assert "looking for its unit" in capsys.readouterr().err
    assert [row["garment"] for row in list_garments() if "fault" in row] == []
    with pytest.raises(RefuError, match="is a mesh, wanted a garment: make one of it first, by refu garment add"):
        load_garment(str(mesh))
    with pytest.raises(RefuError, match="no garment 'tshirt': wanted tshirt-male or tshirt-female or tshirt-neutral"):
        GarmentPipeline.load(["tshirt"])


def test_a_node_takes_a_garment_by_its_path(template: GarmentTemplate, tmp_path: Path) -> None:
    settings = NodeSettings(garments=(str(save_garment(template, tmp_path / "kilt.npz")),))
    settings.check_files()
    assert settings.pipeline.load().untrained == ("kilt",)
    with pytest.raises(RefuError, match="no weights of tailornet hybrid"):
        replace(settings, backbone="tailornet").check_files()


@pytest.mark.usefixtures("no_curves")
def test_a_garment_of_ones_own_is_simulated_and_trained(template: GarmentTemplate, tmp_path: Path) -> None:
    """The whole journey with few samples: a mesh, cloth, networks, and those in the pipeline."""
    path = save_garment(template, tmp_path / "kilt.npz")
    card = simulate_dataset(str(path), 2, tmp_path / "simulated", test_share=0.5, settings=HURRIED)
    assert card["counts"]["to_do"] == 0
    data = write_set(tmp_path / "set", template, load_body("female"))
    settings = PretrainSettings.of("mlp", "realtime")
    settings = replace(settings, style_shape_steps=2, low_steps=2, steps=2)
    pretrain(
        load_garment(path),
        open_dataset(data),
        tmp_path / "weights" / "kilt",
        backbone="mlp",
        settings=settings,
        quiet=True,
    )
    pipeline = GarmentPipeline.load([path], backbone="mlp", sdf="none", weights=tmp_path / "weights")
    assert pipeline.untrained == ()
    assert np.isfinite(pipeline(SmplFrame(pose=np.zeros((24, 3))))["kilt"].local).all()


# -- export


@pytest.fixture(scope="module")
def dressed(template: GarmentTemplate) -> list[ExportMesh]:
    """A body in a textured skirt, two frames."""
    pipeline = GarmentPipeline.load([template])
    frames = [SmplFrame(pose=np.zeros((24, 3)), transl=[0, k, 0]) for k in range(2)]
    return meshes_of(pipeline, pipeline(frames))


def test_a_glb_has_names_places_colours_and_textures(dressed: list[ExportMesh], tmp_path: Path) -> None:
    paths = write_meshes(dressed, tmp_path / "a.glb")
    assert [path.name for path in paths] == ["a_0.glb", "a_1.glb"]
    scene = trimesh.load_scene(paths[1], process=False)
    assert set(scene.geometry) == {"body", "kilt"}
    kilt = dressed[1]
    read = scene.geometry["kilt"]
    corners = kilt.vertices[1][kilt.faces]
    np.testing.assert_allclose(read.vertices[read.faces], corners, atol=1e-6)
    np.testing.assert_allclose(read.visual.uv[read.faces], kilt.uv.coordinates[kilt.uv.faces], atol=1e-6)
    np.testing.assert_allclose(np.array(read.visual.material.baseColorFactor[:3]) / 255, kilt.color, atol=0.01)


def test_one_output_is_exported_as_a_sequence_of_one() -> None:
    pipeline = GarmentPipeline.load(["short-pant-male"])
    output = pipeline(SmplFrame(pose=np.zeros((24, 3))))
    for one, same in zip(meshes_of(pipeline, output), meshes_of(pipeline, [output]), strict=True):
        np.testing.assert_array_equal(one.vertices, same.vertices)


def test_an_obj_comes_back_as_it_was(dressed: list[ExportMesh], tmp_path: Path) -> None:
    kilt = replace(dressed[1], vertices=dressed[1].vertices[:1])
    (path,) = write_meshes([kilt], tmp_path / "kilt.obj")
    assert write_meshes([kilt], str(path)) == [path]
    mesh = read_surface(path)
    np.testing.assert_allclose(mesh.vertices, kilt.vertices[0], atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, kilt.faces)
    assert mesh.uv is not None
    np.testing.assert_array_equal(mesh.uv.faces, kilt.uv.faces)
    both = read_surface(
        write_meshes([replace(dressed[0], vertices=dressed[0].vertices[:1]), kilt], tmp_path / "b.obj")[0]
    )
    np.testing.assert_array_equal(both.faces[-len(kilt.faces) :] - dressed[0].vertices.shape[1], kilt.faces)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_far_from_the_origin_nothing_is_rounded_away(dressed: list[ExportMesh], tmp_path: Path, suffix: str) -> None:
    """In a map's frame people are a thousand kilometres off."""
    far = [replace(one, vertices=one.vertices[:1] + np.array([4e5, 0.0, -6e6])) for one in dressed]
    (path,) = write_meshes(far, tmp_path / f"far{suffix}")
    if suffix == ".glb":
        mesh = trimesh.load_scene(path, process=False).to_geometry()
        (place,) = {tuple(np.round(t[:3, 3])) for t, _ in map(trimesh.load_scene(path).graph.get, ("body", "kilt"))}
        assert np.abs(np.array(place) - (4e5, 0, -6e6)).max() < 2
        vertices = np.unique(np.round(mesh.vertices, 5), axis=0)
    else:
        vertices = np.unique(np.round(read_surface(path).vertices, 5), axis=0)
    wanted = np.unique(np.round(np.concatenate([one.vertices[0] for one in far]), 5), axis=0)
    distance, _ = cKDTree(vertices - (4e5, 0, -6e6)).query(wanted - (4e5, 0, -6e6))
    assert distance.max() < 2e-5


def test_a_usd_stage_moves(dressed: list[ExportMesh], tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    from pxr import UsdGeom

    (path,) = write_meshes(dressed, tmp_path / "a.usda", fps=25)
    stage = usd.Stage.Open(str(path))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 1, 25)
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    kilt = dressed[1]
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/person/kilt"))
    np.testing.assert_allclose(mesh.GetPointsAttr().Get(1), kilt.vertices[1], atol=1e-6)
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), kilt.faces)
    texture = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    np.testing.assert_allclose(texture, kilt.uv.coordinates[kilt.uv.faces].reshape(-1, 2), atol=1e-6)


def test_names_that_usd_makes_alike_stay_different() -> None:
    given = ["a-b", "a_b", "a b", "a_b_2", "2-in-1", "été", ""]
    assert usd_names(given) == ["a_b", "a_b_2", "a_b_3", "a_b_2_2", "_2_in_1", "_t_", "_"]


def test_usd_without_its_library_is_said(dressed: list[ExportMesh], tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    with pytest.raises(RefuError, match=r"refu-ros\[usd\]"):
        write_meshes(dressed, tmp_path / "a.usdc")


def test_frames_of_a_bag_are_exported(tmp_path: Path, capsys) -> None:
    out = tmp_path / "walk.glb"
    assert main(["export", str(WALK), "--output", str(out), "--first", "3", "--garments", "short-pant-male"]) == 0
    assert set(trimesh.load_scene(out).geometry) == {"body", "short-pant-male"}
    assert main(["export", str(WALK), "--output", str(tmp_path / "walk.stl")]) == 2
    assert "wanted a file of .glb, .obj" in capsys.readouterr().err
    later = str(tmp_path / "later.glb")
    assert main(["export", str(WALK), "--output", later, "--first", "100000"]) == 2
    assert "has no frame that can be dressed" in capsys.readouterr().err


def test_frames_that_a_recording_has_not_are_said(tmp_path: Path, capsys) -> None:
    np.savez(tmp_path / "a.npz", poses=np.zeros((3, 72)), trans=np.zeros((3, 3)), fps=30.0)
    arguments = [
        "export",
        str(tmp_path / "a.npz"),
        "--output",
        str(tmp_path / "a.obj"),
        "--garments",
        "short-pant-male",
    ]
    assert main([*arguments, "--first", "7"]) == 2
    assert "from number 7 on: it has 3 frames, wanted number 7 to 7" in capsys.readouterr().err
    assert main([*arguments, "--first", "2", "--count", "2", "--sdf", "none"]) == 0
    assert "warning: it has 3 frames, wanted number 2 to 3" in capsys.readouterr().out


def test_an_export_replaces_nothing_unasked(tmp_path: Path, capsys) -> None:
    """Of several files, one that is there is enough, and the others aren't begun."""
    plain = ["--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--no-collider"]
    arguments = ["export", str(WALK), "--output", str(tmp_path / "a.obj"), "--count", "2", *plain]
    (tmp_path / "a_1.obj").write_text("precious")
    assert main(arguments) == 2
    assert "a_1.obj is there already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a_1.obj"]
    assert main([*arguments, "--overwrite"]) == 0
    assert (tmp_path / "a_1.obj").read_text() != "precious"
    np.savez(tmp_path / "a.npz", poses=np.zeros((1, 72)), trans=np.zeros((1, 3)), fps=30.0)
    (tmp_path / "a.obj").write_text("precious")  # one frame is left of three: this file
    arguments = ["export", str(tmp_path / "a.npz"), "--output", str(tmp_path / "a.obj"), "--count", "3", *plain]
    (tmp_path / "a_1.obj").unlink()
    (tmp_path / "a_0.obj").unlink()
    assert main(arguments) == 2
    assert (tmp_path / "a.obj").read_text() == "precious"


def test_an_export_takes_the_options_of_a_replay(tmp_path: Path, capsys) -> None:
    """Another shape, another body and others' axes change what is written; foreign betas are said."""
    common = ["--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--no-collider", "--overwrite"]

    def exported(source: Path, *options: str) -> dict[str, np.ndarray]:
        out = tmp_path / "out.glb"
        assert main(["export", str(source), "--output", str(out), *common, *options]) == 0
        return {name: mesh.vertices for name, mesh in trimesh.load_scene(out, process=False).geometry.items()}

    plain = exported(WALK)
    heavy = exported(WALK, "--betas", "0,4")
    female = exported(WALK, "--body", "female")
    for other in (heavy, female):
        assert np.abs(other["body"] - plain["body"]).max() > 0.01
    assert "warning" not in capsys.readouterr().out
    motion = tmp_path / "z_up.npz"
    poses = np.zeros((90, 72))
    poses[:, 0] = np.pi / 2  # z up, as AMASS has it
    np.savez(motion, poses=poses, trans=np.zeros((90, 3)), betas=np.full(10, 0.5), mocap_framerate=30.0)
    standing = exported(motion, "--input-axes", "z-up", "--first", "80", "--fps", "60")["body"]
    assert np.ptp(standing[:, 1]) > 1.4
    as_it_is = exported(motion, "--input-axes", "frame", "--first", "80")["body"]  # y is up in the files
    np.testing.assert_allclose(as_it_is, standing, atol=1e-5)
    assert np.ptp(exported(motion, "--input-axes", "smpl")["body"][:, 1]) < 0.6  # lies, as it was asked to
    assert "betas arrive" in capsys.readouterr().out


def test_damaged_meshes_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF" + bytes(40))
    with pytest.raises(GarmentError, match="not a mesh that can be read"):
        read_surface(tmp_path / "a.glb")


def test_who_has_no_home_is_told_what_to_set(
    kilt: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("REFU_GARMENTS", "~nobody.of.this.name/garments")
    for command in (["list"], ["add", str(kilt), "--body", "female"]):
        assert main(["garment", *command]) == 2
        assert (
            "error: ~nobody.of.this.name/garments: there is no such home; set REFU_GARMENTS" in capsys.readouterr().err
        )
    assert "tshirt-male" in garment_files()
