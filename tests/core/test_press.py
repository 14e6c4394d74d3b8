"""Cloth that other limbs press to the skin that it lies on."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from refu_core import GarmentPipeline
from refu_core.body import ARMS, joints_of, part_of_faces
from refu_core.contact import DEFAULT_CONTACT, LimbMeshes, Press
from refu_core.metrics import CollisionChecker
from refu_core.modes import SdfMode
from refu_core.realtime import ContactStage, Outfit, Wearer, dress

SKIRT = "skirt-female"


@cache
def outfit() -> Outfit:
    return GarmentPipeline.load([SKIRT], backbone="skinned").outfit


def beside(lower: float) -> tuple[Tensor, Tensor, Tensor]:
    """Skirt, the skin that it lies on, and the collider, of somebody whose arms are lowered by `lower` [rad]."""
    pose = torch.zeros(1, 24, 3)
    pose[0, 16, 2], pose[0, 17, 2] = -lower, lower
    dressed = dress(pose, Wearer.of(outfit(), torch.zeros(1, 10)))
    return dressed.drapes[SKIRT].vertices[0], outfit().below[SKIRT](dressed.body)[0], dressed.body[0]


def made(body: Tensor, sweeps: int = DEFAULT_CONTACT.around, *, knows_arms: bool = False) -> Press:
    limbs = LimbMeshes(outfit().body)
    limbs.update(body)
    how = replace(DEFAULT_CONTACT, around=sweeps)
    return Press(outfit().wearables[SKIRT].template, limbs, knows_arms=knows_arms, settings=how)


def distances(points: NDArray[np.float64], triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of points (N, 3) from the closest of triangles (F, 3, 3), by closest points of all of them; inf of none."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    found = np.empty(len(points))
    for i, point in enumerate(points):
        from_a = point - a
        gram = np.stack([(ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)])
        right = np.stack([(ab * from_a).sum(1), (ac * from_a).sum(1)])
        det = gram[0] * gram[2] - gram[1] ** 2
        u, v = (gram[2] * right[0] - gram[1] * right[1]) / det, (gram[0] * right[1] - gram[1] * right[0]) / det
        on_edges = [
            np.linalg.norm(
                point - start - np.clip(((point - start) * way).sum(1) / (way * way).sum(1), 0, 1)[:, None] * way,
                axis=1,
            )
            for start, way in ((a, ab), (a, ac), (a + ab, ac - ab))
        ]
        nearest = np.min(on_edges, axis=0)
        is_within = (u >= 0) & (v >= 0) & (u + v <= 1)
        nearest[is_within] = np.linalg.norm(from_a - u[:, None] * ab - v[:, None] * ac, axis=1)[is_within]
        found[i] = nearest.min(initial=np.inf)
    return found


@pytest.mark.parametrize("knows_arms", [False, True])
def test_is_what_a_look_from_the_skin_says(knows_arms: bool) -> None:
    points, skin, body = beside(1.45)
    press = made(body, sweeps=0, knows_arms=knows_arms)
    pressed = press(points, skin).double().numpy()
    x, at = points.double().numpy(), skin.double().numpy()
    parts = (joints_of("trunk", "head", "left_thigh"), *ARMS)
    of_face = part_of_faces(outfit().body.weights, outfit().body.faces, parts).numpy()
    how, moved = DEFAULT_CONTACT, np.linalg.norm(pressed - x, axis=1)
    farthest = outfit().wearables[SKIRT].template.edge_length if knows_arms else how.limb_reach / 2
    room = how.gap
    near = np.flatnonzero((moved > 0) | (np.arange(len(x)) % 40 == 0))
    height = np.linalg.norm(x - at, axis=1)
    arms = []
    for arm in (1, 2):
        triangles = body.double().numpy()[outfit().body.faces.numpy()[of_face == arm]]
        middle = triangles.mean(1)
        arms.append((triangles, middle, np.linalg.norm(triangles - middle[:, None], axis=2).max(1)))
    wanted = x.copy()
    for v in near:
        h, whole = height[v], height[v] + room
        if not room < h < 2 * how.limb_reach:
            continue
        aside = min(farthest, 2 * h * h / how.limb_reach)
        least = whole
        for arm, middle, radius in arms:
            go = 0.0
            triangles = arm[np.linalg.norm(middle - at[v], axis=1) - radius < whole + aside]  # others don't count
            while go < least:
                off = distances((at[v] + go / h * (x[v] - at[v]))[None], triangles)[0]
                off = min(off, aside * (least - go) / (whole - go))
                least = min(least, go + (whole - go) * off / aside)
                go += max(off, room)
        lies = np.clip(2 - h / how.limb_reach, 0, 1)
        lies *= np.clip(h / room - 1, 0, 1)
        cut = lies * (h - max(least - room, least / 2))
        wanted[v] += (max(h - cut, room / 2) / h - 1) * (x[v] - at[v])
    assert 20 < (np.abs(wanted - x) > 1e-5).any(axis=1).sum() < len(x) / 3
    np.testing.assert_allclose(pressed[near], wanted[near], atol=1e-5)


def test_neighbours_are_drawn_back_as_far_and_the_way_from_there_less() -> None:
    points, skin, body = beside(1.45)
    alone, together = made(body, sweeps=0)(points, skin), made(body)(points, skin)
    cut, reached = ((points - x).norm(dim=1).double().numpy() for x in (alone, together))
    height = (points - skin).norm(dim=1).double().numpy()
    edges = outfit().wearables[SKIRT].template.mesh.edges
    lengths = (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=1).double().numpy()
    sources = (cut > 1e-4).sum()
    for sweep in range(DEFAULT_CONTACT.around):
        rise = lengths * (sweep >= DEFAULT_CONTACT.near)
        others = cut[edges[:, ::-1]] - rise[:, None]
        np.maximum.at(cut, edges, others)
    kept = np.minimum(height, DEFAULT_CONTACT.gap / 2)
    assert (reached > 1e-4).sum() > 1.2 * sources
    np.testing.assert_allclose(reached, height - np.maximum(height - cut, kept), atol=1e-5)


def test_where_no_other_limb_is_near_nothing_moves() -> None:
    points, skin, body = beside(0.3)
    assert made(body)(points, skin) is points


def test_one_list_does_what_the_same_launches_in_every_frame_do() -> None:
    points, skin, body = beside(1.45)
    by_rounds = made(body)
    by_rounds._is_serial = False
    by_rounds(points + 0.01, skin)  # leaves nothing behind
    assert torch.equal(made(body)(points, skin), by_rounds(points, skin))


@given(st.floats(1.3, 1.5), st.floats(-1e-3, 1e-3))
@settings(max_examples=10)
def test_who_has_pressed_neighbours_is_not_thrown(lower: float, further: float) -> None:
    before, after = (
        made(body)(points, skin) - points for points, skin, body in (beside(lower), beside(lower + further))
    )
    # A limb that comes before one more vertex draws it back from where its neighbours are: by an edge's length at most.
    was_pressed = before.any(dim=1) & after.any(dim=1)
    assert max((after - before)[was_pressed].norm(dim=1).tolist(), default=0.0) < 0.02


@given(st.floats(1.2, 1.5), st.floats(-2e-3, 2e-3))
@settings(max_examples=10)
def test_a_limb_that_comes_up_draws_cloth_back_little_by_little(lower: float, further: float) -> None:
    before, after = (
        made(body)(points, skin) - points for points, skin, body in (beside(lower), beside(lower + further))
    )
    # A hand goes 0.8 m from the shoulder: 1.6 mm, at the limit.
    assert (after - before).norm(dim=1).max() < 4 * 0.8 * abs(further) + 1e-4


@pytest.mark.parametrize("lower", [1.42, 1.44, 1.46])
def test_a_hand_beside_a_skirt_dents_it_and_does_not_tear_it(lower: float) -> None:
    points, skin, body = beside(lower)
    template = outfit().wearables[SKIRT].template
    stage = ContactStage(outfit(), sdf=SdfMode.ACCURATE, certify=False)
    stage.update(body)
    checker = CollisionChecker(outfit().body.faces)
    checker.update(body)
    pairs = []
    for vertices in (points, made(body)(points, skin)):
        done = stage.resolvers[SKIRT](vertices, stage.sdf, stage.sdf.query(vertices))
        pairs.append(checker.check(done.vertices, template.faces).n_pairs)
    assert pairs[0] > 10
    assert pairs[1] == 0
