"""Exact collisions: against fcl, libigl and an all-pairs check, and by hand where triangles barely touch."""

from __future__ import annotations

from pathlib import Path

import fcl
import igl
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from refu_core.body import load_body
from refu_core.errors import MeshError
from refu_core.garments import load_garment
from refu_core.metrics import CollisionChecker, Collisions, SelfContactDetector

Array = NDArray[np.float64]


def fcl_pairs(garment: Array, garment_faces: Array, body: Array, body_faces: Array) -> set[tuple[int, int]]:
    def model(vertices: Array, faces: Array) -> fcl.CollisionObject:
        bvh = fcl.BVHModel()
        bvh.beginModel(len(vertices), len(faces))
        bvh.addSubModel(vertices.astype(np.float64), faces.astype(np.int64))
        bvh.endModel()
        return fcl.CollisionObject(bvh, fcl.Transform())

    # The default limit on contacts would cut the list off.
    request = fcl.CollisionRequest(num_max_contacts=1_000_000, enable_contact=True)
    result = fcl.CollisionResult()
    fcl.collide(model(garment, garment_faces), model(body, body_faces), request, result)
    return {(contact.b1, contact.b2) for contact in result.contacts}


def pierces(a: Array, b: Array, triangle: Array) -> bool:
    """Segment ab against a triangle: solves for the crossing with the plane, then for its barycentrics."""
    p, q, r = triangle
    normal = np.cross(q - p, r - p)
    height_a, height_b = normal @ (a - p), normal @ (b - p)
    if height_a * height_b > 0 or height_a == height_b:
        return False
    x = a + (b - a) * height_a / (height_a - height_b)
    u, v = np.linalg.lstsq(np.stack([q - p, r - p], axis=1), x - p, rcond=None)[0]
    return bool(u >= 0 and v >= 0 and u + v <= 1)


def all_pairs(garment: Array, garment_faces: Array, body: Array, body_faces: Array) -> dict[tuple[int, int], bool]:
    """Every pair of triangles, one by one: (garment face, body face) -> is it vertex-face?

    But for those that are apart along an axis, by more than what is rounded.
    """
    found = {}
    corners = body[body_faces].astype(np.float64)
    for i, first in enumerate(garment[garment_faces].astype(np.float64)):
        is_near = ((corners.max(1) > first.min(0) - 1e-6) & (corners.min(1) < first.max(0) + 1e-6)).all(1)
        for j, second in ((j, corners[j]) for j in np.flatnonzero(is_near).tolist()):
            ours = sum(pierces(first[k], first[(k + 1) % 3], second) for k in range(3))
            theirs = sum(pierces(second[k], second[(k + 1) % 3], first) for k in range(3))
            if ours + theirs:
                found[i, j] = max(ours, theirs) >= 2
    return found


def check(garment: trimesh.Trimesh, body: trimesh.Trimesh) -> Collisions:
    checker = CollisionChecker(body.faces)
    checker.update(body.vertices)
    return checker.check(garment.vertices, garment.faces)


def ball(radius: float = 1.0, *, subdivisions: int = 1, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh.vertices = (mesh.vertices + at).astype(np.float32)
    return mesh


@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**31),
    shift=st.tuples(*[st.floats(-1.2, 1.2)] * 3),
)
def test_equals_the_all_pairs_check(seed: int, shift: tuple[float, float, float]) -> None:
    body, garment = ball(), ball(0.7, subdivisions=0, at=shift)
    noise = np.random.default_rng(seed).normal(scale=0.05, size=garment.vertices.shape)
    garment.vertices = (garment.vertices + noise).astype(np.float32)
    found = check(garment, body)
    wanted = all_pairs(garment.vertices, garment.faces, body.vertices, body.faces)
    assert dict(zip(map(tuple, found.pairs.tolist()), found.pair_is_vf.tolist(), strict=True)) == wanted
    inside = igl.winding_number(body.vertices, body.faces, garment.vertices) > 0.5
    np.testing.assert_array_equal(found.inside, inside)
    depth = np.sqrt(igl.point_mesh_squared_distance(garment.vertices, body.vertices, body.faces)[0])
    np.testing.assert_allclose(found.depth, np.where(inside, depth, 0), atol=1e-6)
    assert found.is_free == (not wanted and not inside.any())
    vf = {face for (face, _), is_vf in wanted.items() if is_vf}
    ee = {face for (face, _), is_vf in wanted.items() if not is_vf}
    assert (found.n_vf, found.n_ee, found.n_pairs) == (len(vf), len(ee), len(wanted))


