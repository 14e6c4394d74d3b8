"""Distances that contradict each other along the garment's edges."""

from __future__ import annotations

import pytest
import torch
import trimesh
from slow_contact import SlowLimbs, mend, resolve, turn_outward
from torch import Tensor

from refu_core.contact import Blend
from refu_core.metrics import CollisionChecker
from refu_core.sdf import ExactSdf, SdfSample


def sheet(n: int, spacing: float) -> tuple[Tensor, Tensor]:
    """A square sheet of n × n vertices around the origin in the plane y = 0, and its faces, seen from above."""
    x, z = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    points = torch.stack((x, torch.zeros_like(x), z), dim=-1).view(-1, 3) - torch.tensor([n - 1, 0, n - 1]) / 2
    corner = (x * n + z)[:-1, :-1].reshape(-1, 1)
    return points * spacing, torch.cat((corner + torch.tensor([0, 1, n]), corner + torch.tensor([1, n + 1, n])))


def one_limb(faces: Tensor, n_vertices: int, n_body_faces: int, *, foreign: bool = False) -> SlowLimbs:
    own = torch.zeros(n_vertices, 4, dtype=torch.bool)
    own[:, 1 if foreign else 0] = True
    return SlowLimbs(torch.zeros(n_body_faces, dtype=torch.int64), own, faces, torch.full((n_vertices,), 0.01))


def boxes() -> tuple[Tensor, Tensor]:
    """Two boxes of 4 cm height, of which the lower one's top is 1 cm within the upper one: a body that meets itself."""
    upper = trimesh.creation.box((0.3, 0.04, 0.3))
    lower = trimesh.creation.box((0.28, 0.04, 0.28))
    lower.apply_translation((0, -0.03, 0))
    both = trimesh.util.concatenate([upper.subdivide(), lower.subdivide()])
    return torch.tensor(both.vertices, dtype=torch.float32), torch.tensor(both.faces)


def test_a_vertex_within_flesh_that_meets_itself_leaves_with_its_neighbours() -> None:
    """At y = -2 mm a point is in the upper box, and nearest to the lower one's top: outside of that."""
    body, body_faces = boxes()
    points, faces = sheet(21, 0.01)
    points[:, 1] = 0.03 - 0.036 * torch.exp(-((points.norm(dim=1) / 0.06) ** 2))  # from 3 cm down to -6 mm
    sdf = ExactSdf(body_faces)
    sdf.update(body)
    checker = CollisionChecker(body_faces)
    checker.update(body)
    sample = sdf.query(points)
    is_inside = torch.from_numpy(checker.check(points, faces).inside)
    assert (is_inside & (sample.distance > 0)).sum() > 3  # what the test is about
    limbs = one_limb(faces, len(points), len(body_faces))
    mended = mend(points, sample, limbs, margin=0.004)
    assert torch.equal(mended.distance < 0, is_inside)
    blend = Blend.of_faces(faces, len(points))
    assert checker.check(resolve(points, sdf, limbs=limbs, blend=blend).vertices, faces).is_free
    assert not checker.check(resolve(points, sdf, blend=blend).vertices, faces).is_free
    # The same between two limbs is left alone.
    assert mend(points, sample, one_limb(faces, len(points), len(body_faces), foreign=True), margin=0.004) is sample


@pytest.mark.parametrize("depth", [0.02, 0.03])
def test_what_is_inside_keeps_its_own_way_out(depth: float) -> None:
    """A neighbour's tangent plane is for those who are said to be outside: carried on, it would lead ever deeper."""
    body, body_faces = boxes()
    points, faces = sheet(21, 0.01)
    points[:, 1] = 0.03 - (0.03 + depth) * torch.exp(-((points.norm(dim=1) / 0.08) ** 2))
    sdf = ExactSdf(body_faces)
    sdf.update(body)
    sample = sdf.query(points)
    mended = mend(points, sample, one_limb(faces, len(points), len(body_faces)), margin=0.004)
    is_inside = sample.distance < 0
    assert torch.equal(mended.distance[is_inside], sample.distance[is_inside])
    assert torch.equal(mended.gradient[is_inside], sample.gradient[is_inside])
    assert (mended.distance[~is_inside] < 0).any()


