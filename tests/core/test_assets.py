"""The built-in bodies and garments: what the files hold, and that their meshes are as good as documented."""

from __future__ import annotations

import runpy
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from refu_core.body import BUILTIN_BODIES, JOINT_NAMES, PARENTS, load_body
from refu_core.garments import BUILTIN_GARMENTS, PAPER_GARMENTS, load_garment
from refu_core.metrics import SheetChecker
from refu_core.sdf import ExactSdf

ASSETS = resources.files("refu_core") / "assets"
SIZES = {"shirt-male": 9723, "tshirt-male": 7702, "short-pant-male": 2710, "skirt-female": 7130}
OPENINGS = {"shirt": 4, "tshirt": 4, "longsleeve": 4, "dress": 4, "short-pant": 3, "trousers": 3, "skirt": 2}
MIRRORED_JOINT = [
    JOINT_NAMES.index(n.replace("left_", "#").replace("right_", "left_").replace("#", "right_")) for n in JOINT_NAMES
]


def arrays(stem: str) -> dict[str, np.ndarray]:
    with (ASSETS / f"{stem}.npz").open("rb") as file, np.load(file, allow_pickle=False) as data:
        return dict(data)


@pytest.fixture(scope="module", params=BUILTIN_BODIES)
def body(request):
    data = arrays(f"body_{request.param}")
    return data, trimesh.Trimesh(data["v_template"].astype(np.float64), data["f"].astype(np.int64), process=False)


@pytest.fixture(scope="module", params=BUILTIN_GARMENTS)
def garment(request):
    data = arrays(f"garment_{request.param}")
    mesh = trimesh.Trimesh(data["v_template"].astype(np.float64), data["f"].astype(np.int64), process=False)
    return request.param, data, mesh


def crossing_pairs(mesh: trimesh.Trimesh) -> np.ndarray:
    """Pairs of faces without a common vertex that intersect (K, 2); simulated sets hold the checker against FCL."""
    checker = SheetChecker(mesh.faces)
    checker.update(mesh.vertices)
    pairs = checker.with_itself()
    first, second = np.asarray(mesh.faces)[pairs].transpose(1, 0, 2)
    return pairs[~(first[:, :, None] == second[:, None]).any((1, 2))]


def boundary_loops(mesh: trimesh.Trimesh) -> list[np.ndarray]:
    """Closed boundaries as vertices in order."""
    edges = np.asarray(mesh.edges)
    has_twin = np.isin(edges @ (1, len(mesh.vertices)), edges @ (len(mesh.vertices), 1))
    after = dict(edges[~has_twin].tolist())
    assert len(set(after.values())) == len(after)  # no vertex where two boundaries touch
    loops = []
    while after:
        start, vertex = after.popitem()
        loop = [start]
        while vertex != start:
            loop.append(vertex)
            vertex = after.pop(vertex)
        loops.append(np.array(loop))
    return loops


def check_weights(weights: np.ndarray, most: int) -> None:
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-5)
    assert np.count_nonzero(weights, axis=1).max() <= most


# -- bodies


def test_body_file(body) -> None:
    data, _ = body
    n = len(data["v_template"])
    expected = {
        "v_template": ((n, 3), np.float32),
        "f": ((2 * n - 4, 3), np.uint32),
        "weights": ((n, 24), np.float32),
        "J_regressor": ((24, n), np.float32),
        "kintree_table": ((2, 24), np.int64),
        "shapedirs": ((n, 3, 10), np.float32),
        "posedirs": ((n, 3, 207), np.float32),
    }
    assert {key: (value.shape, value.dtype.type) for key, value in data.items()} == expected
    assert 6_800 < n < 7_200
    assert all(np.isfinite(value).all() for value in data.values())
    np.testing.assert_array_equal(data["kintree_table"][0, 1:], PARENTS[1:])
    np.testing.assert_allclose(data["J_regressor"].sum(1), 1, atol=1e-5)
    check_weights(data["weights"], 4)


def test_body_is_a_closed_sphere_without_slivers_or_crossings(body) -> None:
    _, mesh = body
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.body_count == 1
    assert 0.045 < mesh.volume < 0.085  # m³, positive: faces look outward
    assert np.degrees(mesh.face_angles.min()) > 20
    assert mesh.edges_unique_length.min() > 1.5e-3
    assert mesh.edges_unique_length.max() < 0.04
    assert not len(crossing_pairs(mesh))


