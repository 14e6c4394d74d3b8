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


def made(body: Tensor, sweeps: int = DEFAULT_CONTACT.press_sweeps) -> Press:
    limbs = LimbMeshes(outfit().body)
    limbs.update(body)
    return Press(outfit().wearables[SKIRT].template, limbs, settings=replace(DEFAULT_CONTACT, press_sweeps=sweeps))


def entries(start: NDArray, end: NDArray, triangles: NDArray) -> NDArray:
    """How far from `start` (N, 3) each way to `end` (N, 3) enters the first of `triangles` (F, 3, 3); inf if none."""
    way = end - start
    length = np.linalg.norm(way, axis=1, keepdims=True)
    up = way / length
    a, b, c = triangles.transpose(1, 0, 2)
    found = np.full(len(start), np.inf)
    is_entry = np.zeros(len(start), bool)
    for i in range(len(start)):
        across = np.cross(up[i], c - a)
        det = ((b - a) * across).sum(1)
        from_a = start[i] - a
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (from_a * across).sum(1) / det
            other = np.cross(from_a, b - a)
            v = (other @ up[i]) / det
            t = ((c - a) * other).sum(1) / det
        hits = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if hits.any():
            first = np.where(hits, t, np.inf).argmin()
            found[i] = t[first]
            is_entry[i] = det[first] > 0  # against the normal
    return np.where(is_entry, found, np.inf)


def test_is_what_a_look_from_the_skin_says() -> None:
    points, skin, body = beside(1.45)
    pressed = made(body, sweeps=0)(points, skin).double().numpy()
    x, at = points.double().numpy(), skin.double().numpy()
    wanted = x.copy()
    parts = (joints_of("trunk", "head"), *ARMS)
    of_face = part_of_faces(outfit().body.weights, outfit().body.faces, (*parts, joints_of("left_thigh"))).numpy()
    near = np.flatnonzero(np.abs(pressed - x).sum(1) + (np.arange(len(x)) % 40 == 0))
    height = np.linalg.norm(x - at, axis=1)
    for arm in (1, 2):
        triangles = body.double().numpy()[outfit().body.faces.numpy()[of_face == arm]]
        t = entries(at[near], x[near], triangles)
        room = np.maximum(t - DEFAULT_CONTACT.press_room, 0.5 * t)
        comes_between = (t < height[near] + DEFAULT_CONTACT.press_room) & (room < height[near])
        rows = near[comes_between]
        up = (x[rows] - at[rows]) / height[rows, None]
        wanted[rows] = at[rows] + up * room[comes_between, None]
    assert 20 < (wanted != x).any(axis=1).sum() < len(x) / 4
    np.testing.assert_allclose(pressed[near], wanted[near], atol=1e-5)


def test_room_is_that_of_the_cloth_around_and_what_the_slope_gives() -> None:
    points, skin, body = beside(1.45)
    alone, together = made(body, sweeps=0)(points, skin), made(body)(points, skin)
    height, pressed, reached = ((x - skin).norm(dim=1).double().numpy() for x in (points, alone, together))
    room = np.where(pressed < height - 1e-7, pressed, np.inf)
    edges = outfit().wearables[SKIRT].template.mesh.edges
    lengths = (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=1).double().numpy()
    for sweep in range(DEFAULT_CONTACT.press_sweeps):
        rise = lengths * (0 if sweep < DEFAULT_CONTACT.press_reach else DEFAULT_CONTACT.press_slope)
        others = room[edges[:, ::-1]] + rise[:, None]
        np.minimum.at(room, edges, others)
    assert (reached < height - 1e-4).sum() > 2 * (pressed < height - 1e-4).sum()
    np.testing.assert_allclose(reached, np.minimum(height, room), atol=1e-5)


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