def test_a_closest_face_that_was_missed_is_found_from_a_neighbours() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    points, faces = sheet(15, 0.01)
    points[:, 1] += 0.097
    true = sdf.query(points)
    assert true.face is not None
    missed = (points[:, 0] > 0) & (points[:, 2].abs() < 0.015)
    wrong = true._replace(distance=torch.where(missed, 0.05, true.distance))
    asked: list[int] = []

    def look(here: Tensor, near: Tensor) -> SdfSample:
        asked.append(len(here))
        assert set(near.tolist()) <= set(true.face.tolist())  # type: ignore[union-attr]
        return sdf.query(here)

    limbs = one_limb(faces, len(points), len(mesh.faces))
    mended = mend(points, wrong, limbs, margin=0.004, look=look)
    at_the_skin = missed & (true.distance < 0.004)
    torch.testing.assert_close(mended.distance[at_the_skin], true.distance[at_the_skin])
    torch.testing.assert_close(mended.gradient[at_the_skin], true.gradient[at_the_skin])
    assert 0 < sum(asked) < 3 * len(points)
    assert at_the_skin.sum() > 3


def test_consistent_distances_are_left_as_they_are() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    points, faces = sheet(15, 0.01)
    points[:, 1] += 0.09
    sample = sdf.query(points)
    limbs = one_limb(faces, len(points), len(mesh.faces))
    assert mend(points, sample, limbs, margin=0.004, look=lambda here, _: sdf.query(here)) is sample
    assert mend(points, sample._replace(face=None), limbs, margin=0.004).face is None


def test_cloth_deep_in_a_thin_limb_leaves_to_its_own_side() -> None:
    mesh = trimesh.creation.box((0.3, 0.06, 0.3))
    for _ in range(3):
        mesh = mesh.subdivide()
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    checker = CollisionChecker(mesh.faces)
    checker.update(mesh.vertices)
    points, faces = sheet(15, 0.01)
    # A sheet over the box that sinks in beyond its middle: the way down is shorter there.
    points[:, 1] = 0.034 - 0.036 * torch.exp(-((points.norm(dim=1) / 0.03) ** 2))
    sample = sdf.query(points)
    up = torch.tensor([0.0, 1.0, 0.0]).expand_as(points)
    downward = (sample.distance < 0) & (sample.gradient[:, 1] < -0.5)
    assert downward.any()
    turned, looks = turn_outward(points, sample, up, lambda here, _: sdf.query(here))
    torch.testing.assert_close(turned.distance[downward], points[downward, 1] - 0.03, atol=2e-3, rtol=0)
    torch.testing.assert_close(turned.gradient[downward], up[downward])
    assert torch.equal(turned.distance[~downward], sample.distance[~downward])
    assert 0 < looks < 8
    limbs, blend = one_limb(faces, len(points), len(mesh.faces)), Blend.of_faces(faces, len(points))
    assert checker.check(resolve(points, sdf, limbs=limbs, blend=blend).vertices, faces).is_free
    assert not checker.check(resolve(points, sdf, blend=blend).vertices, faces).is_free


def test_without_a_way_out_on_its_own_side_a_vertex_keeps_the_other() -> None:
    mesh = trimesh.creation.box((0.3, 0.3, 0.3))
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    point = torch.tensor([[0.0, -0.1, 0.0]])
    sample = sdf.query(point)
    turned, _ = turn_outward(point, sample, torch.tensor([[0.0, 1.0, 0.0]]), lambda here, _: sdf.query(here))
    assert torch.equal(turned.distance, sample.distance)
    assert torch.equal(turned.gradient, sample.gradient)


def test_where_the_own_side_becomes_too_far_the_way_out_goes_around() -> None:
    """A point that nears the skin: out on its own side at first, at twice the depth by the shortest way, no leap."""
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    height = torch.linspace(0.015, 0.03, 200)
    points = torch.stack((0.1 * height, height, 0.05 * height), dim=1)
    side = torch.tensor([1.0, -0.15, 0.0]).expand_as(points)
    side = side / side.norm(dim=1, keepdim=True)
    sample = sdf.query(points)
    turned, _ = turn_outward(points, sample, side, lambda here, _: sdf.query(here))
    along = (turned.gradient * side).sum(1)
    assert along[0] > 0.99
    assert torch.equal(turned.gradient[-1], sample.gradient[-1])
    ends = points - turned.distance[:, None] * turned.gradient
    assert sdf.query(ends).distance.abs().max() < 2e-3
    assert (ends[1:] - ends[:-1]).norm(dim=1).max() < 3e-3
    assert (ends[0] - ends[-1]).norm() > 0.04