@pytest.mark.parametrize(("name", "seed"), [("tshirt-male", 0), ("short-pant-male", 1), ("skirt-female", 2)])
def test_equals_fcl_and_libigl_on_garments(name: str, seed: int) -> None:
    garment = load_garment(name)
    body = load_body(garment.body)
    generator = torch.Generator().manual_seed(seed)
    betas = torch.randn(1, 10, generator=generator)
    output = body(pose=0.6 * torch.randn(1, 24, 3, generator=generator), betas=betas)
    vertices, skin = garment.pose(garment.rest(betas), output.transforms)[0].numpy(), output.vertices[0].numpy()
    faces, skin_faces = garment.faces.numpy(), body.faces.numpy()
    checker = CollisionChecker(skin_faces)
    checker.update(body.v_template)  # built for one pose, asked in another
    checker.update(skin)
    found = checker.check(vertices, faces)
    assert found.n_pairs > 0
    assert set(map(tuple, found.pairs.tolist())) == fcl_pairs(vertices, faces, skin, skin_faces)
    winding = igl.fast_winding_number(skin.astype(np.float64), skin_faces.astype(np.int64), vertices.astype(np.float64))
    np.testing.assert_array_equal(found.inside, winding > 0.5)


def test_many_pairs_are_not_cut_off() -> None:
    body, garment = ball(subdivisions=4), ball(subdivisions=4, at=(0.011, 0.003, 0.007))
    spikes = np.arange(len(garment.vertices)) % 2 == 0
    garment.vertices = (garment.vertices * np.where(spikes, 1.2, 0.8)[:, None]).astype(np.float32)
    found = check(garment, body)
    assert found.n_pairs > len(garment.faces)  # more than was made room for
    assert set(map(tuple, found.pairs.tolist())) == fcl_pairs(
        garment.vertices, garment.faces, body.vertices, body.faces
    )


def test_a_piece_wholly_inside_is_not_free() -> None:
    found = check(ball(0.3), ball())
    assert found.n_pairs == 0
    assert found.inside.all()
    assert not found.is_free
    assert found.max_depth == pytest.approx(1 - 0.3, abs=0.25)
    assert check(ball(2.0), ball()).is_free
    assert check(ball(0.3, at=(3, 0, 0)), ball()).is_free


def test_garments_of_one_size_take_turns() -> None:
    body, garment = ball(), ball(0.7, at=(0.5, 0, 0))
    checker = CollisionChecker(body.faces)
    checker.update(body.vertices)
    for faces in (garment.faces, garment.faces[::-1], garment.faces):
        found = checker.check(garment.vertices, faces)
        wanted = all_pairs(garment.vertices, np.asarray(faces), body.vertices, body.faces)
        assert dict(zip(map(tuple, found.pairs.tolist()), found.pair_is_vf.tolist(), strict=True)) == wanted


TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -1]], np.float32)
TETRAHEDRON_FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


def against_tetrahedron(*triangle: tuple[float, float, float]) -> Collisions:
    checker = CollisionChecker(TETRAHEDRON_FACES)
    checker.update(TETRAHEDRON)
    return checker.check(np.array(triangle, np.float32), np.array([[0, 1, 2]]))


