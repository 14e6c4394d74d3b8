"""Pushes that take their neighbourhood along, and what `resolve` makes of predicted scales and of hints."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_contact import resolve
from torch import Tensor

from refu_core.contact import Blend
from refu_core.errors import MeshError
from refu_core.modes import DEFAULT_MARGIN
from refu_core.refu import Refu
from refu_core.sdf import ExactSdf, SdfSample


def sheet(n: int) -> tuple[Tensor, Tensor]:
    """A square sheet of n × n vertices 1 cm apart in the plane y = 0, and its faces."""
    x, z = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    points = torch.stack((x, torch.zeros_like(x), z), dim=-1).view(-1, 3) * 0.01
    corner = (x * n + z)[:-1, :-1].reshape(-1, 1)
    return points, torch.cat((corner + torch.tensor([0, 1, n]), corner + torch.tensor([1, n + 1, n])))


def neighbours_of(faces: Tensor, n: int) -> list[set[int]]:
    around: list[set[int]] = [set() for _ in range(n)]
    for face in faces.tolist():
        for vertex in face:
            around[vertex] |= set(face) - {vertex}
    return around


@given(
    seed=st.integers(0, 1000),
    steps=st.lists(st.sampled_from([1.0, 0.75, 3.0]), max_size=5),
    reach=st.integers(0, 3),
    is_owed=st.booleans(),
)
@settings(max_examples=30)
def test_spread_against_its_definition(seed: int, steps: list[float], reach: int, is_owed: bool) -> None:
    _, faces = sheet(6)
    generator = torch.Generator().manual_seed(seed)
    push = torch.randn(36, 1, 3, generator=generator) * (torch.rand(36, 1, 1, generator=generator) < 0.1)
    least = torch.rand(36, 1, generator=generator) * 2 if is_owed else None
    field = [row.clone() for row in push[:, 0]]
    around = neighbours_of(faces, 36)
    reached = {i for i in range(36) if field[i].norm() > 0}
    for _ in range(reach):
        reached |= {k for i in reached for k in around[i]}
    for step in steps:
        mean = [torch.stack([field[k] for k in around[i]]).mean(0) for i in range(36)]
        field = [field[i] + step * (mean[i] - field[i]) if i in reached else torch.zeros(3) for i in range(36)]
        for i, start in enumerate(push[:, 0]):
            if start.norm() > 0:
                direction = start / start.norm()
                wanted = float(start.norm()) if least is None else min(float(start.norm()), float(least[i, 0]))
                field[i] = field[i] + max(0.0, wanted - float(field[i] @ direction)) * direction
    spread = Blend.of_faces(faces, 36).spread(push, least=least, steps=steps, reach=reach)[:, 0]
    torch.testing.assert_close(spread, torch.stack(field), rtol=1e-4, atol=1e-6)


@given(seed=st.integers(0, 1000))
@settings(max_examples=15)
def test_no_vertex_goes_less_far_than_it_was_pushed(seed: int) -> None:
    _, faces = sheet(8)
    generator = torch.Generator().manual_seed(seed)
    push = torch.randn(64, 2, 3, generator=generator) * (torch.rand(64, 2, 1, generator=generator) < 0.3)
    spread = Blend.of_faces(faces, 64).spread(push)
    length = push.norm(dim=-1)
    along = (spread * push).sum(-1) / length.clamp_min(1e-9)
    assert (along >= length - 1e-5).all()


def test_a_garment_pushed_as_a_whole_moves_as_a_whole() -> None:
    _, faces = sheet(6)
    push = torch.tensor([0.0, 0.004, 0.001]).expand(36, 1, 3)
    torch.testing.assert_close(Blend.of_faces(faces, 36).spread(push), push.contiguous())


def test_the_neighbourhood_ends_and_garments_of_a_batch_do_not_mix() -> None:
    _, faces = sheet(21)
    push = torch.zeros(441, 2, 3)
    push[220, 0, 1] = 0.01  # the middle of the first garment
    for sweeps, reach in ((4, 9), (9, 4)):
        spread = Blend.of_faces(faces, 441).spread(push, steps=sweeps * (1.0,), reach=reach)
        assert not spread[:, 1].any()
        reached = (spread[:, 0, 1].view(21, 21) > 0).nonzero() - 10
        assert reached.abs().max() == 4


def test_gradcheck() -> None:
    _, faces = sheet(3)
    torch.manual_seed(0)
    push = torch.randn(9, 1, 3, dtype=torch.float64)
    push[3:6] = 0
    pushed = push[torch.tensor([0, 1, 2, 6, 7, 8])].clone().requires_grad_()
    blend = Blend.of_faces(faces, 9)

    def spread(pushed: Tensor) -> Tensor:
        return blend.spread(push.index_copy(0, torch.tensor([0, 1, 2, 6, 7, 8]), pushed), steps=(3.0, 0.75, 1.0))

    assert torch.autograd.gradcheck(spread, pushed)


def test_a_vertex_that_hardly_lacks_anything_has_a_bounded_derivative() -> None:
    """One batch in some thousands had one, and its derivative, 2 million times the others', undid the training."""
    flat, faces = sheet(9)
    points = (flat + torch.tensor([-0.04, 1.07, 0.13])).requires_grad_()  # rounding leaves x alone of the middle's push
    gradient = torch.tensor([-0.36, 0.48, 0.8]).repeat(1, 81, 1)
    gradient[0, 40, 0] *= -1  # the middle
    lack = torch.full((81,), 3e-3)
    lack[40] = 6e-9
    distance = DEFAULT_MARGIN - lack + ((points - points.detach()) * gradient[0]).sum(-1)
    sample = SdfSample(distance[None], gradient)
    pushed = Refu(81, least=1.0, scale=None)(points[None], sample)
    done = Blend.of_faces(faces, 81).follow(points[None], pushed, sample, DEFAULT_MARGIN)
    (slope,) = torch.autograd.grad(done.square().sum(), points)
    assert slope.norm(dim=1).max() < 10


