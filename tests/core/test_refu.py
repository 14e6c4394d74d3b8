"""The ReFU layer with its learned scale: against the paper's equations written out, its derivatives, its sizes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from refu_core.body import rotvec_to_rotmat
from refu_core.errors import MeshError, WeightsError
from refu_core.refu import PAPER, REALTIME, Refu, ScaleNet, ScaleSettings
from refu_core.refu._scale import scale_inputs
from refu_core.sdf import ExactSdf, SdfSample

N = 40
SMALL = {
    "compact": ScaleSettings(feature_size=6, hidden_size=9, latent_size=4),
    "dense": ScaleSettings(feature_size=6, hidden_size=9, latent_size=4, is_compact=False),
    "shared": ScaleSettings("shared", feature_size=6, hidden_size=9, latent_size=4, is_compact=False),
    "distance": ScaleSettings("distance", latent_size=4),
}


def random_bodies(batch: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return (
        torch.randn(batch, 10, generator=generator),
        0.5 * torch.randn(batch, 24, 3, generator=generator),
        torch.randn(batch, 4, generator=generator),
    )


def random_net(kind: str, *, least: float = 0.0, n: int = N, seed: int = 0) -> ScaleNet:
    """One whose last layer isn't zero any more."""
    torch.manual_seed(seed)
    net = ScaleNet(n, least=least, settings=SMALL[kind])
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return net


def scale_written_out(net: ScaleNet, z: Tensor, vertex: int, distance: float) -> Tensor:
    """α = g(k(z)_i, f), one vertex of one body, for each kind by its definition."""
    weights = dict(net.named_parameters())
    f = torch.tensor([100 * distance])
    if net.settings.kind == "distance":
        inputs = f
    elif net.settings.kind == "shared":
        inputs = torch.cat((weights["k.weight"] @ z + weights["k.bias"], f))
    elif net.settings.is_compact:
        projected = weights["k.projection.weight"] @ z + weights["k.projection.bias"]
        inputs = torch.cat((weights["k.embedding"][vertex] * projected, f))
    else:
        latent = weights["k.weight"][vertex] @ z + weights["k.bias"][vertex]
        inputs = torch.cat((latent.clamp_min(0), f))
    hidden = (weights["g.0.weight"] @ inputs + weights["g.0.bias"]).clamp_min(0)
    raw = weights["g.2.weight"] @ hidden + weights["g.2.bias"] + 1 - net.least
    return net.least + torch.log1p(torch.exp(20 * raw.double()))[0].float() / 20


