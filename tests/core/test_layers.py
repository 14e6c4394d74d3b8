"""Garments worn over each other: one push by hand, the search against all triangles, and the built-in garments."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import igl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from refu_core import GarmentPipeline, MeshError, SmplFrame
from refu_core.contact import DEFAULT_CONTACT, Blend, Layer
from refu_core.garments import inner_first, load_garment
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.simulation import posture

Array = NDArray[np.float64]
FADE, AGREEMENT, ROUNDS = 0.03, 0.25, DEFAULT_CONTACT.around
LAYER_GAP, LAYER_REACH = DEFAULT_CONTACT.gap, DEFAULT_CONTACT.layer_reach


def sheet(n: int, *, step: float = 0.01, height: float = 0.0) -> tuple[Tensor, Tensor]:
    """A square sheet of n × n vertices in the plane y = height, facing up, and its faces."""
    x, z = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    points = torch.stack((x * step, torch.full_like(x, height, dtype=torch.float32), z * step), dim=-1).view(-1, 3)
    corner = (x * n + z)[:-1, :-1].reshape(-1, 1)
    return points.float(), torch.cat((corner + torch.tensor([0, 1, n]), corner + torch.tensor([1, n + 1, n])))


def normals(points: Array, faces: NDArray[np.int64]) -> Array:
    a, b, c = points[faces].transpose(1, 0, 2)
    total = np.zeros_like(points)
    for k in range(3):
        np.add.at(total, faces[:, k], np.cross(b - a, c - a))
    unit: Array = total / np.linalg.norm(total, axis=1, keepdims=True)
    return unit


def on_rim(faces: NDArray[np.int64]) -> set[tuple[int, int]]:
    """Edges of one face."""
    edges = Counter((min(f[k], f[k - 1]), max(f[k], f[k - 1])) for f in faces.tolist() for k in range(3))
    return {edge for edge, n_faces in edges.items() if n_faces == 1}


def wanted_pushes(above: Array, above_faces: NDArray[np.int64], below: Array, below_faces: NDArray[np.int64]) -> Array:
    """The push of each vertex by the closest of all triangles, one vertex at a time."""
    rim = on_rim(below_faces)
    rim_vertices = {v for edge in rim for v in edge}
    own, sheets = normals(above, above_faces), normals(below, below_faces)
    _, face, closest = igl.point_mesh_squared_distance(above, below, below_faces)[:3]
    pushes = np.zeros_like(above)
    for i, p in enumerate(above):
        corners = below_faces[face[i]]
        weight = np.linalg.lstsq(np.vstack((below[corners].T, np.ones(3))), np.append(closest[i], 1), rcond=None)[0]
        normal = weight @ sheets[corners]
        normal /= np.linalg.norm(normal)
        offset = p - closest[i]
        height = offset @ normal
        if height >= LAYER_GAP or np.linalg.norm(offset) > LAYER_REACH:
            continue
        share = np.clip(own[i] @ normal / AGREEMENT, 0, 1) * min(1, 4 - 4 * np.linalg.norm(offset) / LAYER_REACH)
        at = tuple(sorted(int(corners[k]) for k in range(3) if weight[k] > 1e-6))
        if at in rim or (len(at) == 1 and at[0] in rim_vertices):
            share *= max(0, 1 - np.linalg.norm(offset - height * normal) / FADE)
        pushes[i] = share * (LAYER_GAP - height) * normal
    return pushes


def wavy(points: Tensor, seed: int, *, amplitude: float) -> Tensor:
    """Smooth waves across a sheet, and a little along it, less than two centimetres long nowhere."""
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros_like(points)
    for _ in range(4):
        direction = torch.randn(3, generator=generator)
        phase = points @ direction / direction.norm() * 60 + 6 * torch.rand(1, generator=generator)
        total += amplitude / 4 * torch.sin(phase)[:, None] * torch.tensor([0.2, 1.0, 0.2])
    return points + total


@given(seed=st.integers(0, 1000), height=st.floats(-0.015, 0.01), shift=st.floats(-0.06, 0.06))
@settings(max_examples=12)
def test_equals_the_search_over_all_triangles(seed: int, height: float, shift: float) -> None:
    below, below_faces = sheet(11, step=0.013)
    above, above_faces = sheet(13)
    layer = Layer(above_faces, above, below_faces, below)
    low = wavy(below, seed, amplitude=0.004)
    high = wavy(above, seed + 1, amplitude=0.004) + torch.tensor([shift, height, 0.3 * shift])
    found, n_low = layer(high, low)
    push = wanted_pushes(high.double().numpy(), above_faces.numpy(), low.double().numpy(), below_faces.numpy())
    blend = Blend.of_faces(above_faces, len(above))
    field = blend.spread(torch.from_numpy(push).float()[:, None], steps=ROUNDS * (1.0,), reach=ROUNDS)
    assert abs(n_low - int((push != 0).any(axis=1).sum())) <= 1  # but for rounding
    np.testing.assert_allclose(found.numpy(), (high + field[:, 0]).numpy(), atol=2e-5)


def test_cloth_beyond_a_rim_is_felt_less_and_less() -> None:
    below, below_faces = sheet(11)  # to x = 0.1
    above, above_faces = sheet(16)  # to x = 0.15
    alone = torch.tensor([[0, 1, 2]])
    moved = []
    for x in (0.05, 0.104, 0.11, 0.118, 0.135):
        triangle = torch.tensor([[x, -0.01, 0.05], [x + 1e-4, -0.01, 0.05], [x, -0.01, 0.0501]])
        upward = triangle[[0, 2, 1]] if normals(triangle.double().numpy(), alone.numpy())[0, 1] < 0 else triangle
        found, _ = Layer(alone, upward, below_faces, below)(upward, below)
        moved.append(float((found - upward)[:, 1].max()))
    assert moved[0] == pytest.approx(0.01 + LAYER_GAP, abs=1e-5)
    assert all(a > b for a, b in pairwise(moved))
    assert moved[-1] == 0
    layer = Layer(above_faces, above, below_faces, below)
    once, _ = layer(above - torch.tensor([0.0, 0.006, 0.0]), below)
    smooth, _ = layer(once, below, goes_on=True)  # as in a frame
    step = smooth[:, 1].view(16, 16).diff(dim=0).abs().max()
    assert step < 0.45 * (0.006 + LAYER_GAP), "over the rim in a curve and not in a step"


@pytest.mark.parametrize("is_flipped", [False, True])
def test_cloth_is_pushed_whichever_side_faces_the_sheet(is_flipped: bool) -> None:
    """A hem in the crease of a hip lies on the thigh with its outer side."""
    below, faces = sheet(8)
    above = below - torch.tensor([0.0, 0.005, 0.0])
    found, n_low = Layer(faces.flip(1) if is_flipped else faces, above, faces, below)(above, below)
    assert n_low == 64
    torch.testing.assert_close(found[:, 1], torch.full((64,), LAYER_GAP), atol=1e-6, rtol=0)


def test_cloth_that_stands_on_a_sheet_is_left_alone() -> None:
    below, faces = sheet(9)
    above = below[:, [0, 2, 1]] - below[:, 2].mean() * torch.tensor([0.0, 1.0, -1.0])
    found, n_low = Layer(faces, below, faces, below)(above, below)
    assert n_low == 0
    assert found is above


def test_what_does_not_meet_is_left_alone() -> None:
    below, faces = sheet(6)
    near = Layer(faces, below, faces, below)
    for height in (LAYER_GAP + 1e-4, 0.02, -LAYER_REACH - 0.001):
        moved = below + torch.tensor([0.0, height, 0.0])
        found, n_low = near(moved, below)
        assert n_low == 0
        assert found is moved


@pytest.mark.parametrize("faces_it", [False, True])
@pytest.mark.parametrize("height", [-0.004, 0.003])
def test_a_sleeve_that_comes_beside_is_a_stranger_and_brought_off(height: float, faces_it: bool) -> None:
    below, faces = sheet(12)
    sleeve, sleeve_faces = sheet(5)
    sleeve = sleeve + below.mean(0) - sleeve.mean(0)
    sleeve_faces = sleeve_faces.flip(1) if faces_it else sleeve_faces
    stranger = Layer(sleeve_faces, sleeve + torch.tensor([0.0, 0.5, 0.0]), faces, below)
    comes = sleeve + torch.tensor([0.0, height, 0.0])
    found, n_low = stranger(comes, below)
    assert n_low == len(sleeve)
    np.testing.assert_allclose((found - below.mean(0))[:, 1], LAYER_GAP, atol=1e-5)


@given(seed=st.integers(0, 1000), height=st.floats(-0.01, 0.004))
@settings(max_examples=12)
def test_going_on_is_as_looking_at_everyone_again(seed: int, height: float) -> None:
    below, below_faces = sheet(11, step=0.013)
    above, above_faces = sheet(13)
    low = wavy(below, seed, amplitude=0.004)
    high = wavy(above, seed + 1, amplitude=0.012) + torch.tensor([0.0, height, 0.0])
    layer, anew = (Layer(above_faces, above, below_faces, below) for _ in range(2))
    lifted, _ = layer(high, low)
    moved = lifted.clone()
    moved[:40, 1] -= 0.008
    found, n_low = layer(moved, low, goes_on=True)
    wanted, n_wanted = anew(moved, low)
    assert torch.equal(n_low, n_wanted)
    assert torch.equal(found, wanted)


@pytest.mark.parametrize("height", [-0.004, 0.002, 0.5])
def test_unasked_it_does_the_same(height: float) -> None:
    """As on a GPU, which isn't waited for to know whether anything is too low."""
    below, faces = sheet(12)
    above = below + torch.tensor([0.003, height, 0.002])
    layer = Layer(faces, below + torch.tensor([0.0, 0.01, 0.0]), faces, below)
    lifted, n_low = layer(above, below)
    assert (n_low > 0) == (height < LAYER_GAP)
    layer._is_serial = False
    unasked, number = layer(above, below)
    assert torch.equal(lifted, unasked)
    assert torch.equal(number, n_low)
    assert torch.equal(layer(above + 1.0, below)[0], above + 1.0)