def test_vertex_through_a_face_is_vf_and_edge_over_edge_is_ee() -> None:
    vf = against_tetrahedron((0.2, 0.2, -0.1), (0.2, 0.2, 1), (0.3, 0.2, 1))
    assert vf.pairs.tolist() == [[0, 0]]
    assert (vf.n_vf, vf.n_ee, vf.n_inside) == (1, 0, 1)
    ee = against_tetrahedron((0.3, -1, -0.05), (0.3, 1, 0.4), (0.3, -1, 1))
    assert (ee.n_vf, ee.n_inside) == (0, 0)
    assert check(ball(0.5, at=(1.2, 0, 0)), ball()).n_vf > 0


def test_touching_counts_and_sharing_a_plane_alone_does_not() -> None:
    touching = against_tetrahedron((0.2, 0.2, 0), (0.2, 0.2, 1), (0.3, 0.2, 1))
    assert touching.pairs.tolist() == [[0, 0]]
    above = against_tetrahedron((0.2, 0.2, 1e-7), (0.2, 0.2, 1), (0.3, 0.2, 1))
    assert above.is_free
    within = against_tetrahedron((0.1, 0.1, 0), (0.3, 0.1, 0), (0.1, 0.3, 0))
    assert within.n_pairs == 0
    across = against_tetrahedron((-0.5, -0.5, 0), (0.5, 0.2, 0), (0.2, 0.5, 0))
    assert across.n_pairs > 0  # the faces beside the plane meet its edges


def test_a_degenerate_triangle_is_a_segment() -> None:
    found = against_tetrahedron((0.2, 0.2, -0.5), (0.2, 0.2, 1), (0.2, 0.2, 1))
    assert [0, 0] in found.pairs.tolist()


def test_refuses_what_is_no_mesh() -> None:
    checker = CollisionChecker(TETRAHEDRON_FACES)
    with pytest.raises(MeshError, match="call update"):
        checker.check(TETRAHEDRON, TETRAHEDRON_FACES)
    checker.update(torch.from_numpy(TETRAHEDRON))
    with pytest.raises(MeshError, match="got 1 of 4 with NaN"):
        checker.check(np.where(TETRAHEDRON == -1, np.nan, TETRAHEDRON), TETRAHEDRON_FACES)
    with pytest.raises(MeshError, match=r"faces must be integers of shape \(F, 3\), got"):
        checker.check(np.zeros((4, 3)), None)
    with pytest.raises(MeshError, match="vertices 0 to 3, got 0 to 4"):
        checker.check(TETRAHEDRON, TETRAHEDRON_FACES + 1 - (TETRAHEDRON_FACES == 0))
    with pytest.raises(MeshError, match="open edges"):
        CollisionChecker(TETRAHEDRON_FACES[:3])


def two_balls(gap: float) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    first, second = ball(subdivisions=3), ball(subdivisions=3, at=(2 + gap, 0.013, 0.007))
    vertices = np.concatenate([first.vertices, second.vertices]).astype(np.float32)
    return vertices, np.concatenate([first.faces, second.faces + len(first.vertices)])


def test_self_contact_is_what_the_rest_pose_has_not() -> None:
    rest, faces = two_balls(0.5)
    posed, _ = two_balls(-0.3)
    detector = SelfContactDetector(faces, rest)
    assert detector.detect(rest).is_free
    contact = detector.detect(posed)
    wanted = fcl_pairs(posed[:642], faces[:1280], posed[642:], faces[:1280])
    assert set(map(tuple, contact.pairs.tolist())) == {(i, j + 1280) for i, j in wanted}
    # Faces with a corner in the other ball are buried, whether they cross its surface or not.
    in_other = np.concatenate([np.linalg.norm(posed[:642] - posed[642:].mean(0), axis=1), np.full(642, 9.0)]) < 0.97
    assert np.isin(np.flatnonzero(in_other[faces].all(axis=1)), contact.faces).all()
    assert SelfContactDetector(faces, posed).detect(posed).is_free


