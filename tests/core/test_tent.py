"""Cloth that hangs behind the legs stays behind the shins."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from refu_core import load_body, load_garment
from refu_core.body import LEGS, SmplBody, weight_of_parts
from refu_core.contact import Shins, Tent
from refu_core.garments import BUILTIN_GARMENTS, GarmentTemplate

HIPS, KNEES, ANKLES = (1, 2), (4, 5), (7, 8)
SKIRT = "skirt-female"


@cache
def worn() -> tuple[GarmentTemplate, SmplBody, Shins]:
    garment = load_garment(SKIRT)
    body = load_body(garment.body)
    return garment, body, Shins(body)


def pose_of(hips: tuple[float, float] = (0.0, 0.0), knees: tuple[float, float] = (0.0, 0.0)) -> Tensor:
    """A pose (1, 24, 3) of legs that swing forwards and knees that bend [rad], left and right."""
    pose = torch.zeros(1, 24, 3)
    pose[0, list(HIPS), 0], pose[0, list(KNEES), 0] = -torch.tensor(hips), torch.tensor(knees)
    return pose


def skinned(pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The skirt as skinning leaves it (N, 3), the body (V, 3) and its joints (24, 3) [m]."""
    garment, body, _ = worn()
    posed = body(pose)
    return garment.pose(garment.v_template[None], posed.transforms)[0], posed.vertices[0], posed.joints[0]


def brought(cloth: Tensor, body: Tensor) -> Tensor:
    garment, _, shins = worn()
    shins.update(body)
    return Tent(garment, shins)(cloth)


def shortest(left: NDArray[np.float64], right: NDArray[np.float64], need: NDArray[np.float64]) -> NDArray[np.float64]:
    """The shortest vector with these parts along two unit vectors, by a solver."""
    ways = np.stack([left, right])
    found = minimize(
        lambda x: x @ x,
        np.zeros(3),
        jac=lambda x: 2 * x,
        constraints={"type": "ineq", "fun": lambda x: ways @ x - need, "jac": lambda _: ways},
        method="SLSQP",
        options={"ftol": 1e-14},
    )
    return np.asarray(found.x)


