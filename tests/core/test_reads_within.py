"""Kernels read no memory beyond what they were given: what doesn't fit is refused, or kept within."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from refu_core import ExactSdf, FrameError, MeshError, Resolver, load_body, load_garment
from refu_core.body import BodyOutput, SmplBody, forward_kinematics, rotvec_to_rotmat
from refu_core.contact import Layer
from refu_core.garments import GarmentTemplate
from refu_core.metrics import SheetChecker
from refu_core.sdf._closest_kernels import closest_on_face


@pytest.fixture(scope="module")
def body() -> SmplBody:
    return load_body("male")


@pytest.fixture(scope="module")
def posed(body: SmplBody) -> BodyOutput:
    return body(torch.zeros(2, 24, 3))


@pytest.fixture(scope="module")
def shirt() -> GarmentTemplate:
    return load_garment("tshirt-male")


def _ball(subdivisions: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    return torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces)


@pytest.mark.parametrize(
    "points",
    [
        lambda rest: rest[None].repeat(2, 40, 1),
        lambda rest: rest[None, :10].repeat(2, 1, 1),
        lambda rest: rest[None].repeat(3, 1, 1),
        lambda rest: rest,
    ],
)
def test_points_to_be_posed_are_as_many_as_there_are_weights(
    points: Callable[[torch.Tensor], torch.Tensor], shirt: GarmentTemplate, posed: BodyOutput
) -> None:
    with pytest.raises(MeshError, match="wanted points of the shape"):
        shirt.pose(points(shirt.v_template), posed.transforms)


@pytest.mark.parametrize(("n_poses", "n_shapes"), [(3, 2), (3, 5), (1, 2), (2, 0)])
def test_shapes_are_as_many_as_poses_or_one(n_poses: int, n_shapes: int, body: SmplBody) -> None:
    with pytest.raises(FrameError, match="wanted rotations"):
        body.posed(torch.zeros(n_poses, 24, 3), body.shape(torch.zeros(n_shapes, 10)))


def test_rotations_are_of_24_joints(body: SmplBody) -> None:
    with pytest.raises(FrameError, match="wanted rotations"):
        forward_kinematics(torch.zeros(1, 22, 3), torch.zeros(1, 22, 3))
    with pytest.raises(FrameError, match="rotation vectors must"):
        body.posed(torch.zeros(1, 72), body.shape(torch.zeros(1, 10)))
    with pytest.raises(FrameError, match="rotation vectors must"):
        rotvec_to_rotmat(torch.zeros(3, 4))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nobody_is_posed_as_nobody(dtype: torch.dtype) -> None:
    body = load_body("male", dtype=dtype)
    none = body(torch.zeros(0, 24, 3), torch.zeros(0, 10))
    assert none.vertices.shape == (0, body.n_vertices, 3)
    assert none.transforms.rotation.shape == (0, 24, 3, 3)


@given(near=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=60, max_size=60))
def test_any_face_may_be_named_as_near(near: list[int]) -> None:
    vertices, faces = _ball()
    sdf = ExactSdf(faces)
    sdf.update(vertices)
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.7, 0.7, (60, 3))).float()
    torch.testing.assert_close(sdf.closest(points, near=torch.tensor(near)).distance, sdf.closest(points).distance)


def test_as_many_faces_are_near_as_there_are_points() -> None:
    vertices, faces = _ball()
    sdf = ExactSdf(faces)
    sdf.update(vertices)
    with pytest.raises(MeshError, match="near must be"):
        sdf.closest(vertices, near=torch.zeros(3, dtype=torch.int32))


def test_distances_to_another_body_name_no_face_of_this_one() -> None:
    (vertices, faces), (many, fine) = _ball(), _ball(6)
    sdf, other = ExactSdf(faces), ExactSdf(fine)
    sdf.update(vertices)
    other.update(many)
    done = Resolver(faces, len(vertices))(0.9 * vertices, sdf, other.query(0.9 * vertices), margin=0.004)
    assert float(sdf.query(done.vertices).distance.min()) > 0


def test_who_goes_on_does_so_on_the_same_body() -> None:
    (vertices, faces), (many, fine) = _ball(), _ball(6)
    sdf, other, resolver = ExactSdf(faces), ExactSdf(fine), Resolver(faces, len(vertices))
    sdf.update(vertices)
    other.update(many)
    with pytest.raises(MeshError, match="nothing to go on from"):
        resolver(vertices, sdf, None)
    resolver(vertices, other, other.query(vertices))
    with pytest.raises(MeshError, match="nothing to go on from"):
        resolver(0.9 * vertices, sdf, None)
    resolver(0.9 * vertices, other, None)


def test_a_sheet_has_the_vertices_that_its_faces_name() -> None:
    vertices, faces = _ball()
    checker = SheetChecker(faces.numpy())
    with pytest.raises(MeshError, match="faces must index"):
        checker.update(vertices[:5])
    checker.update(vertices)
    with pytest.raises(MeshError, match="faces must index"):
        checker.with_other(vertices[:5], faces)
    with pytest.raises(MeshError, match="faces must be integers"):
        SheetChecker(faces.numpy() / 2)


def test_a_vertex_without_a_face_is_no_place_to_look_from() -> None:
    n = 9
    x, z = np.meshgrid(np.linspace(0, 0.16, n), np.linspace(0, 0.16, n), indexing="ij")
    sheet = torch.from_numpy(np.stack((x, 0 * x, z), -1).reshape(-1, 3)).float()
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = (one.ravel() for one in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = torch.from_numpy(np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1))))
    above = sheet + torch.tensor([0.0, 0.001, 0.0])
    lifted, n_low = Layer(faces, above, faces, sheet)(above, sheet)
    loose = torch.cat((sheet, above))  # nearer than any vertex of the sheet
    same, as_many = Layer(faces, above, faces, loose)(above, loose)
    assert int(n_low) == int(as_many) == len(above)
    torch.testing.assert_close(same, lifted)


@wp.kernel(enable_backward=False)
def _offset_kernel(
    points: wp.array[wp.vec3],
    corners: wp.array[wp.vec3],
    faces: wp.array2d[int],
    # output
    offset: wp.array[wp.vec3],
) -> None:
    i = wp.tid()
    _w, _feature, away = closest_on_face(points[i], i, corners, faces)
    offset[i] = away


@pytest.mark.parametrize("same", [(0, 1), (1, 2), (2, 0), (0, 1, 2)])
def test_a_face_whose_corners_are_at_one_place_is_an_edge_or_a_point(same: tuple[int, ...]) -> None:
    rng, n = np.random.default_rng(0), 2000
    corners = 0.1 * rng.normal(size=(n, 3, 3)).astype(np.float32)
    corners[:, same] = corners[:, same[:1]]
    points = 0.1 * rng.normal(size=(n, 3)).astype(np.float32)
    arrays = [wp.array(one.reshape(-1, 3), dtype=wp.vec3, device="cpu") for one in (points, corners)]
    faces = wp.array(np.arange(3 * n).reshape(n, 3), dtype=wp.int32, device="cpu")
    offset = wp.zeros(n, dtype=wp.vec3, device="cpu")
    wp.launch(_offset_kernel, n, [*arrays, faces], [offset], device="cpu")
    start, end = corners[:, same[0]], corners[:, (same[-1] + 1) % 3]
    along = end - start
    t = ((points - start) * along).sum(1) / np.maximum((along * along).sum(1), 1e-12)
    wanted = np.linalg.norm(points - start - t.clip(0, 1)[:, None] * along, axis=1)
    np.testing.assert_allclose(np.linalg.norm(offset.numpy(), axis=1), wanted, atol=1e-6)
