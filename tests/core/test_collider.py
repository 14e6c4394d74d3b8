"""The collider: a posed body with its overlaps pulled apart."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from refu_core import load_body
from refu_core.body import ARMS, Collider, ColliderSettings, RigidTransforms, SmplBody, rotvec_to_rotmat
from refu_core.body._aside import Aside
from refu_core.body._creases import _parting
from refu_core.errors import MeshError
from refu_core.metrics import SelfContactDetector
from refu_core.realtime import Outfit

if TYPE_CHECKING:
    from numpy.typing import NDArray

MM = 1e-3  # [m]
JOINT = {"left_hip": 1, "right_hip": 2, "left_knee": 4, "spine1": 3, "left_shoulder": 16, "right_shoulder": 17}
JOINT |= {"left_elbow": 18, "right_elbow": 19}
POSES = {
    "hanging arms": {"left_shoulder": (0, 0, -1.35), "right_shoulder": (0, 0, 1.35)},
    "bent elbows": {"left_elbow": (0, -2.2, 0), "right_elbow": (0, 2.2, 0)},
    "sitting": {"left_hip": (-1.5, 0, 0.1), "right_hip": (-1.5, 0, -0.1), "left_knee": (1.5, 0, 0)},
    "bent forward": {"left_hip": (-1.0, 0, 0), "right_hip": (-1.0, 0, 0), "spine1": (0.6, 0, 0)},
}


INSIDE = {
    "hand in the hip": {"left_shoulder": (0, 0, -1.54), "right_shoulder": (0, 0, 1.53)},
    "hand in a thigh that is lifted": {"left_shoulder": (0, 0, -1.5), "left_hip": (0, 0, 0.23)},
}
"""Poses in which an arm is inside the body: it goes aside as a whole."""
CROSSED = {
    "forearms in each other": {
        "left_shoulder": (0, -1.59, -0.15),
        "right_shoulder": (0, 1.61, 0.14),
        "left_elbow": (0, -1.22, 0),
        "right_elbow": (0, 0.79, 0),
    },
}
"""The same of two arms, which both do. On the way there they leap, as they are thin."""
ALL = POSES | INSIDE | CROSSED


def posed(body: SmplBody, turns: dict[str, tuple[float, float, float]]) -> torch.Tensor:
    pose = torch.zeros(1, 24, 3, dtype=body.dtype)
    for joint, turn in turns.items():
        pose[0, JOINT[joint]] = torch.tensor(turn, dtype=body.dtype)
    return pose


@pytest.fixture(scope="module")
def body() -> SmplBody:
    return load_body("male")


@pytest.fixture(scope="module")
def collider(body: SmplBody) -> Collider:
    return Collider(body)


@pytest.fixture(scope="module")
def detector(body: SmplBody) -> SelfContactDetector:
    return SelfContactDetector(body.faces, body.v_template)


def test_the_rest_pose_stays_bit_for_bit(body: SmplBody, collider: Collider) -> None:
    skin = body(pose=posed(body, {}))
    assert torch.equal(collider(skin.vertices, skin.transforms), skin.vertices)


@pytest.mark.parametrize("bend", [("left_elbow", (0, -0.5, 0)), ("left_knee", (0.4, 0, 0)), ("left_hip", (-0.2, 0, 0))])
def test_nothing_moves_before_a_fold_is_half_closed(
    bend: tuple[str, tuple[float, float, float]], body: SmplBody, collider: Collider
) -> None:
    skin = body(pose=posed(body, dict([bend])))
    assert (collider(skin.vertices, skin.transforms) - skin.vertices).norm(dim=2).max() < 0.1 * MM


@pytest.mark.parametrize("name", POSES)
def test_a_pose_that_runs_through_itself_is_pulled_apart(
    name: str, body: SmplBody, collider: Collider, detector: SelfContactDetector
) -> None:
    skin = body(pose=posed(body, POSES[name]))
    apart = collider(skin.vertices, skin.transforms)
    before, after = (detector.detect(one[0]) for one in (skin.vertices, apart))
    assert len(before.pairs) > 10
    assert len(after.pairs) == 0
    assert (apart - skin.vertices).norm(dim=2).max() < 40 * MM


@pytest.mark.parametrize("both", [False, True], ids=["one leg", "both legs"])
@pytest.mark.parametrize("spread", [0.0, 0.15, 0.3])
def test_no_ridge_is_left_at_the_end_of_a_fold(
    spread: float, both: bool, body: SmplBody, collider: Collider, detector: SelfContactDetector
) -> None:
    """At the groin, where the fold of a lifted leg ends: up to 90 degrees, skin has room there."""
    for angle in np.arange(0.7, 1.65, 0.1):
        turns = {"left_hip": (-angle, 0, spread)} | ({"right_hip": (-angle, 0, -spread)} if both else {})
        skin = body(pose=posed(body, turns))
        apart = collider(skin.vertices, skin.transforms)
        assert not len(detector.detect(apart[0]).pairs), f"{angle:.1f} rad"


def test_what_is_far_from_an_overlap_stays(body: SmplBody, collider: Collider) -> None:
    skin = body(pose=posed(body, POSES["bent elbows"]))
    apart = collider(skin.vertices, skin.transforms)
    is_arm = body.weights[:, [13, 14, 16, 17, 18, 19, 20, 21, 22, 23]].sum(1) > 0
    assert torch.equal(apart[0, ~is_arm], skin.vertices[0, ~is_arm])


def test_it_sees_the_pose_alone(body: SmplBody, collider: Collider) -> None:
    skins = [body(pose=posed(body, turns)) for turns in POSES.values()]
    alone = [collider(skin.vertices, skin.transforms) for skin in skins]
    for skin, one in zip(reversed(skins), reversed(alone), strict=True):
        assert torch.equal(collider(skin.vertices, skin.transforms), one)
    together = body(pose=torch.cat([posed(body, turns) for turns in POSES.values()]))
    torch.testing.assert_close(collider(together.vertices, together.transforms), torch.cat(alone), rtol=0, atol=1e-5)


@given(st.sampled_from(sorted(POSES | INSIDE)), st.floats(0.2, 1.0))
def test_it_follows_the_pose_without_jumps(name: str, share: float) -> None:
    body, collider = _the_same()
    poses = torch.cat([s * posed(body, ALL[name]) for s in (share, share - 0.005)])
    skin = body(pose=poses)
    apart = collider(skin.vertices, skin.transforms)
    (a, b), (skin_a, skin_b) = apart, skin.vertices
    assert ((a - b).norm(dim=1) <= 1.5 * (skin_a - skin_b).norm(dim=1).max() + 3 * MM).all()


def test_arms_that_go_through_each_other_leap_by_half_of_their_thickness_at_most(
    body: SmplBody, collider: Collider
) -> None:
    pose = posed(body, CROSSED["forearms in each other"])
    skin = body(pose=torch.cat([share * pose for share in np.arange(0.8, 1.0, 0.005)]))
    way, of_skin = (
        (one[1:] - one[:-1]).norm(dim=2).amax(1) for one in (collider(skin.vertices, skin.transforms), skin.vertices)
    )
    assert float((way - 1.5 * of_skin).max()) < 40 * MM


@pytest.mark.parametrize("name", ALL)
def test_in_double_precision_it_is_the_same_to_a_micrometre(name: str, body: SmplBody, collider: Collider) -> None:
    double = body.to(dtype=torch.float64)
    skin, exact = (one(pose=posed(one, ALL[name])) for one in (body, double))
    fast, slow = collider(skin.vertices, skin.transforms), collider(exact.vertices, exact.transforms)
    assert slow.dtype == torch.float64
    torch.testing.assert_close(fast.double(), slow, rtol=0, atol=2e-6)


@pytest.mark.parametrize("name", POSES)
def test_its_derivative_is_that_of_finite_differences(name: str, body: SmplBody, collider: Collider) -> None:
    double = body.to(dtype=torch.float64)
    random = torch.Generator().manual_seed(1)
    pose = posed(double, POSES[name]).requires_grad_()
    way, weight = (torch.randn(shape, generator=random, dtype=torch.float64) for shape in ((1, 24, 3), (6909, 3)))

    def seen(at: torch.Tensor) -> torch.Tensor:
        skin = double(pose=at)
        return (collider(skin.vertices, skin.transforms)[0] * weight).sum()

    (gradient,) = torch.autograd.grad(seen(pose), pose)
    step = 1e-7
    with torch.no_grad():
        slope = (seen(pose + step * way) - seen(pose - step * way)) / (2 * step)
    torch.testing.assert_close((gradient * way).sum(), slope, rtol=2e-2, atol=1e-2)


@pytest.mark.parametrize("name", INSIDE | CROSSED)
def test_the_derivative_of_arms_that_go_aside(name: str, body: SmplBody, collider: Collider) -> None:
    double = body.to(dtype=torch.float64)
    random = torch.Generator().manual_seed(1)
    pose = posed(double, ALL[name]).requires_grad_()
    way, weight = (torch.randn(shape, generator=random, dtype=torch.float64) for shape in ((1, 24, 3), (6909, 3)))

    def seen(at: torch.Tensor) -> torch.Tensor:
        skin = double(pose=at)
        aside, rotation = collider.aside(skin.vertices, skin.transforms.rotation)
        return (aside[0] * weight).sum() + (rotation * way[..., None]).sum()

    (gradient,) = torch.autograd.grad(seen(pose), pose)
    step = 1e-6
    with torch.no_grad():
        slope = (seen(pose + step * way) - seen(pose - step * way)) / (2 * step)
    torch.testing.assert_close((gradient * way).sum(), slope, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ALL)
def test_it_turns_with_the_body(name: str, body: SmplBody, collider: Collider) -> None:
    skin = body(pose=posed(body, ALL[name]))
    turn = rotvec_to_rotmat(torch.tensor([0.7, -1.9, 0.4]))
    turned = RigidTransforms(turn @ skin.transforms.rotation, skin.transforms.translation @ turn.T)
    apart, apart_turned = collider(skin.vertices, skin.transforms), collider(skin.vertices @ turn.T, turned)
    torch.testing.assert_close(apart_turned @ turn, apart, rtol=0, atol=1e-5)


def test_a_larger_gap_pushes_farther(body: SmplBody) -> None:
    skin = body(pose=posed(body, POSES["hanging arms"]))
    colliders = [Collider(body, settings=ColliderSettings(gap=gap)) for gap in (0.004, 0.012)]
    narrow, wide = (float((one(skin.vertices, skin.transforms) - skin.vertices).norm(dim=2).max()) for one in colliders)
    assert narrow + 2 * MM < wide < narrow + 8 * MM


def test_copies_of_an_outfit_keep_the_settings_of_its_collider(body: SmplBody) -> None:
    settings = ColliderSettings(farthest=0.02)
    outfit = Outfit(body, {}, Collider(body, settings=settings))
    assert {one.collider.settings for one in (outfit.beside(), outfit.to(torch.float64)) if one.collider} == {settings}


@pytest.mark.parametrize("name", INSIDE | CROSSED)
def test_arms_that_are_inside_go_aside(name: str, body: SmplBody, collider: Collider) -> None:
    """As a whole, hands unbent, by what it takes; nothing else moves. Two arms in each other both do."""
    skin = body(pose=posed(body, ALL[name]))
    aside, rotation = collider.aside(skin.vertices, skin.transforms.rotation)
    deep = collider.anatomy.aside._way_out(*_asked(collider, skin.vertices[0])).norm(dim=1)
    left = collider.anatomy.aside._way_out(*_asked(collider, aside[0])).norm(dim=1)
    assert deep.max() > 10 * MM
    assert left.max() < 1 * MM
    way = (aside - skin.vertices)[0].norm(dim=1)
    assert 10 * MM < way.max() < 60 * MM
    is_arm = body.weights[:, [joint for arm in ARMS for joint in arm]].sum(1) > 0
    assert way[~is_arm].max() == 0
    if name in CROSSED:
        assert all(way[body.weights[:, list(arm)].sum(1) > 0.5].max() > 5 * MM for arm in ARMS)
    edges = collider.anatomy.edges[is_arm[collider.anatomy.edges].all(1)]
    before, after = ((one[0, edges[:, 0]] - one[0, edges[:, 1]]).norm(dim=1) for one in (skin.vertices, aside))
    hand = body.weights[:, [20, 21, 22, 23]].sum(1) > 0.999
    is_hand = hand[edges].all(1)
    torch.testing.assert_close(before[is_hand], after[is_hand], atol=1e-5, rtol=0)
    assert not torch.equal(rotation, skin.transforms.rotation)
    assert collider.shift(skin.vertices, aside, aside)[0, 3] == 0


_HUG = (0, -1.47, 0.29), (0, 1.62, 0.42), (0, -2.0, 0), (0, 1.1, 0)


def test_arms_turn_as_their_middles_ask(body: SmplBody, collider: Collider) -> None:
    """Against the definition, middle by middle: of arms in each other and in the chest."""
    turns = dict(zip(CROSSED["forearms in each other"], _HUG, strict=True))
    points, middles = _asked(collider, body(pose=posed(body, turns)).vertices[0])
    aside, n = collider.anatomy.aside, len(middles) // 2
    pivots = aside._means(points[: len(body.v_template)])[: len(ARMS)]
    step = aside._step(points, pivots, middles[:n] - pivots[aside._arm], torch.zeros(2, 3))

    ways, places, shoulders = (one.double().numpy() for one in (aside._way_out(points, middles), middles, pivots))
    assert ways[:n].any()
    assert ways[n:].any()
    asked, total = np.zeros((2, 3)), np.zeros((2, 1))
    for row, (place, way) in enumerate(zip(places, ways, strict=True)):
        own = int(aside._arm[row % n])
        moves = {own: way} if row < n else {own: way, 1 - own: -way}
        squares = sum(np.sum((place - shoulders[arm]) ** 2) for arm in moves)
        for arm, to in moves.items():
            asked[arm] += way @ way * np.cross(place - shoulders[arm], to) / squares
            total[arm] += way @ way
    np.testing.assert_allclose(step.numpy(), asked / total, atol=1e-6, rtol=1e-4)


def test_a_thumb_goes_out_as_far_as_it_was_inside(body: SmplBody, collider: Collider) -> None:
    """Cloth can't follow a dent as narrow as a thumb. Nothing is asked where no middle is inside: it is continuous."""
    skin = body(pose=posed(body, INSIDE["hand in the hip"])).vertices[0]
    aside = collider.anatomy.aside
    points, middles = _asked(collider, skin)
    way, radius = aside._way_out(points, middles), aside._thumb.clone()
    thumb = radius[:, 0].repeat(2)
    assert 2 <= torch.count_nonzero(radius) <= 8
    assert radius.max() < 0.02
    aside._thumb.zero_()
    try:
        depth = aside._way_out(points, middles).norm(dim=1)
    finally:
        aside._thumb.copy_(radius)
    torch.testing.assert_close(way.norm(dim=1), depth + torch.minimum(depth, thumb), atol=1e-6, rtol=1e-5)
    assert (depth[thumb > 0] > 0).any()