def test_bodies_share_mesh_and_weights() -> None:
    first, *others = (arrays(f"body_{name}") for name in BUILTIN_BODIES)
    for other in others:
        for key in ("f", "weights", "kintree_table"):
            np.testing.assert_array_equal(first[key], other[key])


def test_body_is_symmetric(body) -> None:
    data, mesh = body
    mirror = np.array([-1, 1, 1], np.float32)
    distance, image = mesh.kdtree.query(data["v_template"] * mirror)
    assert distance.max() < 1e-6
    np.testing.assert_allclose(data["shapedirs"][image] * mirror[:, None], data["shapedirs"], atol=1e-6)
    np.testing.assert_allclose(data["weights"][image][:, MIRRORED_JOINT], data["weights"], atol=1e-6)
    joints = data["J_regressor"] @ data["v_template"]
    np.testing.assert_allclose(joints[MIRRORED_JOINT] * mirror, joints, atol=1e-4)


def test_body_stands_in_a_t_with_joints_inside(body) -> None:
    data, mesh = body
    joints = dict(zip(JOINT_NAMES, data["J_regressor"].astype(np.float64) @ data["v_template"], strict=True))
    arm = joints["left_wrist"] - joints["left_shoulder"]
    assert arm[0] / np.linalg.norm(arm) > 0.999
    leg = joints["left_ankle"] - joints["left_hip"]
    assert -leg[1] / np.linalg.norm(leg) > 0.99
    assert joints["left_foot"][2] > joints["left_ankle"][2] + 0.05  # looks along +z
    assert mesh.contains(np.array([p for name, p in joints.items() if name != "left_foot"])).all()


def test_first_betas_are_height_and_girth(body) -> None:
    data, mesh = body

    def shaped(k: int) -> trimesh.Trimesh:
        return trimesh.Trimesh(mesh.vertices + data["shapedirs"][:, :, k], mesh.faces, process=False)

    assert 0.05 < np.ptp(shaped(0).vertices[:, 1]) - np.ptp(mesh.vertices[:, 1]) < 0.15
    stout = shaped(1)
    assert stout.volume / np.ptp(stout.vertices[:, 1]) > 1.03 * mesh.volume / np.ptp(mesh.vertices[:, 1])


@pytest.mark.parametrize("name", BUILTIN_BODIES)
def test_body_stays_closed_and_upright_for_drawn_shapes(name) -> None:
    model = load_body(name)
    betas = torch.as_tensor(np.random.default_rng(0).normal(size=(20, 10)), dtype=torch.float32)
    for vertices in model.rest_vertices(betas).double().numpy():
        mesh = trimesh.Trimesh(vertices, model.faces.numpy(), process=False)
        assert 1.35 < np.ptp(vertices[:, 1]) < 2.1
        assert 0.03 < mesh.volume < 0.15


# -- garments


def test_garment_file(garment) -> None:
    name, data, _ = garment
    n = len(data["v_template"])
    assert abs(n - SIZES.get(name, n)) < 0.02 * n  # the paper's sizes
    assert n < 10_000
    assert data["v_template"].dtype == data["weights"].dtype == data["shapedirs"].dtype == np.float32
    assert data["v_template"].shape == (n, 3)
    assert data["f"].shape[1:] == (3,)
    assert data["f"].dtype == np.uint32
    assert data["weights"].shape == (n, 24)
    assert data["shapedirs"].shape == (n, 3, 10)
    assert name.endswith(f"-{data['body']}")
    check_weights(data["weights"], 6)


