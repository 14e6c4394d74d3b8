"""The distance within a band is the exact one, and nothing inside the body goes unseen."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from refu_core.body import load_body
from refu_core.errors import MeshError
from refu_core.garments import PAPER_GARMENTS, load_garment
from refu_core.mesh import Adjacency, Connectivity, grouped
from refu_core.metrics._self_contact import SelfContactDetector
from refu_core.sdf import ExactSdf
from refu_core.sdf._band import BAND, BandSdf
from refu_core.simulation import load_clips

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
SHELL = trimesh.creation.icosphere(subdivisions=5, radius=1.0)  # edges of 3.5 % of its radius


def posed_ball() -> tuple[BandSdf, ExactSdf]:
    band, exact = BandSdf(BALL.faces), ExactSdf(BALL.faces)
    for sdf in (band, exact):
        sdf.update(torch.tensor(BALL.vertices, dtype=torch.float32))
    return band, exact


def ring_of(mesh: trimesh.Trimesh) -> Adjacency:
    return Connectivity.of(mesh.faces, len(mesh.vertices)).ring


SHELL_RING = ring_of(SHELL)


def shell(radius: float, centre: tuple[float, float, float] = (0, 0, 0)) -> Tensor:
    return torch.tensor(SHELL.vertices * radius + np.array(centre), dtype=torch.float32)


def smooth_noise(garment_edges: Tensor, n: int, size: float, generator: torch.Generator) -> Tensor:
    noise = torch.randn(n, 3, generator=generator)
    for _ in range(30):
        total = noise.clone()
        degree = torch.ones(n, 1)
        for a, b in ((0, 1), (1, 0)):
            total.index_add_(0, garment_edges[:, a], noise[garment_edges[:, b]])
            degree.index_add_(0, garment_edges[:, a], torch.ones(len(garment_edges), 1))
        noise = total / degree
    return noise * (size / noise.norm(dim=1).square().mean().sqrt())


@pytest.mark.parametrize("name", PAPER_GARMENTS)
def test_clipped_is_exact_and_sees_all_that_is_inside(name: str, motions: list[Path]) -> None:
    """Frames of every motion in a row: each is a jump from the last one."""
    garment = load_garment(name)
    body = load_body(garment.body)
    band, exact = BandSdf(body.faces), ExactSdf(body.faces)
    ring = garment.mesh.ring
    detector = SelfContactDetector(body.faces, body.v_template)
    generator = torch.Generator().manual_seed(1)
    clips = [clip for path in motions for clip in load_clips(path)]
    n_inside = n_clipped = 0
    for size, clip in zip((0.0, 0.004, 0.008) * len(clips), clips, strict=False):
        betas = torch.randn(1, 10, generator=generator)
        pose = torch.as_tensor(clip.poses[int(torch.randint(len(clip.poses), (), generator=generator))])[None]
        posed = body(pose, betas)
        noise = smooth_noise(garment.edges, garment.n_vertices, size, generator)
        points = garment.pose(garment.rest(betas) + noise, posed.transforms)[0]
        for sdf in (band, exact):
            sdf.update(posed.vertices[0])
        got, wanted = band.clipped(points, ring), exact.query(points)
        known = got.distance < BAND
        assert (got.distance[known] - wanted.distance[known]).abs().max() < 1e-6
        assert (got.gradient - wanted.gradient)[known].norm(dim=1).quantile(0.99) < 1e-3
        assert (got.distance[~known] == BAND).all()
        beyond = wanted.distance[~known] >= BAND - 1e-6
        if not beyond.all():  # "inside" is ambiguous where the body runs into itself
            wrong = points[~known][~beyond]
            assert detector.detect(posed.vertices[0]).near(wrong, distance=0.05).all()
            assert len(wrong) < 0.005 * len(points)
        n_inside += int((wanted.distance < 0).sum())
        n_clipped += int((~known).sum())
    assert n_inside > 100  # or this has tested nothing
    assert n_clipped > 0.5 * garment.n_vertices


@pytest.mark.parametrize(
    ("radius", "centre", "inside"),
    [
        (0.1, (0, 0, 0), 1.0),  # wholly inside, no vertex near the skin
        (0.2, (5, 0, 0), 0.0),  # wholly outside, the same
        (0.1, (0.3, 0, 0), 0.4),  # half of it
        (0.305, (0, 0, 0), 0.0),  # all of it in the band
        (0.29, (0, 0, 0), 1.0),
    ],
)
def test_shells(radius: float, centre: tuple[float, float, float], inside: float) -> None:
    band, exact = posed_ball()
    points = shell(radius, centre)
    got, wanted = band.clipped(points, SHELL_RING).distance, exact.query(points).distance
    torch.testing.assert_close(got, wanted.clamp(max=BAND), atol=1e-6, rtol=0)
    assert (got < 0).float().mean() == pytest.approx(inside, abs=0.1)


@settings(max_examples=60)
@given(
    radius=st.floats(0.01, 0.6),
    x=st.floats(-0.7, 0.7),
    y=st.floats(-0.7, 0.7),
    width=st.sampled_from([0.002, 0.008, 0.05]),
)
def test_any_shell_with_any_band(radius: float, x: float, y: float, width: float) -> None:
    band, exact = BandSdf(BALL.faces, band=width), ExactSdf(BALL.faces)
    for sdf in (band, exact):
        sdf.update(torch.tensor(BALL.vertices, dtype=torch.float32))
    points = shell(radius, (x, y, 0.1))
    got, wanted = band.clipped(points, SHELL_RING), exact.query(points)
    torch.testing.assert_close(got.distance, wanted.distance.clamp(max=width), atol=1e-6, rtol=0)
    assert (got.face[wanted.distance < width] >= 0).all()


def test_loose_pieces_are_judged_by_themselves() -> None:
    """A button in the body and one outside of it, beside a shell: no edge says anything of either."""
    band, exact = posed_ball()
    points = torch.cat((shell(0.302), torch.tensor([[0.0, 0, 0], [0.0, 0.9, 0]])))
    ring = Connectivity.of(SHELL.faces, len(points)).ring
    got = band.clipped(points, ring).distance
    torch.testing.assert_close(got, exact.query(points).distance.clamp(max=BAND), atol=1e-6, rtol=0)


@pytest.mark.parametrize("reach", [0.15, 0.2])
def test_what_a_limb_shuts_in_beside_the_skin_of_another_is_asked(reach: float) -> None:
    """A sheet of cloth off the skin of a thin limb, where that is buried in a thick one.

    Near the buried skin the pseudo-normal says "outside", farther off "inside", and no skin lies between.
    """
    thin = trimesh.creation.cylinder(radius=0.05, height=0.4, sections=48)
    body = trimesh.util.concatenate([BALL, thin.subdivide().subdivide()])
    band, exact = BandSdf(body.faces), ExactSdf(body.faces)
    for sdf in (band, exact):
        sdf.update(torch.tensor(body.vertices, dtype=torch.float32))
    # From 4 mm off the thin limb, within the band, to where the thick one's skin is the closer one.
    rows, columns = 25, 4
    across, along = np.meshgrid(np.linspace(0.054, 0.054 + reach, rows), 0.006 * np.arange(columns), indexing="ij")
    points = np.stack((across, along, 0 * along), -1).reshape(-1, 3)
    corners = [columns * i + j for i in range(rows - 1) for j in range(columns - 1)]
    sheet = trimesh.Trimesh(points, [(k, k + 1, k + columns) for k in corners])
    where = torch.tensor(points, dtype=torch.float32)
    wanted = exact.query(where).distance
    assert ((wanted > 0) & (wanted < BAND)).any()
    assert (wanted < -BAND).any()
    got = band.clipped(where, Connectivity.of(sheet.faces, len(points)).ring).distance
    torch.testing.assert_close(got, wanted.clamp(max=BAND), atol=1e-6, rtol=0)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 700), spread=st.sampled_from([0.2, 0.5, 5.0, 1e4]))
def test_query_is_the_exact_one(seed: int, n: int, spread: float) -> None:
    band, exact = posed_ball()
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed)) * spread
    got, wanted = band.query(points).distance, exact.query(points).distance
    torch.testing.assert_close(got, wanted, atol=1e-6, rtol=1e-6)


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 3000), spread=st.sampled_from([0.2, 0.5, 5.0, 1e4]))
def test_a_face_said_to_be_near_is_a_hint_only(seed: int, n: int, spread: float) -> None:
    """Any face, near or not: nothing closer is missed, by a tree built for whatever pose."""
    _, exact = posed_ball()
    body = torch.tensor(BALL.vertices, dtype=torch.float32)
    band = BandSdf(BALL.faces, rest=body * torch.tensor([0.2, 3.0, 1.0]))
    band.update(body)
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n, 3, generator=generator) * spread
    wanted = exact.query(points)
    for near in (torch.randint(len(BALL.faces), (n,), generator=generator), wanted.face):
        for sdf in (band, exact):
            got = sdf.query(points, near=near)
            torch.testing.assert_close(got.distance, wanted.distance, atol=1e-6, rtol=1e-6)


def test_places_that_share_a_cell() -> None:
    """Cells repeat after 128 of 16 mm along x and 64 along y and z; a ball there isn't a ball here."""
    band, exact = posed_ball()
    period = torch.tensor([128, 64, 64]) * 2 * BAND
    points = torch.cat([shell(0.303) + period * torch.tensor(k) for k in ([0, 0, 0], [1, 0, 0], [0, -1, 0], [1, 2, 3])])
    got, wanted = band.query(points).distance, exact.query(points).distance
    torch.testing.assert_close(got, wanted, atol=1e-6, rtol=1e-6)