def test_an_arm_that_is_too_deep_is_held(body: SmplBody, collider: Collider) -> None:
    """Its middles go as far as an arm may, and it is said."""
    skin = body(pose=posed(body, {"left_shoulder": (0, 0, -2.1)}))
    aside, _ = collider.aside(skin.vertices, skin.transforms.rotation)
    middles = [_middles(collider.anatomy.aside, one[0]) for one in (skin.vertices, aside)]
    assert float((middles[1] - middles[0]).norm(dim=1).max()) == pytest.approx(
        collider.settings.aside_farthest, rel=0.02
    )
    apart = collider.apart(aside, skin.transforms.rotation)
    assert collider.shift(skin.vertices, aside, aside)[0, 3] > 0

    went, gave, way = (
        (b - a).norm(dim=2)[0] for a, b in ((skin.vertices, aside), (aside, apart), (skin.vertices, apart))
    )
    is_held = (went > 0.99 * collider.settings.aside_farthest) | (gave > 0.99 * collider.anatomy.farthest)
    wanted = torch.stack(((way > 1e-4).sum(), way.max(), way.mean(), is_held.sum()))
    torch.testing.assert_close(collider.shift(skin.vertices, aside, apart)[0], wanted, atol=1e-6, rtol=1e-5)


def _middles(aside: Aside, skin: torch.Tensor) -> torch.Tensor:
    """The middles of arms, palms, fingers and thumbs of `skin` (V, 3) [m], shape (C, 3)."""
    return aside._means(skin)[len(ARMS) : aside._first_cap]


