"""Cloth that has folded over: against a slow levelling, and what it does to shorts in a squat."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core import GarmentPipeline
from refu_core.contact import DEFAULT_CONTACT, Unfold
from refu_core.metrics import SheetChecker
from refu_core.modes import SdfMode
from refu_core.realtime import ContactStage, Outfit, Wearer, dress
from refu_core.realtime._frame import FrameStep
from tests.core.test_layers import normals

Array = NDArray[np.float64]
SHIRT, SHORTS = "tshirt-male", "short-pant-male"


@cache
def outfit() -> Outfit:
    return GarmentPipeline.load([SHIRT, SHORTS], certify=False).outfit


def squat(bend: float) -> Tensor:
    """A pose (1, 24, 3) with hips and knees bent, the trunk bent forward."""
    pose = torch.zeros(1, 24, 3)
    pose[0, 1:3, 0], pose[0, 4:6, 0], pose[0, 3, 0] = -bend, bend, 0.3 * bend
    pose[0, 16, 2], pose[0, 17, 2] = -1.0, 1.0
    return pose


def shorts_in(bend: float) -> tuple[Tensor, Tensor]:
    """Shorts (V, 3) [m] as they are predicted, and the rotations of joints (24, 3, 3)."""
    dressed = dress(squat(bend), Wearer.of(outfit(), torch.zeros(1, 10)))
    return dressed.drapes[SHORTS].vertices[0], dressed.transforms.rotation[0]


def made() -> Unfold:
    shirt, shorts = (outfit().wearables[name].template for name in (SHIRT, SHORTS))
    return Unfold(shorts, [shirt])


def slowly(points: Tensor, rotation: Tensor) -> Array:
    """The same, one vertex at a time."""
    how = DEFAULT_CONTACT
    shirt, shorts = (outfit().wearables[name].template for name in (SHIRT, SHORTS))
    faces, rest = shorts.faces.numpy(), shorts.v_template.double().numpy()
    gap = np.array([np.linalg.norm(shirt.v_template.double().numpy() - p, axis=1).min() for p in rest])
    share = np.clip(2 - gap / how.max_displacement, 0, 1)
    turned = np.einsum("vj,jab,vb->va", shorts.weights.double(), rotation.double(), normals(rest, faces))
    found = points.double().numpy()
    a, b, c = found[faces].transpose(1, 0, 2)
    cross = np.cross(b - a, c - a)
    total, area = np.zeros_like(found), np.zeros(len(found))
    for k in range(3):
        np.add.at(total, faces[:, k], cross)
        np.add.at(area, faces[:, k], np.linalg.norm(cross, axis=1))
    cosine = (total * turned).sum(1) / area
    weight = share * np.clip(1 - cosine / how.alike, 0, 1)
    start, items = shorts.mesh.ring
    rings = [items[start[i] : start[i + 1]] for i in range(len(found))]
    for _ in range(how.around):
        wider = [min(how.fade * weight[around].max(), share[i]) for i, around in enumerate(rings)]
        weight = np.maximum(weight, wider)
    for _ in range(how.levellings):
        mean = np.stack([found[around].mean(axis=0) for around in rings])
        found = found + weight[:, None] * (mean - found)
    return found


def test_equals_the_slow_one_and_whether_it_is_asked_or_not_plays_no_role() -> None:
    points, rotation = shorts_in(1.8)
    unfold = made()
    found = unfold(points, rotation)
    np.testing.assert_allclose(found.numpy(), slowly(points, rotation), atol=2e-5)
    assert (found - points).norm(dim=1).max() > 0.01
    unfold._is_serial = False  # as on a GPU, which isn't waited for
    unasked = unfold(points, rotation)
    torch.testing.assert_close(unasked, found, atol=1e-7, rtol=0)
    assert torch.equal(unfold(points, rotation), unasked)


def test_no_vertex_goes_farther_than_any_may() -> None:
    points, rotation = shorts_in(1.8)
    giant = 4 * points
    moved = (made()(giant, rotation) - giant).norm(dim=1)
    assert 0.0999 < moved.max() <= DEFAULT_CONTACT.max_displacement + 1e-7


def test_cloth_that_faces_where_skinning_turns_it_is_left_as_it_is() -> None:
    shorts = outfit().wearables[SHORTS].template
    still = torch.eye(3).expand(24, 3, 3)
    assert made()(shorts.v_template, still) is shorts.v_template
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.4, 2.0], [-0.4, 0.0, 0.3], [-2.0, -0.3, 0.0]]))
    turned = shorts.v_template @ turn.T
    assert made()(turned, turn.expand(24, 3, 3)) is turned


def test_garments_worn_alone_are_left_to_the_network() -> None:
    alone = GarmentPipeline.load([SHORTS], certify=False).outfit
    points, rotation = shorts_in(1.8)
    assert ContactStage(alone, sdf=SdfMode.HYBRID).unfold(SHORTS, points, rotation) is points


def test_it_goes_with_the_pose_continuously() -> None:
    unfold = made()
    ways = [unfold(*shorts_in(bend)) - shorts_in(bend)[0] for bend in np.arange(1.73, 1.75, 0.001)]
    steps = [float((b - a).norm(dim=1).max()) for a, b in pairwise(ways)]
    assert max(steps) < 0.0015, "in a thousandth of a radian"


def test_shorts_in_a_squat_run_through_themselves_less_and_the_shirt_is_clear_of_them() -> None:
    wearer, margins = Wearer.of(outfit(), torch.zeros(1, 10)), [one.margin for one in outfit().wearables.values()]
    faces = {name: one.template.faces.numpy() for name, one in outfit().wearables.items()}
    checker = SheetChecker(faces[SHORTS])
    own = []
    for unfolds in (False, True):
        stage = ContactStage(outfit(), sdf=SdfMode.HYBRID, certify=False)
        if not unfolds:
            stage._unfold.clear()
        step = FrameStep(outfit(), stage)
        own.append(0)
        between = 0
        for bend in (1.6, 1.8, 2.0):
            (person,) = step(squat(bend), wearer, margins)
            checker.update(person.garments[SHORTS].vertices)
            own[-1] += len(checker.with_itself())
            between += len(checker.with_other(person.garments[SHIRT].vertices.numpy(), faces[SHIRT]))
    assert own[1] < 0.8 * own[0]
    assert between == 0, "of the last, with what has folded over levelled"