def test_where_no_direction_is_known_neighbours_follow_up() -> None:
    points, faces = sheet(9)
    layer, blend = Refu(81, least=1.0, scale=None), Blend.of_faces(faces, 81)
    distance = torch.full((1, 81), DEFAULT_MARGIN)
    distance[0, 40] = -0.001
    up, none = (SdfSample(distance, torch.tensor([0.0, y, 0.0]).expand(1, 81, 3)) for y in (1.0, 0.0))
    wanted, done = (blend.follow(points[None], layer(points[None], one), one, DEFAULT_MARGIN) for one in (up, none))
    assert (wanted != points).any(dim=-1).sum() > 8
    assert torch.equal(done, wanted)


def test_refuses_faces_of_other_vertices() -> None:
    _, faces = sheet(3)
    with pytest.raises(MeshError, match="index vertices 0 to 7"):
        Blend.of_faces(faces, 8)


def share(distance: Tensor) -> Tensor:
    """How much of what lacks to the default margin a push takes, so that cloth keeps its order."""
    deficit = DEFAULT_MARGIN - distance
    return 1 - DEFAULT_MARGIN / 2 * -torch.expm1(-2 * deficit / DEFAULT_MARGIN) / deficit


class Floor:
    """The half-space y < 0 is the body; keeps what it was asked."""

    def __init__(self) -> None:
        self.asked: list[int] = []
        self.near: list[Tensor | None] = []

    def update(self, vertices: Tensor, *, pose: Tensor | None = None, betas: Tensor | None = None) -> None:
        raise NotImplementedError

    def query(self, points: Tensor, *, near: Tensor | None = None) -> SdfSample:
        self.asked.append(len(points))
        self.near.append(near)
        up = torch.tensor([0.0, 1.0, 0.0]).expand_as(points)
        return SdfSample(points[:, 1].clone(), up, torch.full((len(points),), 7, dtype=torch.int32))


@pytest.fixture
def dented() -> tuple[Tensor, Tensor]:
    """A folded sheet 2 cm above the floor with a bump that sinks 1 cm into it."""
    points, faces = sheet(31)
    radius = (points - points[480]).norm(dim=1)
    folds = 0.002 * torch.sin(points[:, 0] * 200)
    points[:, 1] = 0.02 + folds - 0.03 * torch.exp(-((radius / 0.05) ** 2))
    return points, faces


def test_blended_cloth_is_outside_and_keeps_its_shape_better(dented: tuple[Tensor, Tensor]) -> None:
    points, faces = dented
    blend = Blend.of_faces(faces, len(points))
    plain, blended = (resolve(points, Floor(), blend=b).vertices for b in (None, blend))
    assert blended[:, 1].min() >= 0.5 * DEFAULT_MARGIN - 1e-6

    def laplacian_error(vertices: Tensor) -> float:
        displacement = vertices - points
        return float((displacement - blend.mean(displacement)).norm(dim=1)[points[:, 1] < 0].mean())

    assert laplacian_error(blended) < 0.7 * laplacian_error(plain)
    far = (points - points[480]).norm(dim=1) > 0.14
    assert torch.equal(blended[far], points[far])


def test_what_stays_beyond_the_margin_is_not_asked_again(dented: tuple[Tensor, Tensor]) -> None:
    points, faces = dented
    floor = Floor()
    done = resolve(points, floor, blend=Blend.of_faces(faces, len(points)))
    moved = int((done.vertices != points).any(dim=1).sum())
    assert len(points) > moved > floor.asked[1] >= done.n_pushed > 0
    assert (done.distance <= floor.query(done.vertices).distance + 1e-6).all()  # a lower bound, or itself