def test_refuses_what_it_was_not_made_for() -> None:
    points, faces = sheet(4)
    with pytest.raises(MeshError, match="faces must index vertices 0 to 8, got 0 to 15"):
        Layer(faces, points[:9], faces, points)


def test_tops_are_worn_over_bottoms() -> None:
    def worn(*names: str) -> list[str]:
        return inner_first({name: load_garment(name) for name in names})

    assert worn("tshirt-male", "short-pant-male") == ["short-pant-male", "tshirt-male"]
    assert worn("shirt-male", "tshirt-male", "short-pant-male")[1:] == ["tshirt-male", "shirt-male"]
    # Of one layer the later named is the outer.
    assert worn("short-pant-male", "skirt-female") == ["short-pant-male", "skirt-female"]
    assert worn("skirt-female", "short-pant-male") == ["skirt-female", "short-pant-male"]


def standing(seed: int) -> SmplFrame:
    rng = np.random.default_rng(seed)
    return SmplFrame(
        pose=rng.normal(0, 0.12, (24, 3)).astype(np.float32), betas=rng.normal(0, 0.7, 10).astype(np.float32)
    )


@pytest.mark.parametrize(
    ("top", "backbone", "sdf"), [("tshirt-male", "tailornet", "hybrid"), ("shirt-male", "tailornet", "accurate")]
)
def test_worn_together(top: str, backbone: str, sdf: str) -> None:
    together = GarmentPipeline.load([top, "short-pant-male"], backbone=backbone, sdf=sdf)
    shorts = GarmentPipeline.load(["short-pant-male"], backbone=backbone, sdf=sdf)
    turned = GarmentPipeline.load(["short-pant-male", top], backbone=backbone, sdf=sdf)
    body = CollisionChecker(together.body.faces.numpy())
    faces = {name: load_garment(name).faces.numpy() for name in (top, "short-pant-male")}
    frames = [standing(seed) for seed in range(3)]
    batch = together(frames)
    for frame, out in zip(frames, batch, strict=True):
        assert list(out) == [top, "short-pant-male"]
        alone, swapped = shorts(frame), turned(frame)
        assert "layers" not in alone.stats.stage_ms
        np.testing.assert_allclose(out["short-pant-male"].local, alone["short-pant-male"].local, atol=1e-5)
        for name, mesh in swapped.items():
            np.testing.assert_allclose(mesh.local, out[name].local, atol=1e-4)
        assert out.stats.garments["short-pant-male"].n_layered == 0
        assert out.stats.garments[top].n_layered > 50
        low = [
            wanted_pushes(
                mesh.astype(np.float64),
                faces[top],
                out["short-pant-male"].local.astype(np.float64),
                faces["short-pant-male"],
            )
            for mesh in (out[top].raw, out[top].local)
        ]
        before, after = (np.linalg.norm(push, axis=1) for push in low)
        assert before.max() > 0.004
        assert after.max() < 0.002  # under the gap by so much, and above the sheet
        body.update(out.body)
        assert body.check(out[top].local, faces[top]).n_inside == 0


@pytest.mark.parametrize(
    ("inner", "outer", "is_tucked"),
    [
        ("tshirt-male", "shirt-male", True),
        ("tshirt-male", "longsleeve-male", True),
        ("short-pant-male", "tshirt-male", False),  # fits
        ("skirt-female", "tshirt-female", False),  # doesn't, but the T-shirt hangs over it
    ],
)
def test_what_is_too_wide_for_a_garment_above_is_tucked_under_it(inner: str, outer: str, *, is_tucked: bool) -> None:
    def n_cuts(*, tucks: bool) -> int:
        pipeline = GarmentPipeline.load([inner, outer])
        (step,) = pipeline._steps
        assert step.contact is not None
        assert bool(step.contact._tucks[inner]) == is_tucked
        if not tucks:
            step.contact._tucks[inner].clear()
        out = pipeline(SmplFrame(posture("hanging arms")))
        assert all(one.n_unresolved == 0 for one in out.stats.garments.values())
        checker = SheetChecker(out[inner].faces)
        checker.update(torch.tensor(out[inner].local))
        return len(checker.with_other(out[outer].local, out[outer].faces))

    assert n_cuts(tucks=True) == 0
    assert (n_cuts(tucks=False) > 20) == is_tucked