def test_garment_is_one_clean_surface(garment) -> None:
    name, _, mesh = garment
    openings = OPENINGS[name.rpartition("-")[0]]
    assert mesh.body_count == 1
    assert mesh.is_winding_consistent
    edges = np.sort(mesh.edges, axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    assert len(boundary_loops(mesh)) == openings
    # A sphere with that many holes: nothing is torn, nothing is glued.
    assert mesh.euler_number == 2 - openings
    assert not len(crossing_pairs(mesh))


def test_garment_triangles_are_even(garment) -> None:
    name, _, mesh = garment
    longest, shortest, angle = (1.6, 0.4, 25) if name in PAPER_GARMENTS else (1.8, 0.35, 18)
    lengths = mesh.edges_unique_length
    assert lengths.max() < longest * lengths.mean()
    assert lengths.min() > shortest * lengths.mean()
    assert np.degrees(mesh.face_angles.min()) > angle


def test_hems_are_smooth(garment) -> None:
    name, _, mesh = garment
    if name not in PAPER_GARMENTS:
        pytest.skip("cuffs of a dozen vertices turn by 30 degrees at each")
    for loop in boundary_loops(mesh):
        step = np.roll(mesh.vertices[loop], -1, 0) - mesh.vertices[loop]
        length = np.linalg.norm(step, axis=1)
        step /= length[:, None]
        turn = np.degrees(np.arccos(np.clip((step * np.roll(step, 1, 0)).sum(1), -1, 1)))
        assert turn.max() < 30
        assert np.sort(turn)[-len(turn) // 10] < 25
        assert length.max() < 2.2 * length.min()


def test_weights_and_betas_are_smooth(garment) -> None:
    _, data, mesh = garment
    a, b = mesh.edges_unique.T
    length = mesh.edges_unique_length
    # Weights change by at most their whole range within 3 cm, betas bend the cloth but don't fold it.
    assert (np.abs(data["weights"][a] - data["weights"][b]).max(1) / length).max() < 1 / 0.03
    strain = np.linalg.norm(data["shapedirs"][a] - data["shapedirs"][b], axis=1) / length[:, None]
    assert strain.max() < 0.35


def test_template_clears_its_body(garment) -> None:
    name, data, mesh = garment
    body = load_body(str(data["body"]))
    sdf = ExactSdf(body.faces)
    sdf.update(body.v_template)

    def clearance(points: np.ndarray) -> float:
        return float(sdf.query(torch.as_tensor(points, dtype=torch.float32)).distance.min())

    assert clearance(mesh.vertices) >= 0.006
    assert clearance(mesh.vertices[mesh.edges_unique].mean(1)) >= 0.006
    template = load_garment(name)
    for k in range(10):
        for sign in (2.0, -2.0):
            betas = torch.zeros(1, 10)
            betas[0, k] = sign
            sdf.update(body.rest_vertices(betas)[0])
            assert clearance(template.rest(betas)[0].numpy()) > -0.002
    # Cloth looks outward: its normals point away from the body.
    sdf.update(body.v_template)
    gradient = sdf.query(torch.as_tensor(mesh.vertices, dtype=torch.float32)).gradient.numpy()
    assert (np.einsum("vk,vk->v", mesh.vertex_normals, gradient) > 0).mean() > 0.97


def test_hems_lie_where_they_should() -> None:
    def openings(name: str) -> list[np.ndarray]:
        data = arrays(f"garment_{name}")
        mesh = trimesh.Trimesh(data["v_template"].astype(np.float64), data["f"].astype(np.int64), process=False)
        return [mesh.vertices[loop] for loop in boundary_loops(mesh)]

    for name, reach in (("shirt-male", 0.685), ("tshirt-male", 0.375)):
        sleeves = sorted(p[:, 0].mean() for p in openings(name) if np.ptp(p[:, 0]) < 2e-3)  # perpendicular to the arm
        np.testing.assert_allclose(sleeves, [-reach, reach], atol=0.01)
        (neck,) = (p for p in openings(name) if p[:, 1].mean() > 0.28)
        assert neck[neck[:, 2].argmax(), 1] < neck[neck[:, 2].argmin(), 1] - 0.03  # lower in front
    for name in BUILTIN_GARMENTS:
        hem = min(openings(name), key=lambda p: p[:, 1].mean())
        assert np.ptp(hem[:, 1]) < 5e-3


def test_styles_are_made_for_those_garments_that_have_parameters(tmp_path, monkeypatch) -> None:
    """By default it went on to garments of one style, and failed at the first of them."""
    path = Path(__file__).parents[2] / "scripts" / "build_styles.py"
    monkeypatch.syspath_prepend(path.parent)
    names = runpy.run_path(str(path))["main"].__globals__

    def cut_alone(garment, body) -> dict[str, np.ndarray]:
        mean, fields = names["tailored"](garment, body)
        return {"v_template": mean, "styledirs": fields, "tailoring_from_style": np.eye(4)}

    monkeypatch.setitem(names, "build_styles", cut_alone)
    monkeypatch.setitem(names, "load_garment", lambda name: replace(load_garment(name), styledirs=None))
    monkeypatch.setattr("sys.argv", [str(path), "--output", str(tmp_path)])
    assert names["main"]() == 0
    assert {file.stem for file in tmp_path.iterdir()} == {f"garment_{name}" for name in PAPER_GARMENTS}