def slow(cloth: NDArray[np.float64], posed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vertex by vertex; each shin stands as the affine map says that fits its skin best."""
    garment, body, shins = worn()
    at_rest, skin = body(torch.zeros(1, 24, 3)).joints[0].double().numpy(), body.v_template.double().numpy()
    follows = weight_of_parts(garment.weights, LEGS).double().numpy()
    stands = []
    for knee, ankle in zip(KNEES, ANKLES, strict=True):
        own = (body.weights.argmax(1) == knee).numpy()
        fit = np.linalg.lstsq(np.c_[skin[own], np.ones(own.sum())], posed[own])[0]
        places = np.stack([at_rest[knee], at_rest[ankle], at_rest[knee] - (0, 0, 1)])
        stands.append(np.c_[places, np.ones(3)] @ fit)
    out = cloth.copy()
    for v, at in enumerate(cloth):
        ways, needs = [], []
        for leg, (knee, ankle, behind_knee) in enumerate(stands):
            bone = ankle - knee
            back = behind_knee - knee
            back -= back @ bone / (bone @ bone) * bone
            back /= np.linalg.norm(back)
            ways.append(back)
            off = at - knee - np.clip((at - knee) @ bone / (bone @ bone), 0, 1) * bone
            beside = np.linalg.norm(off - off @ back * back)
            radius = shins.radius[leg]
            tent = np.sqrt(radius**2 - beside**2) if beside < radius / np.sqrt(2) else np.sqrt(2) * radius - beside
            was = at_rest[ANKLES[leg]] - at_rest[KNEES[leg]]
            rest = garment.v_template[v].double().numpy() - at_rest[KNEES[leg]]
            behind = -(rest - np.clip(rest @ was / (was @ was), 0, 1) * was)[2]
            weight = np.clip(behind / radius, 0, 1) * min(1, 2 * follows[v, leg])
            needs.append(weight * (min(tent, behind) - off @ back))
        if max(needs) > 0:
            out[v] += shortest(ways[0], ways[1], np.array(needs))
    return out


def test_as_a_slow_reference_has_it() -> None:
    garment, _, _ = worn()
    cloth, body, _ = skinned(pose_of((0.2, -0.1), (0.8, 0.3)))
    # Deeper than any network leaves it, so that both tents have their say.
    cloth = cloth + torch.tensor([0.0, -0.05, 0.12])
    fast = brought(cloth, body)
    some = np.unique(
        np.r_[np.nonzero(((fast - cloth).norm(dim=1) > 1e-4).numpy())[0][::12], : garment.n_vertices : 400]
    )
    wanted = slow(cloth.double().numpy(), body.double().numpy())[some]
    assert np.abs(wanted - cloth.numpy()[some]).max() > 0.02
    np.testing.assert_allclose(fast.numpy()[some], wanted, atol=2e-5)


@pytest.mark.parametrize("name", BUILTIN_GARMENTS)
def test_nothing_moves_at_rest(name: str) -> None:
    garment = load_garment(name)
    body = load_body(garment.body)
    shins = Shins(body)
    shins.update(body.v_template)
    torch.testing.assert_close(Tent(garment, shins)(garment.v_template), garment.v_template, atol=1e-6, rtol=0)


def test_shins_are_as_wide_as_their_skin() -> None:
    _, body, shins = worn()
    off = (body.v_template - body(torch.zeros(1, 24, 3)).joints[0, 4])[:, ::2].norm(dim=1)
    own = body.weights.argmax(1) == 4
    assert abs(float(off[own].mean()) - shins.radius[0]) < 0.01


def test_a_heel_goes_up_behind_a_skirt() -> None:
    garment, _, shins = worn()
    cloth, body, joints = skinned(pose_of(knees=(1.9, 0.0)))
    knee, bone = joints[4], joints[7] - joints[4]
    hangs = torch.from_numpy(shins.behind(garment.v_template.double().numpy())[:, 0] > shins.radius[0])
    hangs &= garment.weights[:, list(LEGS[0])].sum(1) > 0.5

    def depth(at: Tensor) -> float:
        """How deep cloth is in the shin's cylinder [m]."""
        off = at[hangs] - knee
        along = (off @ bone / (bone @ bone)).clamp(0, 1)
        return float((shins.radius[0] - (off - along[:, None] * bone).norm(dim=1)).max())

    assert depth(cloth) > 0.03
    assert depth(brought(cloth, body)) < 0.5 * depth(cloth)


def test_legs_of_shorts_have_each_its_own_tent() -> None:
    garment = load_garment("short-pant-male")
    body = load_body(garment.body)
    posed = body(pose_of(hips=(0.7, -0.5)))  # a long step: each leg is far behind or before the other's cloth
    shins = Shins(body)
    shins.update(posed.vertices[0])
    cloth = garment.pose(garment.v_template[None], posed.transforms)[0]
    assert float((Tent(garment, shins)(cloth) - cloth).norm(dim=1).max()) < 0.005


def test_it_goes_with_a_body_that_turns() -> None:
    cloth, body, _ = skinned(pose_of((0.3, 0.1), (1.5, 0.4)))
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    turn = turn * torch.linalg.det(turn)
    shift = torch.tensor([0.3, -0.2, 0.5])
    torch.testing.assert_close(
        brought(cloth @ turn.T + shift, body @ turn.T + shift), brought(cloth, body) @ turn.T + shift, atol=1e-5, rtol=0
    )


angle = st.floats(-0.5, 2.2)


@settings(max_examples=40)
@given(st.tuples(angle, angle), st.tuples(angle, angle), st.floats(-1, 1), st.integers(0, 99))
def test_it_is_continuous(hips: tuple[float, float], knees: tuple[float, float], side: float, seed: int) -> None:
    garment, _, _ = worn()
    pose = pose_of(hips, knees)
    pose[0, 1, 2] = side  # legs apart, or across each other
    cloth, body, _ = skinned(pose)
    step = 1e-4 * torch.randn(garment.n_vertices, 3, generator=torch.Generator().manual_seed(seed))
    moved = brought(cloth + step, body) - brought(cloth, body)
    assert float((moved.norm(dim=1) / step.norm(dim=1)).max()) < 6
    turned = pose + 1e-3 * torch.randn(1, 24, 3, generator=torch.Generator().manual_seed(seed))
    a, b = skinned(pose), skinned(turned)
    assert float((brought(b[0], b[1]) - brought(a[0], a[1])).norm(dim=1).max()) < 0.02


def test_a_leg_without_skin_has_no_tent() -> None:
    garment, body, _ = worn()
    weights = body.weights.clone()
    weights[:, HIPS[0]] += weights[:, KNEES[0]]
    weights[:, KNEES[0]] = 0
    bare = SmplBody.__new__(SmplBody)
    bare.__dict__.update(body.__dict__)
    bare.weights = weights
    shins = Shins(bare)
    cloth, posed, _ = skinned(pose_of(knees=(1.9, 0.0)))
    shins.update(posed)
    out = Tent(garment, shins)(cloth)
    assert torch.isfinite(out).all()
    torch.testing.assert_close(out, cloth, atol=0.02, rtol=0)
