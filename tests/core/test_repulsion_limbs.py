"""Cloth between two limbs: it leaves the other limb on the near side, and is never torn around it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from slow_contact import SlowLimbs, resolve

from refu_core import GarmentTemplate, SmplBody, load_body, load_garment
from refu_core.metrics import CollisionChecker, SelfContactDetector
from refu_core.sdf import ExactSdf


def dressed(lower: float, *, garment: str = "tshirt-male") -> tuple[torch.Tensor, ExactSdf, SlowLimbs, torch.Tensor]:
    """A garment that follows the skin, on a body whose arms are lowered by `lower` [rad]."""
    template = load_garment(garment)
    body = load_body(template.body)
    pose = torch.zeros(1, 24, 3)
    pose[0, 16, 2], pose[0, 17, 2] = -lower, lower
    out = body(pose)
    sdf = ExactSdf(body.faces)
    sdf.update(out.vertices[0])
    points = template.pose(template.rest(torch.zeros(1, 10)), out.transforms)[0]
    return points, sdf, limbs_of(body, template), template.edges


def limbs_of(body: SmplBody, template: GarmentTemplate) -> SlowLimbs:
    rest = ExactSdf(body.faces)
    rest.update(body.v_template)
    clearance = rest.query(template.v_template).distance
    return SlowLimbs.of(body.weights, body.faces, template.weights, template.faces, clearance=clearance)


def test_more_frames_are_free_of_collisions(motions: list[Path]) -> None:
    """Away from places where the body intersects itself, on frames of recorded motion with grazing arms."""
    template, body = load_garment("shirt-male"), load_body("male")
    limbs, edges, faces = limbs_of(body, template), template.edges, template.faces.numpy()
    sdf, checker = ExactSdf(body.faces), CollisionChecker(body.faces)
    detector = SelfContactDetector(body.faces, body.v_template)
    free = {False: 0, True: 0}
    for clip in motions:
        with np.load(clip) as data:
            poses = torch.tensor(data["poses"], dtype=torch.float32).view(-1, 1, 24, 3)
        for pose in (poses[len(poses) // 5], poses[len(poses) // 2]):
            out = body(pose)
            sdf.update(out.vertices[0])
            checker.update(out.vertices[0])
            contact = detector.detect(out.vertices[0])
            points = template.pose(template.rest(torch.zeros(1, 10)), out.transforms)[0]
            for use in free:
                done = resolve(points, sdf, edges=edges, limbs=limbs if use else None).vertices
                away = ~(contact.near(points) | contact.near(done))
                colliding = checker.check(done, faces).pairs[:, 0]
                free[use] += not away[faces[colliding]].all(axis=1).any()
    assert free[True] > free[False]


@pytest.mark.parametrize("lower", [1.5, 1.65, 1.75])
def test_nothing_stays_inside_that_can_leave(lower: float) -> None:
    points, sdf, limbs, edges = dressed(lower)
    done = resolve(points, sdf, edges=edges, limbs=limbs)
    assert done.n_inside > 100
    assert done.n_unresolved == 0
    assert float(sdf.query(done.vertices).distance.min()) > 0


def test_what_cannot_leave_stays_where_it_was() -> None:
    points, sdf, limbs, edges = dressed(1.7)
    done = resolve(points, sdf, edges=edges, limbs=limbs, max_displacement=0.006)
    stuck = done.distance < 0
    assert 0 < int(stuck.sum()) == done.n_unresolved
    torch.testing.assert_close(done.vertices[stuck], points[stuck], atol=0, rtol=0)


def test_missing_vertices_take_their_neighbours_mean() -> None:
    points, _, limbs, _ = dressed(0.0)
    rows = torch.tensor([5, 900, 901])
    mean = limbs.mean_of_neighbours(points, rows)
    faces = limbs.faces.tolist()
    for row, found in zip(rows.tolist(), mean, strict=True):
        around = [v for face in faces if row in face for v in face if v not in rows.tolist()]
        weighted = torch.stack([points[v] for v in around]).mean(0)  # a neighbour counts once a face that both share
        torch.testing.assert_close(found, weighted, atol=1e-6, rtol=0)


def test_where_nothing_touches_limbs_change_nothing() -> None:
    points, sdf, limbs, edges = dressed(0.4)
    free = resolve(points, sdf, edges=edges)
    held = resolve(points, sdf, edges=edges, limbs=limbs)
    torch.testing.assert_close(held.vertices, free.vertices, atol=0, rtol=0)


def test_limbs_of_body_and_garment() -> None:
    template = load_garment("shirt-male")
    body = load_body("male")
    limbs = limbs_of(body, template)
    centre = body.v_template[body.faces].mean(1)
    assert set(limbs.of_face[centre[:, 0] > 0.5].tolist()) == {1}, "the left arm is at +x in the T-pose"
    assert set(limbs.of_face[centre[:, 0] < -0.5].tolist()) == {2}
    assert set(limbs.of_face[centre[:, 1] < -0.6].tolist()) == {3}
    sleeve = template.v_template[:, 0] > 0.5
    assert limbs.own[sleeve].sum(0).tolist() == [0, int(sleeve.sum()), 0, 0]
    assert limbs.own.any(1).all()


def test_outward_normals_point_away_from_the_skin() -> None:
    points, sdf, limbs, _ = dressed(0.0)
    outward = limbs.outward(points)
    np.testing.assert_allclose(outward.norm(dim=-1).numpy(), 1, atol=1e-5)
    aligned = (outward * sdf.query(points).gradient).sum(-1)
    assert float((aligned > 0).float().mean()) > 0.99


def test_outward_normals_against_their_definition() -> None:
    points, _, limbs, _ = dressed(0.4)
    summed = np.zeros(points.shape)
    a, b, c = points.double().numpy()[limbs.faces.numpy()].transpose(1, 0, 2)
    for corner in limbs.faces.numpy().T:
        np.add.at(summed, corner, np.cross(b - a, c - a))
    wanted = summed / np.linalg.norm(summed, axis=1, keepdims=True)
    np.testing.assert_allclose(limbs.outward(points).numpy(), wanted, atol=1e-4)