@pytest.mark.parametrize("kind", SMALL)
@pytest.mark.parametrize("least", [0.0, 1.0])
def test_gathered_scale_is_the_dense_one(kind: str, least: float) -> None:
    net = random_net(kind, least=least)
    betas, pose, style = random_bodies(3)
    z = net.feature(betas, pose, style)
    body, vertex = torch.tensor([0, 2, 2, 1, 0]), torch.tensor([7, 7, 0, N - 1, 31])
    distance = torch.tensor([-0.01, 0.002, -0.03, 0.0, 0.003])
    some = net(z, body, vertex, distance)
    wanted = torch.stack(
        [scale_written_out(net, z[int(b)], int(v), float(f)) for b, v, f in zip(body, vertex, distance, strict=True)]
    )
    torch.testing.assert_close(some, wanted, rtol=1e-4, atol=1e-5)
    assert (some >= least).all()
    everyone = torch.arange(3 * N)
    dense = net(z, everyone // N, everyone % N, torch.full((3 * N,), 0.001)).view(3, N)
    torch.testing.assert_close(net(z, body, vertex, torch.full((5,), 0.001)), dense[body, vertex])
    torch.testing.assert_close(net.of_body(z[1])(torch.arange(N), torch.full((N,), 0.001)), dense[1])


@pytest.mark.parametrize("kind", ["compact", "dense", "shared"])
def test_cost_grows_with_the_pushed_vertices_alone(kind: str) -> None:
    def flops(n_pushed: int, n: int) -> int:
        net = random_net(kind, n=n)
        z = torch.randn(1, 6)
        rows = torch.arange(n_pushed)
        with FlopCounterMode(display=False) as counter:
            net(z, torch.zeros_like(rows), rows, torch.zeros(n_pushed))
        return counter.get_total_flops()

    assert flops(20, N) == flops(20, 10 * N) or kind == "shared"  # its D' goes with N
    once = flops(20, N) - flops(10, N)
    assert once > 0
    assert flops(40, N) - flops(20, N) == 2 * once


def test_layers_without_training_are_the_fixed_scale() -> None:
    for settings_ in (*SMALL.values(), REALTIME):
        for least in (0.0, 1.0):
            net = ScaleNet(N, least=least, settings=settings_)
            z = net.feature(*random_bodies(1))
            alpha = net(z, torch.zeros(N, dtype=torch.int64), torch.arange(N), torch.linspace(-0.02, 0.004, N))
            torch.testing.assert_close(alpha, torch.ones(N), rtol=0, atol=0.04)


def test_presets_have_the_sizes_they_say() -> None:
    paper = dict(ScaleNet(5, least=1.0, settings=PAPER).named_parameters())
    shapes = {name: tuple(parameter.shape) for name, parameter in paper.items() if name.endswith("weight")}
    assert shapes == {
        "h.0.weight": (1024, 86),
        "h.2.weight": (1024, 1024),
        "h.4.weight": (1024, 1024),
        "k.weight": (5, 10, 1024),
        "g.0.weight": (10, 11),
        "g.2.weight": (1, 10),
    }
    tshirt = ScaleNet(7662, least=0.0)
    assert 2 * sum(parameter.numel() for parameter in tshirt.parameters()) < 0.3e6  # bytes in fp16


@pytest.mark.parametrize("is_compact", [True, False])
def test_the_shared_latent_has_as_many_weights(is_compact: bool) -> None:
    def size(kind: Any) -> int:
        net = ScaleNet(300, least=0.0, settings=ScaleSettings(kind, 32, 32, 10, is_compact))
        return sum(parameter.numel() for parameter in net.parameters())

    assert size("shared") == pytest.approx(size("vertex"), rel=0.01)


@given(seed=st.integers(0, 1000), turn=st.floats(-3, 3))
@settings(max_examples=20)
def test_features_do_not_depend_on_heading_nor_on_full_turns(seed: int, turn: float) -> None:
    betas, pose, style = random_bodies(2, seed)
    inputs = scale_inputs(betas, pose, style)
    heading = trimesh.transformations.rotation_matrix(turn, (0, 1, 0))[:3, :3]
    turned = pose.clone()
    for row in turned:
        matrix = heading @ rotvec_to_rotmat(row[0].double()).numpy()
        angle, axis, _ = trimesh.transformations.rotation_from_matrix(_homogeneous(matrix))
        row[0] = torch.tensor(angle * axis)
    torch.testing.assert_close(scale_inputs(betas, turned, style), inputs, atol=1e-4, rtol=0)
    angle = pose.norm(dim=-1, keepdim=True)
    full_turn = pose * (1 + 2 * math.pi / angle)
    torch.testing.assert_close(scale_inputs(betas, full_turn, style), inputs, atol=1e-4, rtol=0)
    tracked = scale_inputs(betas, full_turn.requires_grad_(), style).detach()
    torch.testing.assert_close(tracked, inputs, atol=1e-4, rtol=0)


def _homogeneous(rotation: Any) -> Any:
    matrix = trimesh.transformations.identity_matrix()
    matrix[:3, :3] = rotation
    return matrix


def test_one_style_is_everybodys_also_where_derivatives_are_wanted() -> None:
    betas, pose, style = random_bodies(2)
    tracked = scale_inputs(betas, pose.clone().requires_grad_(), style[:1])
    torch.testing.assert_close(tracked, scale_inputs(betas, pose, style[[0, 0]]))


def test_the_mean_style_is_zero() -> None:
    betas, pose, style = random_bodies(2)
    assert torch.equal(scale_inputs(betas, pose, None), scale_inputs(betas, pose, torch.zeros_like(style)))


def random_layer(kind: str | None = "compact", **options: Any) -> tuple[Refu, Tensor, SdfSample, Tensor | None]:
    """A layer in float64 and inputs of two bodies, some vertices inside, some within the margin."""
    generator = torch.Generator().manual_seed(1)
    torch.manual_seed(1)
    refu = Refu(8, least=options.pop("least", 0.0), scale=None if kind is None else SMALL[kind], **options).double()
    for parameter in () if refu.scale is None else refu.scale.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    points, gradient = torch.randn(2, 2, 8, 3, generator=generator, dtype=torch.float64)
    distance = torch.linspace(-0.0203, 0.0101, 16, dtype=torch.float64).view(2, 8)
    z = refu.feature(*(tensor.double() for tensor in random_bodies(2)))
    return refu, points, SdfSample(distance, gradient), None if z is None else z.detach()


@pytest.mark.parametrize("kind", [*SMALL, None])
def test_layer_is_the_papers_equation(kind: str | None) -> None:
    refu, points, sample, z = random_layer(kind)
    pushed = refu(points, sample, z)
    for b in range(2):
        for i in range(8):
            f, gradient = float(sample.distance[b, i]), sample.gradient[b, i]
            alpha = 1.0
            if refu.scale is not None and z is not None:
                alpha = refu.scale(z, torch.tensor([b]), torch.tensor([i]), torch.tensor([f]).double())
            wanted = points[b, i] - alpha * (f - 0.004) * gradient / gradient.norm() if f < 0.004 else points[b, i]
            torch.testing.assert_close(pushed[b, i], wanted)


@pytest.mark.parametrize("kind", SMALL)
def test_gradcheck_of_inputs_and_weights(kind: str) -> None:
    refu, points, sample, z = random_layer(kind, least=1.0)
    assert z is not None
    names = [name for name, _ in refu.named_parameters() if not name.startswith("scale.h")]
    weights = [dict(refu.named_parameters())[name].detach().clone().requires_grad_() for name in names]
    inputs = [tensor.detach().clone().requires_grad_() for tensor in (points, sample.distance, sample.gradient, z)]

    def layer(points: Tensor, distance: Tensor, gradient: Tensor, z: Tensor, *weights: Tensor) -> Tensor:
        arguments = (points, SdfSample(distance, gradient), z)
        out: Tensor = torch.func.functional_call(refu, dict(zip(names, weights, strict=True)), arguments)
        return out

    assert torch.autograd.gradcheck(layer, [*inputs, *weights])


def test_derivatives_at_the_margin_are_those_of_the_outer_branch() -> None:
    """f = ε exactly: continuous, and both one-sided derivatives are those of the two branches."""
    refu, points, sample, z = random_layer()
    margin = 0.004

    def pushed(distance: Tensor) -> Tensor:
        out: Tensor = refu(points, SdfSample(distance, sample.gradient), z)
        return out

    at = torch.full((2, 8), margin, dtype=torch.float64, requires_grad=True)
    assert torch.equal(pushed(at), points)
    (outer,) = torch.autograd.grad(pushed(at).sum() + 0 * at.sum(), at)
    h = 1e-7
    numeric_outer = (pushed(at + h) - pushed(at)).sum(-1) / h
    torch.testing.assert_close(outer, numeric_outer.detach())
    below = (at.detach() - 1e-12).requires_grad_()
    (inner,) = torch.autograd.grad(pushed(below).sum(), below)
    numeric_inner = (pushed(at) - pushed(at - h)).sum(-1) / h
    torch.testing.assert_close(inner, numeric_inner.detach(), rtol=1e-4, atol=1e-6)
    assert (pushed(at - h) - pushed(at)).abs().max() < 1e-5


def test_gradcheck_through_the_body() -> None:
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    sdf = ExactSdf(mesh.faces)
    body = torch.tensor(mesh.vertices).requires_grad_()
    direction = torch.nn.functional.normalize(
        torch.tensor([[0.3, 0.2, 0.9], [-0.5, 0.7, 0.1], [0.2, -0.9, 0.3]]), dim=1
    )
    points = (direction.double() * torch.tensor([[0.08], [0.085], [0.12]])).requires_grad_()
    refu = Refu(3, least=1.0, scale=SMALL["distance"]).double()
    torch.nn.init.normal_(next(p for n, p in refu.named_parameters() if n == "scale.g.2.weight"), std=0.3)

    def layer(points: Tensor, body: Tensor) -> Tensor:
        sdf.update(body)
        sample = sdf.query(points)
        z = torch.zeros(1, 0, dtype=torch.float64)
        out: Tensor = refu(points[None], SdfSample(sample.distance[None], sample.gradient[None]), z)
        return out

    assert torch.autograd.gradcheck(layer, (points, body))


@given(magnitude=st.sampled_from([0.0, 1e-30, 1.0, 1e6, 1e30, 3e38]), seed=st.integers(0, 100))
@settings(max_examples=30)
def test_finite_in_finite_out(magnitude: float, seed: int) -> None:
    torch.manual_seed(seed)
    refu = Refu(N, least=0.0)
    for parameter in refu.parameters():
        torch.nn.init.normal_(parameter)
    betas, pose, style = (tensor * magnitude for tensor in random_bodies(1, seed))
    z = refu.feature(betas, pose, style)
    sample = SdfSample(torch.randn(1, N) * magnitude, torch.randn(1, N, 3).clamp(-1, 1) * magnitude)
    points = torch.randn(1, N, 3)
    moved = refu(points, sample, z) - points
    assert torch.isfinite(moved).all()
    assert moved.norm(dim=-1).max() <= 0.1 + 1e-6


def test_config_makes_the_same_layer() -> None:
    for refu in (Refu(N, least=1.0), Refu(N, least=0.0, scale=None, margin=0.002)):
        again = Refu.from_config(refu.config)
        again.load_state_dict(refu.state_dict())
        assert again.config == refu.config
        assert again.margin == refu.margin
    with pytest.raises(WeightsError, match="description of a ReFU layer"):
        Refu.from_config({"n_vertices": 3})
    with pytest.raises(WeightsError, match="description of a ReFU layer"):
        Refu.from_config({**Refu(3, least=0.0).config, "scale": {"colour": "blue"}})


def test_refuses_what_does_not_belong_together() -> None:
    refu, points, sample, z = random_layer()
    with pytest.raises(MeshError, match=r"\(B, 8, 3\)"):
        refu(points[:, :5], sample, z)
    with pytest.raises(MeshError, match="features z of 2 bodies"):
        refu(points, sample, None)
    with pytest.raises(MeshError, match="margin"):
        Refu(8, least=0.0, margin=-0.001)