def test_blended_on_a_sphere(dented: tuple[Tensor, Tensor]) -> None:
    points, faces = dented
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    sdf = ExactSdf(mesh.faces)
    sdf.update(torch.tensor(mesh.vertices, dtype=torch.float32) + points[480] - torch.tensor([0.0, 0.095, 0.0]))
    done = resolve(points, sdf, blend=Blend.of_faces(faces, len(points)))
    assert done.n_inside >= 5
    assert sdf.query(done.vertices).distance.min() >= 0.5 * DEFAULT_MARGIN - 1e-5


def test_known_distances_are_not_asked_for(dented: tuple[Tensor, Tensor]) -> None:
    points, faces = dented
    wanted = resolve(points, Floor(), blend=Blend.of_faces(faces, len(points)))
    floor = Floor()
    known = floor.query(points)
    clipped = known._replace(distance=known.distance.clamp_max(0.008))
    floor.asked.clear()
    done = resolve(points, floor, start=clipped, blend=Blend.of_faces(faces, len(points)))
    assert torch.equal(done.vertices, wanted.vertices)
    assert max(floor.asked) < len(points)


@pytest.mark.parametrize("is_blended", [False, True])
def test_predicted_scale_of_the_first_push(dented: tuple[Tensor, Tensor], is_blended: bool) -> None:
    points, faces = dented
    asked: list[Tensor] = []

    def scale(rows: Tensor, distance: Tensor) -> Tensor:
        torch.testing.assert_close(distance, points[rows, 1])
        asked.append(rows)
        return torch.full_like(distance, 1.5)

    blend = Blend.of_faces(faces, len(points)) if is_blended else None
    done = resolve(points, Floor(), scale=scale, blend=blend)
    (rows,) = asked
    assert torch.equal(rows, torch.nonzero(points[:, 1] < 0.004)[:, 0])
    wanted = points[rows, 1] + 1.5 * share(points[rows, 1]) * (DEFAULT_MARGIN - points[rows, 1])
    if is_blended:
        # It is where the field begins: that ends no lower than it was sent, up to the margin, and higher than from a
        # scale of 1.
        height = resolve(points, Floor(), blend=blend).vertices[:, 1]
        assert (done.vertices[rows, 1] >= wanted.clamp_max(DEFAULT_MARGIN) - 1e-6).all()
        assert done.vertices[rows, 1].mean() > height[rows].mean() + 5e-5
    else:
        torch.testing.assert_close(done.vertices[rows, 1], wanted)
    fixed = resolve(points, Floor(), scale=torch.full((len(points),), 1.5), blend=blend)
    torch.testing.assert_close(fixed.vertices, done.vertices)


def test_a_scale_below_one_is_believed_but_not_into_the_body() -> None:
    points = torch.tensor([[0.0, 0.002, 0.0], [0.0, -0.01, 0.0]])
    done = resolve(points, Floor(), scale=0.5)
    torch.testing.assert_close(done.vertices[0, 1], 0.002 + 0.5 * share(torch.tensor(0.002)) * 0.002)
    assert 0 <= float(done.vertices[1, 1]) < 0.004
    assert done.n_unresolved == 0


def test_hints_follow_the_vertices(dented: tuple[Tensor, Tensor]) -> None:
    points, faces = dented
    floor = Floor()
    first = torch.arange(len(points), dtype=torch.int32)
    resolve(points, floor, near=first, blend=Blend.of_faces(faces, len(points)))
    assert floor.near[0] is first
    assert all(near is not None and len(near) == n for near, n in zip(floor.near, floor.asked, strict=True))
    assert all(bool((near == 7).all()) for near in floor.near[1:] if near is not None)


def test_the_layer_blends_batches_as_resolve_does(dented: tuple[Tensor, Tensor]) -> None:
    points, faces = dented
    blend = Blend.of_faces(faces, len(points))
    lifted = points + torch.tensor([0.0, 0.003, 0.0])
    both = torch.stack((points, lifted))
    samples = [Floor().query(garment) for garment in both]
    sample = SdfSample(torch.stack([s.distance for s in samples]), torch.stack([s.gradient for s in samples]))
    layer = Refu(len(points), least=1.0, scale=None)
    pushed = blend.follow(both, layer(both, sample), sample, layer.margin)
    for garment, done in zip(both, pushed, strict=True):
        # The layer takes all vertices to the margin.
        whole = resolve(garment, Floor(), blend=blend, scale=lambda _rows, distance: 1 / share(distance))
        torch.testing.assert_close(done, whole.vertices)
    assert np.isfinite(pushed.numpy()).all()
