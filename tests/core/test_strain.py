"""Cloth that was torn apart is drawn together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from refu_core import load_garment
from refu_core.contact import DEFAULT_CONTACT, StrainLimit
from refu_core.mesh import Connectivity

CPU = torch.device("cpu")
LIMIT = DEFAULT_CONTACT.strain_limit
SHORTS = load_garment("short-pant-male")
REST = SHORTS.v_template


def strip() -> tuple[Connectivity, Tensor]:
    """A flat strip of 2 x 30 vertices, 1 cm apart."""
    n = 30
    rest = torch.tensor([[0.01 * (i % n), 0.01 * (i // n), 0.0] for i in range(2 * n)])
    faces = [face for i in range(n - 1) for face in ((i, i + 1, n + i), (i + 1, n + i + 1, n + i))]
    return Connectivity.of(np.array(faces), 2 * n), rest


def strains(points: Tensor, rest: Tensor, edges: NDArray[np.int32]) -> NDArray[np.float64]:
    now, before = (np.linalg.norm(np.subtract(*one.double().numpy()[edges.T]), axis=1) for one in (points, rest))
    strain: NDArray[np.float64] = now / before
    return strain


def slow(points: Tensor, rest: Tensor, mesh: Connectivity, sweeps: int) -> Tensor:
    """Edge by edge, as it is written; a sweep's edges don't know of each other."""
    x, r = points.double().numpy().copy(), rest.double().numpy()
    i, j = mesh.edges.T
    longest = LIMIT * np.linalg.norm(r[j] - r[i], axis=1)
    for _ in range(sweeps):
        total, way = np.zeros_like(x), x[j] - x[i]
        length = np.linalg.norm(way, axis=1)
        half = (0.5 * (length - longest).clip(0) / length)[:, None] * way
        np.add.at(total, i, half)
        np.add.at(total, j, -half)
        x += total / np.diff(mesh.ring.start)[:, None]
    return torch.tensor(x)


def torn(seed: int) -> Tensor:
    """Shorts of which a few vertices are centimetres away."""
    generator = torch.Generator().manual_seed(seed)
    points = REST.clone()
    rows = torch.randint(len(points), (8,), generator=generator)
    points[rows] += 0.03 * torch.randn(8, 3, generator=generator)
    return points


@given(st.integers(0, 2**31))
@settings(max_examples=8)
def test_does_what_edges_say_one_by_one(seed: int) -> None:
    points = torn(seed)
    limited = StrainLimit(SHORTS.mesh, CPU)(points, REST, REST)
    expected = slow(points, REST, SHORTS.mesh, DEFAULT_CONTACT.sweeps)
    torch.testing.assert_close(limited.double(), expected, rtol=0, atol=1e-6)


def test_a_thrown_vertex_comes_back_to_its_neighbours() -> None:
    points = REST.clone()
    thrown = 1000
    points[thrown] += torch.tensor([0.0, 0.0, 0.08])
    before = strains(points, REST, SHORTS.mesh.edges)
    after = strains(StrainLimit(SHORTS.mesh, CPU)(points, REST, REST), REST, SHORTS.mesh.edges)
    assert before.max() > 6
    assert after.max() < 1.05 * LIMIT


def test_what_is_not_torn_stays_as_it_is() -> None:
    points = REST * torch.tensor([1.2, 1.3, 0.8])
    assert strains(points, REST, SHORTS.mesh.edges).max() < LIMIT
    assert StrainLimit(SHORTS.mesh, CPU)(points, REST, REST) is points


def test_how_long_cloth_may_be_is_the_wearers() -> None:
    """Who is larger has longer edges at rest."""
    points = 1.7 * REST
    assert StrainLimit(SHORTS.mesh, CPU)(points, REST, 1.2 * REST) is points
    assert StrainLimit(SHORTS.mesh, CPU)(points, REST, REST) is not points


def test_what_was_as_long_before_contact_stays() -> None:
    """A network may stretch cloth as it likes: what this mends is what contact has done."""
    points = torn(2)
    limit = StrainLimit(SHORTS.mesh, CPU)
    assert limit(points, points, REST) is points
    assert limit(points, REST, REST) is not points


@given(st.floats(0.0, 0.05), st.floats(-1e-4, 1e-4))
@settings(max_examples=20)
def test_it_is_continuous(away: float, further: float) -> None:
    mesh, rest = strip()
    limit = StrainLimit(mesh, CPU)
    results = []
    for height in (away, away + further):
        points = rest.clone()
        points[10, 2] += height
        results.append(limit(points, rest, rest))
    assert (results[0] - results[1]).norm(dim=1).max() <= 2 * abs(further) + 1e-6


def test_one_list_does_what_the_same_launches_in_every_frame_do() -> None:
    points = torn(3)
    on_a_gpu = StrainLimit(SHORTS.mesh, CPU)
    on_a_gpu._is_serial = False
    on_a_gpu(torn(4), REST, REST)  # leaves nothing behind
    assert torch.equal(on_a_gpu(points, REST, REST), StrainLimit(SHORTS.mesh, CPU)(points, REST, REST))


def test_no_sweeps_change_nothing() -> None:
    points = torn(1)
    still = StrainLimit(SHORTS.mesh, CPU, settings=replace(DEFAULT_CONTACT, around=0))
    assert torch.equal(still(points, REST, REST), points)