def test_nothing_is_carried_over() -> None:
    """Garments of other sizes and bodies elsewhere, in turn, from one object and from fresh ones."""
    worn, _ = posed_ball()
    for k, radius in enumerate((0.31, 0.1, 0.295, 2.0, 0.31)):
        mesh = trimesh.creation.icosphere(subdivisions=2 + k % 4, radius=radius)
        points = torch.tensor(mesh.vertices, dtype=torch.float32)
        body = torch.tensor(BALL.vertices, dtype=torch.float32) + torch.tensor([0.3 * k, -0.1, 0])
        fresh = BandSdf(BALL.faces)
        for sdf in (worn, fresh):
            sdf.update(body)
        got, wanted = (sdf.clipped(points, ring_of(mesh)) for sdf in (worn, fresh))
        torch.testing.assert_close(got.distance, wanted.distance, atol=1e-7, rtol=0)
        torch.testing.assert_close(got.gradient, wanted.gradient, atol=1e-4, rtol=0)


def test_a_large_face_reaches_all_around_the_grid() -> None:
    block = trimesh.creation.box((6.0, 8.0, 5.0))
    sdf, exact = BandSdf(block.faces), ExactSdf(block.faces)
    for each in (sdf, exact):
        each.update(torch.tensor(block.vertices, dtype=torch.float32))
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([6.0, 8.0, 0.0])
    points += torch.tensor([-3.0, -4.0, 2.504])
    torch.testing.assert_close(sdf.query(points).distance, exact.query(points).distance, atol=1e-5, rtol=0)
    torch.testing.assert_close(sdf.query(points).distance, torch.full((500,), 0.004), atol=1e-5, rtol=0)