def test_near_a_self_contact() -> None:
    rest, faces = two_balls(0.5)
    posed, _ = two_balls(-0.3)
    detector = SelfContactDetector(faces, rest)
    contact = detector.detect(posed)
    detector.detect(rest)  # an older answer stays valid
    points = np.array([[0.85, 0.6, 0], [0.85, 1.0, 0], [-1, 0, 0], [0.85, 0, 0], [0.5, 0, 0], [-0.5, 0, 0]])
    # Beside the seam; far above it; at the far side; between the layers; within a ball, nearer to the other's buried
    # cap than to free skin; within, nearer to free skin.
    assert contact.near(points, distance=0.1).tolist() == [True, False, False, True, True, False]
    corners = posed[faces[contact.faces]]
    squared = igl.point_mesh_squared_distance(
        points, corners.reshape(-1, 3).astype(float), np.arange(3 * len(corners)).reshape(-1, 3)
    )[0]
    assert (np.sqrt(squared) < 0.1).tolist() == [True, False, False, False, False, False]
    assert not detector.detect(rest).near(points).any()


def buried_faces(vertices: NDArray[np.float32], faces: NDArray[np.int64]) -> set[int]:
    """Faces with another limb around the point 3 mm above their middle."""
    a, b, c = vertices[faces].astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    above = (a + b + c) / 3 + 3e-3 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return set(np.flatnonzero(igl.fast_winding_number(vertices.astype(np.float64), faces, above) > 0.5).tolist())


def test_buried_skin_on_recorded_motion(motions: list[Path]) -> None:
    body = load_body("male")
    faces = body.faces.long().numpy()
    detector = SelfContactDetector(faces, body.v_template)
    always = buried_faces(body.v_template.numpy(), faces)  # toes, ears
    for clip in motions:
        with np.load(clip) as data:
            pose = torch.tensor(data["poses"][len(data["poses"]) // 2], dtype=torch.float32).view(1, 24, 3)
        vertices = body(pose=pose, betas=torch.zeros(1, 10)).vertices[0].numpy()
        found = set(detector.detect(vertices).faces.tolist())
        wanted = buried_faces(vertices, faces) - always
        assert len(wanted) > 10
        # Missing, at most, are faces that lie free in a fold less than 3 mm wide.
        assert len(wanted - found) <= 20


def test_self_contact_refuses_another_body() -> None:
    rest, faces = two_balls(0.5)
    with pytest.raises(MeshError, match=r"rest pose's shape \(1284, 3\), got \(1000, 3\)"):
        SelfContactDetector(faces, rest).detect(rest[:1000])


def test_a_fold_that_nearly_touches_is_no_contact() -> None:
    """A clamp whose jaws are closed to 50 µm, beside two boxes that are pushed into each other."""
    outline = np.array([(0, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)], float)
    caps = [(0, 5, 7), (7, 5, 6), (0, 1, 5), (5, 1, 4), (4, 1, 2), (4, 2, 3)]
    around = [(i, (i + 1) % 8) for i in range(8)]
    sides = [face for i, j in around for face in ((i, j, j + 8), (i, j + 8, i + 8))]
    corner_faces = np.array([*[(a, c, b) for a, b, c in caps], *[(a + 8, b + 8, c + 8) for a, b, c in caps], *sides])
    jaw_vertices, clamp_faces = trimesh.remesh.subdivide(np.zeros((16, 3)), corner_faces)
    box = trimesh.creation.box((1, 1, 1))

    def scene(gap: float, apart: float) -> np.ndarray:
        flat = outline.copy()
        flat[[3, 4], 0] = 1 + gap
        corners = np.concatenate([np.column_stack((flat, np.full(8, z))) for z in (0.0, 1.0)])
        jaws, _ = trimesh.remesh.subdivide(corners, corner_faces)
        both = [box.vertices + np.array(place) for place in ((10, 0, 0), (10 + apart, 0.1, 0.1))]
        return (0.1 * np.concatenate((jaws, *both))).astype(np.float32)

    faces = np.concatenate((clamp_faces, box.faces + len(jaw_vertices), box.faces + len(jaw_vertices) + 8))
    found = SelfContactDetector(faces, scene(1.0, 2.0)).detect(scene(5e-4, 0.9))
    assert len(found.pairs)
    assert found.faces.min() >= len(clamp_faces)