def _asked(collider: Collider, skin: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Skin (V, 3) [m] with the middles of its caps, which the trees are of from now on, and what may be inside them."""
    aside = collider.anatomy.aside
    aside(skin, torch.eye(3).expand(24, 3, 3))
    return torch.cat((skin, aside._means(skin)[aside._first_cap :])), _middles(aside, skin).repeat(2, 1)


def test_a_seam_parts_the_means_of_the_skin_on_its_two_sides(body: SmplBody) -> None:
    """Against the definition, place by place, to the bit; a place with skin of one side or none is left at zero."""
    rng = np.random.default_rng(0)
    rest = body.v_template.double().numpy()
    places = rest[rng.integers(0, len(rest), 60)] + rng.normal(0, 0.02, (60, 3))
    is_moved = rest @ rng.normal(size=3) > 0
    wanted = np.zeros((60, 3))
    tree = cKDTree(rest)
    for i, near in enumerate(tree.query_ball_point(places, 0.03)):
        weight = np.maximum(0.03 - np.linalg.norm(rest[near] - places[i], axis=1), 1e-9)
        on = is_moved[near]
        if on.any() and not on.all():
            means = [np.average(rest[near][one], axis=0, weights=weight[one]) for one in (on, ~on)]
            wanted[i] = (means[0] - means[1]) / np.linalg.norm(means[0] - means[1])
    assert 0 < np.count_nonzero(wanted.any(1)) < 60
    np.testing.assert_array_equal(_parting(places, rest, is_moved, tree), wanted)


def test_arms_that_are_outside_stay(body: SmplBody, collider: Collider) -> None:
    for turns in ({}, POSES["hanging arms"], POSES["bent elbows"], POSES["sitting"]):
        skin = body(pose=posed(body, turns))
        aside, rotation = collider.aside(skin.vertices, skin.transforms.rotation)
        assert torch.equal(aside, skin.vertices)
        assert torch.equal(rotation, skin.transforms.rotation)


def test_no_body_at_all(body: SmplBody, collider: Collider) -> None:
    skin = body(pose=torch.zeros(0, 24, 3))
    assert collider(skin.vertices, skin.transforms).shape == (0, body.n_vertices, 3)


def test_a_body_of_another_topology(body: SmplBody) -> None:
    """One edge collapsed after another, until it has the number of vertices that SMPL's own body has."""
    coarse = _with_fewer_vertices(body, 6890)
    assert coarse.n_vertices == 6890
    skin = coarse(pose=posed(coarse, POSES["hanging arms"]))
    apart = Collider(coarse)(skin.vertices, skin.transforms)
    seen = SelfContactDetector(coarse.faces, coarse.v_template)
    assert len(seen.detect(skin.vertices[0]).pairs) > 10 > len(seen.detect(apart[0]).pairs)


def test_thighs_that_touch_at_rest_are_as_thick_as_others(body: SmplBody, collider: Collider) -> None:
    """As SMPL's do. They were taken to be as thin as they overlap, and no skin moves by more than a share of that."""
    closed = body(pose=posed(body, {"left_hip": (0, 0, -0.28), "right_hip": (0, 0, 0.28)}))
    touching = _replaced(body, v_template=closed.vertices[0].numpy())
    left = touching.weights.argmax(1) == 1
    assert touching.v_template[left, 0].min() < -5 * MM
    thighs = touching.weights[:, 1:3].sum(1) > 0.99
    thickness = Collider(touching).anatomy.thickness
    assert (thickness / collider.anatomy.thickness)[thighs].min() > 0.9


def test_an_open_body_is_refused(body: SmplBody) -> None:
    open_body = _replaced(body, f=body.faces.numpy()[1:])
    with pytest.raises(MeshError, match="watertight"):
        Collider(open_body)


@pytest.mark.skipif("REFU_MOTIONS" not in os.environ, reason="no folder of recorded motion (REFU_MOTIONS)")
def test_recorded_motion(body: SmplBody, collider: Collider, detector: SelfContactDetector) -> None:
    free, shift = [], []
    for path in sorted(Path(os.environ["REFU_MOTIONS"]).glob("*.npz")):
        poses = np.load(path)["poses"][::120, :72].reshape(-1, 24, 3)
        skin = body(pose=poses)
        for one, apart in zip(skin.vertices, collider(skin.vertices, skin.transforms), strict=True):
            free.append(len(detector.detect(apart).pairs) == 0)
            shift.append(float((apart - one).norm(dim=1).max()))
    assert np.mean(free) > 0.6  # of the whole body: hands and faces, too
    assert np.median(shift) < 35 * MM
    assert max(shift) < 70 * MM


_ONE: list[tuple[SmplBody, Collider]] = []


def _the_same() -> tuple[SmplBody, Collider]:
    if not _ONE:
        body = load_body("male")
        _ONE.append((body, Collider(body)))
    return _ONE[0]


def _replaced(body: SmplBody, **arrays: NDArray[np.generic]) -> SmplBody:
    from refu_core.body._model import BodyArrays

    known = body.arrays
    given_ = {
        "v_template": known.v_template,
        "f": known.faces,
        "weights": known.weights,
        "J_regressor": known.joint_regressor,
        "shapedirs": known.shapedirs,
        "kintree_table": np.stack(
            [[-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, *range(16, 22)], range(24)]
        ),
    }
    return SmplBody(BodyArrays.from_mapping({**given_, **arrays}, source="test"), name="test")


def _with_fewer_vertices(body: SmplBody, n: int) -> SmplBody:
    faces, known = body.faces.numpy().copy(), body.arrays
    gone = np.zeros(body.n_vertices, bool)
    locked = np.zeros(body.n_vertices, bool)
    for a, b, _ in faces[::40]:
        if body.n_vertices - gone.sum() == n:
            break
        around = [np.unique(faces[(faces == v).any(1)]) for v in (a, b)]
        if locked[np.concatenate(around)].any() or len(np.intersect1d(*around)) != 4:
            continue
        faces[faces == b] = a
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        gone[b] = True
        locked[np.concatenate(around)] = True
    number = np.cumsum(~gone) - 1
    regressor = known.joint_regressor[:, ~gone]
    return _replaced(
        body,
        v_template=known.v_template[~gone],
        f=number[faces],
        weights=known.weights[~gone],
        J_regressor=regressor / regressor.sum(1, keepdims=True),
        shapedirs=known.shapedirs[~gone],
    )