@settings(max_examples=60)
@given(n=st.integers(1, 5000), seed=st.integers(0, 2**31))
def test_groups_are_whole(n: int, seed: int) -> None:
    """Every place once; and eight, 64, ... in a row are nearer to each other than any are that are drawn at random."""
    places = np.random.default_rng(seed).random((n, 3), dtype=np.float32)
    order = grouped(places)
    assert sorted(order) == list(range(n))
    if n >= 512:
        eights = places[order[: n // 8 * 8]].reshape(-1, 8, 3)
        assert np.ptp(eights, axis=1).prod(axis=1).mean() < 40 / n


@pytest.mark.parametrize("n", [4, 8, 20, 80, 320, 1280])
def test_trees_of_all_depths(n: int) -> None:
    """From a root alone to four levels of nodes, whole ones and others; hints are anything."""
    mesh = trimesh.creation.icosphere(subdivisions={20: 0, 80: 1, 320: 2, 1280: 3}.get(n, 0), radius=0.3)
    if n == 4:
        mesh = trimesh.Trimesh(np.eye(4)[:, :3] - 0.25, [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    elif n == 8:
        mesh = trimesh.creation.uv_sphere(count=[3, 4])
    band, exact = BandSdf(mesh.faces), ExactSdf(mesh.faces)
    for sdf in (band, exact):
        sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32))
    generator = torch.Generator().manual_seed(n)
    points = torch.randn(2000, 3, generator=generator)
    near = torch.randint(len(mesh.faces), (2000,), generator=generator)
    wanted = exact.query(points).distance
    for got in (band.query(points, near=near), band.query(points[:150]), band.query(points)):
        torch.testing.assert_close(got.distance, wanted[: len(got.distance)], atol=1e-6, rtol=1e-6)


def test_a_face_without_area_hides_none() -> None:
    """Two corners of some faces run together: a hint that is such a face limits nothing, and none is the closest."""
    band, exact = posed_ball()
    points = torch.tensor(BALL.vertices, dtype=torch.float32)
    flat = torch.nonzero((torch.tensor(BALL.faces) == 7).any(1))[:, 0]
    points[torch.tensor(BALL.faces)[flat].unique()] = points[7].clone()
    for sdf in (band, exact):
        sdf.update(points)
    asked = points[7] * torch.linspace(0.8, 1.3, 50)[:, None]
    for face in flat:
        got = band.query(asked, near=torch.full((50,), int(face)))
        torch.testing.assert_close(got.distance, exact.query(asked).distance, atol=1e-6, rtol=1e-6)


def test_no_points() -> None:
    band, _ = posed_ball()
    ring = Adjacency(np.zeros(1, np.int32), np.zeros(0, np.int32))
    assert band.clipped(torch.zeros(0, 3), ring).distance.shape == (0,)


def test_bad_input() -> None:
    for width in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(MeshError, match="band must be positive"):
            BandSdf(BALL.faces, band=width)
    ring = SHELL_RING
    with pytest.raises(MeshError, match="no body yet"):
        BandSdf(BALL.faces).clipped(shell(1.0), ring)
    band, _ = posed_ball()
    with pytest.raises(MeshError, match="ring is of 10242 vertices, got 5"):
        band.clipped(torch.zeros(5, 3), ring)
    with pytest.raises(MeshError, match="finite"):
        band.clipped(torch.full((10242, 3), math.nan), ring)
