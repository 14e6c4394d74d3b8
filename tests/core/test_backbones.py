"""Backbones: against slow references, what they may and may not depend on, and what loading refuses."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from refu_core import WeightsError, load_garment
from refu_core.backbones import (
    BasisDecoder,
    Controls,
    Gcnn,
    GcnnConfig,
    LaplacianSmoothing,
    Mlp,
    MlpConfig,
    PoseFeatures,
    TailorNet,
    TailorNetConfig,
    _frequency,
    backbone_config,
    backbone_from_weights,
    build_backbone,
    load_backbone,
    load_basis,
    save_backbone,
    save_basis,
    style_shape,
)
from refu_core.backbones._decoder import DenseDecoder
from refu_core.backbones._features import tilt_rotvec, told_up, up_in_root
from refu_core.backbones._gcnn import UpConv, sampled
from refu_core.backbones._perceptron import StackedPerceptrons
from refu_core.backbones._presets import TRAINABLE
from refu_core.backbones._tailornet import kernel_weights
from refu_core.body import rotvec_to_rotmat
from refu_core.errors import RefuError
from refu_core.garments import PAPER_GARMENTS, GarmentTemplate
from refu_core.modes import BackboneName
from refu_core.weights import load_weights

GARMENT = "short-pant-male"
RANK = 24
IDENTITY = {"garment": GARMENT, "body_fingerprint": "0123456789abcdef"}
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def garment() -> GarmentTemplate:
    return load_garment(GARMENT)


@pytest.fixture(scope="module")
def made_basis(garment: GarmentTemplate) -> BasisDecoder:
    generator = torch.Generator().manual_seed(1)
    columns = torch.linalg.qr(torch.randn(3 * garment.n_vertices, RANK, generator=generator)).Q
    return BasisDecoder(0.01 * torch.randn(garment.n_vertices, 3, generator=generator), columns.T)


@pytest.fixture
def basis(made_basis: BasisDecoder) -> BasisDecoder:
    return copy.deepcopy(made_basis)


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def bodies(n: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """β (n, 10), θ (n, 24, 3) and γ (n, 4)."""
    generator = torch.Generator().manual_seed(seed)
    return (
        torch.randn(n, 10, generator=generator),
        0.5 * torch.randn(n, 24, 3, generator=generator),
        torch.randn(n, 4, generator=generator),
    )


def tailornet(garment: GarmentTemplate, basis: BasisDecoder | None, **changes: object) -> TailorNet:
    config = TailorNetConfig(load_garment(GARMENT).card.joints, low=(32,), high=(16, 16), style_shape=(16,))
    net = build_backbone(replace(config, **changes), garment, basis=basis, pivots=0.3 * torch.randn(20, 14))  # type: ignore[arg-type]
    assert isinstance(net, TailorNet)
    return net.eval()


# TailorNet


@pytest.mark.parametrize("low_rank", [True, False])
def test_tailornet_is_the_sum_that_the_paper_writes(
    garment: GarmentTemplate, basis: BasisDecoder, low_rank: bool
) -> None:
    net = tailornet(garment, basis if low_rank else None, sigma=0.5)
    betas, pose, style = bodies(3)
    with torch.no_grad():
        got = net.train(False)(betas, pose, style)

        def decode(code: Tensor) -> Tensor:
            return net.decoder(code)[0] - (net.decoder.mean.view(-1, 3) if low_rank else 0)

        def drape(s: Tensor) -> Tensor:
            return garment.rest(s[None, :10], s[None, 10:])[0] + decode(net.style_shape(s[None]))

        assert got is not None
        for i in range(3):
            s = torch.cat((betas[i], style[i]))
            x = net.features(pose[i : i + 1])
            wanted = net.decoder(net.low(torch.cat((x, s[None]), 1)))[0]
            distances = torch.stack([1000 * (drape(s) - drape(p)).square().sum(1).mean() for p in net.pivots])
            mixture = torch.softmax(-distances.double() / 0.5, 0).float()
            for k in range(20):
                h = (x - net.high.shift) * net.high.scale
                for layer, (weight, bias) in enumerate(zip(net.high.weights, net.high.biases, strict=True)):
                    h = h @ weight[k] + bias[k]
                    h = torch.nn.functional.silu(h) if layer < 2 else h
                wanted = wanted + mixture[k] * decode(h)
            torch.testing.assert_close(got[i], wanted, atol=2e-4, rtol=1e-3)


def test_a_network_sees_nothing_beyond_its_training_set(garment: GarmentTemplate, basis: BasisDecoder) -> None:
    """Legs far apart and a body of no sample: what is predicted is what the nearest known numbers give."""
    net = tailornet(garment, basis).train(False)
    known = torch.randn(50, net.features.size + 14)
    net.low.standardise(known, net.features.groups)
    x = 100 * torch.randn(8, known.shape[1])
    torch.testing.assert_close(net.low(x), net.low(x.clamp(known.amin(0), known.amax(0))), rtol=0, atol=0)
    torch.testing.assert_close(net.low(known), net.low(known + 0.0), rtol=0, atol=0)
    assert net.low.seen(x).isfinite().all()


def test_far_styles_have_a_mixture_too(garment: GarmentTemplate, basis: BasisDecoder) -> None:
    net = tailornet(garment, basis)
    mixture = net.mixture(torch.full((1, 14), 8.0))
    assert torch.exp(-net.distances(torch.full((1, 14), 8.0)) / 0.01).sum() == 0  # the naive kernel is 0 / 0 here
    assert mixture.sum() == pytest.approx(1.0)


@given(seed=seeds, sigma=st.floats(1e-3, 10.0))
def test_kernel_weights_are_a_softmax(seed: int, sigma: float) -> None:
    distances = torch.as_tensor(np.random.default_rng(seed).uniform(0, 5, (4, 7)))
    wanted = torch.softmax(-distances / sigma, 1)
    torch.testing.assert_close(kernel_weights(distances, sigma), wanted, atol=1e-12, rtol=1e-9)


def test_a_person_wears_the_same_alone_and_in_a_crowd(garment: GarmentTemplate, basis: BasisDecoder) -> None:
    net = tailornet(garment, basis, sigma=0.5)
    betas, pose, style = bodies(6)
    with torch.no_grad():
        together = net(betas, pose, style)
        for i in range(6):
            alone = net(betas[i : i + 1], pose[i : i + 1], style[i : i + 1])
            torch.testing.assert_close(alone[0], together[i], atol=1e-6, rtol=0)


def test_of_pivots_far_away_the_nearest_ones_are_known(garment: GarmentTemplate, basis: BasisDecoder) -> None:
    net = tailornet(garment, basis, sigma=1.0)
    exact = copy.deepcopy(net).double()
    betas, pose, style = bodies(16)
    style = 50 * style
    with torch.no_grad():
        got = net(betas, pose, style)
        wanted = exact(betas.double(), pose.double(), style.double())
    torch.testing.assert_close(got, wanted.float(), atol=1e-6, rtol=0)


def test_what_depends_on_the_wearer_may_be_computed_once(garment: GarmentTemplate, basis: BasisDecoder) -> None:
    net = tailornet(garment, basis, sigma=0.5)
    betas, pose, style = bodies(2)
    with torch.no_grad():
        anew = net(betas, pose, style)
        assert torch.equal(net(betas, pose, style, wearer_code=net.wearer_code(betas, style)), anew)
        assert not torch.equal(net(betas, pose, style, wearer_code=net.wearer_code(-betas, style)), anew)


def test_a_batch_is_its_rows(garment: GarmentTemplate, basis: BasisDecoder) -> None:
    net = tailornet(garment, basis, sigma=0.5)
    betas, pose, style = bodies(4)
    with torch.no_grad():
        whole = net(betas, pose, style)
        rows = [net(betas[i : i + 1], pose[i : i + 1], style[i : i + 1])[0] for i in range(4)]
    torch.testing.assert_close(whole, torch.stack(rows), atol=1e-6, rtol=0)


@given(seed=seeds, size=st.sampled_from([0.3, 1.0, 3.0]))
def test_features_are_the_same_where_derivatives_are_wanted(seed: int, size: float) -> None:
    """Up lies on a grid, so rounding may take it to the next place there."""
    pose = size * torch.randn(5, 24, 3, generator=torch.Generator().manual_seed(seed))
    features = PoseFeatures((0, 3, 16, 17), "matrix")
    found = features(pose)
    assert found.shape == (5, features.size)
    wanted = features(pose.clone().requires_grad_()).detach()
    torch.testing.assert_close(found[:, :3], wanted[:, :3], atol=2.0**-13, rtol=0)
    torch.testing.assert_close(found[:, 3:], wanted[:, 3:], atol=2e-6, rtol=0)


def test_stacked_perceptrons_are_perceptrons() -> None:
    stack = StackedPerceptrons(3, 5, (4,), 6, activation="relu")
    x, mixture = torch.randn(7, 5), torch.rand(7, 3)
    wanted = torch.zeros(7, 6)
    for k in range(3):
        hidden = torch.relu(x @ stack.weights[0][k] + stack.biases[0][k])
        wanted += mixture[:, k : k + 1] * (hidden @ stack.weights[1][k] + stack.biases[1][k])
    torch.testing.assert_close(stack(x, mixture), wanted, atol=1e-5, rtol=1e-4)


def test_perceptrons_without_a_share_of_the_mixture_are_left_out() -> None:
    """Of one mixture for several calls; what is changed in it, or in the weights, is heeded."""
    stack, x = StackedPerceptrons(4, 5, (8, 8), 6, activation="silu").eval(), torch.randn(3, 5)
    mixture = torch.tensor([[0.7, 0.0, 0.3, 1e-6], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 1e-6]])
    for change in (lambda: None, lambda: mixture[0, 1].fill_(0.2), lambda: stack.weights[1].mul_(2.0)):
        with torch.no_grad():
            change()
            found = stack(x, mixture)
        torch.testing.assert_close(found, stack(x, mixture), atol=1e-5, rtol=0)
        assert len(stack._counting(mixture)[0][0]) == 4, "where derivatives are wanted"
    with torch.no_grad():
        stack.weights[0][1] = torch.nan
        assert not stack(x, mixture).isfinite().all()
        mixture[0, 1] = 0.0
        assert stack(x, mixture).isfinite().all(), "it wasn't computed"


def test_papers_preset_has_its_sizes_and_takes_a_step() -> None:
    garment = load_garment(GARMENT)
    config = backbone_config("tailornet", garment, preset="paper")
    net = build_backbone(config, garment, pivots=torch.randn(3, 14))  # 20 of them take 2 GB
    assert isinstance(net, TailorNet)
    outputs = 3 * garment.n_vertices
    assert [tuple(layer.weight.shape) for layer in net.low.layers] == [(1024, 86), (1024, 1024), (outputs, 1024)]
    assert [tuple(w.shape) for w in net.high.weights] == [(3, 72, 1024), (3, 1024, 1024), (3, 1024, outputs)]
    assert [tuple(layer.weight.shape) for layer in net.style_shape.layers] == [(128, 14), (128, 128), (outputs, 128)]
    net.train()
    displacement = net(*bodies(2))
    displacement.abs().mean().backward()
    trained = (*net.low.parameters(), *net.high.parameters())
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in trained)


# What a network sees


@pytest.mark.parametrize("encoding", ["matrix", "rotvec"])
def test_heading_changes_nothing_and_tilt_does(encoding: str) -> None:
    features = PoseFeatures(load_garment(GARMENT).card.joints, encoding)
    _, pose, _ = bodies(5)
    turned = pose.clone()
    heading = rotvec_to_rotmat(torch.tensor((0.0, 0.9, 0.0)))
    turned[:, 0] = _rotvec(heading @ rotvec_to_rotmat(pose[:, 0]))
    torch.testing.assert_close(features(turned), features(pose), atol=1e-5, rtol=0)
    turned[:, 0, 0] += 0.3
    assert bool(((features(turned) - features(pose)).abs().amax(1) > 0.05).all())


def test_a_tilt_that_networks_have_not_seen_is_told_as_one_that_they_may_have() -> None:
    angle = torch.linspace(0, torch.pi, 2001, dtype=torch.float64)
    for way in (0.0, 1.0, 4.0):
        level = torch.sin(angle)
        up = torch.stack((level * np.cos(way), torch.cos(angle), level * np.sin(way)), 1).requires_grad_()
        told = told_up(up)
        tilt = torch.rad2deg(torch.arccos(told[:, 1].detach().clamp(max=1.0)))
        assert torch.equal(told[angle < 1.04], up[angle < 1.04])
        assert float(tilt.max()) == pytest.approx(60)
        torch.testing.assert_close(told.norm(dim=1), torch.ones_like(angle))
        assert (told[1:] - told[:-1]).norm(dim=1).max() < 1.01 * torch.pi / 2000
        (gradient,) = torch.autograd.grad(told.sum(), up)
        assert torch.isfinite(gradient).all()


def test_tilt_is_the_root_without_its_heading() -> None:
    _, pose, _ = bodies(20)
    up = up_in_root(pose.double())  # in float32 it lies on a coarser grid
    tilt = rotvec_to_rotmat(tilt_rotvec(up))
    torch.testing.assert_close(tilt @ up[..., None], up.new_tensor((0.0, 1.0, 0.0))[None, :, None].expand(20, -1, -1))
    torch.testing.assert_close(up_in_root(tilt_rotvec(up)[:, None].expand(-1, 24, -1)), up, atol=1e-5, rtol=0)
    upright = tilt_rotvec(torch.tensor([[0.0, 1.0, 0.0]]))
    torch.testing.assert_close(upright, torch.zeros(1, 3))
    head_down = torch.tensor([[0.0, -1.0, 0.0]])
    torch.testing.assert_close(up_in_root(tilt_rotvec(head_down)[:, None].expand(-1, 24, -1)), head_down)


@pytest.mark.parametrize("encoding", ["matrix", "rotvec"])
@pytest.mark.parametrize("name", sorted(PAPER_GARMENTS))
def test_only_the_garments_joints_are_seen(name: str, encoding: str) -> None:
    features = PoseFeatures(load_garment(name).card.joints, encoding)
    _, pose, _ = bodies(1)
    before = features(pose)
    assert before.shape == (1, features.size)
    for joint in range(1, 24):
        moved = pose.clone()
        moved[:, joint] += 0.2
        assert bool(torch.equal(features(moved), before)) == (joint not in load_garment(name).card.joints)


def test_no_style_is_the_mean_style() -> None:
    betas, _, _ = bodies(2)
    assert torch.equal(style_shape(betas, None), style_shape(betas, torch.zeros(2, 4)))
    with pytest.raises(RefuError, match="no pose encoding 'euler'"):
        PoseFeatures((0, 1), "euler")


# Codes


def test_codes_of_a_basis_measure_vertices(garment: GarmentTemplate, basis: BasisDecoder) -> None:
    a, b = torch.randn(2, RANK), torch.randn(2, RANK)
    torch.testing.assert_close(basis.encode(basis(a)), a, atol=2e-3, rtol=0)
    in_vertices = (basis(a) - basis(b)).square().sum((1, 2))
    torch.testing.assert_close((a - b).square().sum(1), in_vertices, rtol=2e-3, atol=0)
    dense = DenseDecoder(garment.n_vertices)
    displacement = torch.randn(2, garment.n_vertices, 3)
    assert torch.equal(dense(dense.encode(displacement)), displacement)
    s = torch.randn(3, 14)
    rest = garment.rest(s[:, :10], s[:, 10:]) - garment.v_template
    for decoder in (basis, dense):
        norms = (s @ decoder.directions(garment)).square().sum(1)
        torch.testing.assert_close(norms, rest.square().sum((1, 2)), rtol=1e-2, atol=0)


def test_loading_a_network_asks_its_basis_for_directions_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """They were computed for the network without memory, too, that a card's sizes are tried out with."""
    asked, directions = [], BasisDecoder.directions
    monkeypatch.setattr(BasisDecoder, "directions", lambda *given: asked.append(1) or directions(*given))
    load_backbone("tailornet", "skirt-female")
    assert len(asked) == 1


@pytest.mark.parametrize("rank", [9, 40])  # of which the first 32 are stored in half precision
@pytest.mark.parametrize("n", [1, 2, 4, 7, 16, 17])
@pytest.mark.parametrize("n_vertices", [1, 16, 107])
def test_codes_are_decoded_as_a_product_of_matrices(n: int, n_vertices: int, rank: int) -> None:
    decoder = BasisDecoder(torch.randn(n_vertices, 3), torch.randn(rank, 3 * n_vertices))
    code = torch.randn(n, rank, requires_grad=True)
    with torch.no_grad():
        decoded = decoder(code)
        product = torch.addmm(decoder.mean, code, decoder.components).view(n, -1, 3)
        torch.testing.assert_close(decoded, product, rtol=0, atol=5e-5)
        alone = torch.cat([decoder(row[None]) for row in code])
        torch.testing.assert_close(decoded, alone, rtol=0, atol=0 if n <= 16 else 5e-5)  # more are a product indeed
        decoder.components *= 2
        torch.testing.assert_close(
            decoder(code) - decoder.mean.view(-1, 3), 2 * (decoded - decoder.mean.view(-1, 3)), rtol=0, atol=1e-4
        )
    assert decoder(code).requires_grad


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0])
def test_a_basis_is_what_is_stored_of_it(scale: float) -> None:
    given = scale * torch.randn(40, 3 * 107)
    given[35] = 0  # as of a set of fewer samples than it has components
    decoder = BasisDecoder(torch.randn(107, 3), given)
    again = BasisDecoder.of_tensors(decoder.tensors())
    assert torch.equal(again.components, decoder.components)
    assert torch.equal(again.mean, decoder.mean)
    assert {name: str(tensor.dtype) for name, tensor in decoder.tensors().items()} == {
        "mean": "torch.float16",
        "components": "torch.float16",
        "fine": "torch.int8",
        "steps": "torch.bfloat16",
    }
    largest = given.abs().amax(1)
    if scale > 1e-5:  # below, half precision has no digits left
        assert (decoder.components - given).abs().amax(1)[:32].le(1e-3 * largest[:32]).all()
        assert (decoder.components - given).abs().amax(1).le(0.006 * largest).all()  # 1/254 of it, and rounding
    before = {"mean": decoder.mean.view(-1, 3), "components": decoder.components}  # a file of before there were bytes
    assert torch.equal(BasisDecoder.of_tensors(before).components, decoder.components)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mean": None}, "has no mean"),
        ({"components": None}, "has no components"),
        ({"fine": torch.zeros(3, 30, dtype=torch.int8)}, r"steps \(R - K\)"),
        ({"fine": torch.zeros(2, 30)}, "wanted a basis"),
        ({"fine": torch.zeros(2, 33, dtype=torch.int8)}, "wanted a basis"),
        ({"steps": torch.zeros(2, 1)}, "wanted a basis"),
        ({"components": torch.zeros(4)}, "wanted a basis"),
        ({"components": torch.zeros(4, 30, 1)}, "wanted a basis"),
        ({"mean": torch.zeros(11, 3)}, r"wanted a basis of \(R, 33\)"),
    ],
)
def test_parts_of_a_basis_that_do_not_fit_are_refused(changes: dict[str, torch.Tensor | None], message: str) -> None:
    tensors = {
        "mean": torch.zeros(10, 3),
        "components": torch.zeros(4, 30),
        "fine": torch.zeros(2, 30, dtype=torch.int8),
        "steps": torch.zeros(2),
    }
    changed = {name: tensor for name, tensor in {**tensors, **changes}.items() if tensor is not None}
    assert BasisDecoder.of_tensors(tensors).size == 6
    with pytest.raises(WeightsError, match=message):
        BasisDecoder.of_tensors(changed)


def test_a_basis_at_controls_is_that_of_all_vertices(garment: GarmentTemplate) -> None:
    """A field that bends no more than a garment's controls can say, stored in a hundredth of its bytes."""
    controls = Controls.spread(garment, 40)
    assert len(set(controls.vertices.tolist())) == 40
    at = garment.v_template[controls.vertices.long()]
    whole = controls(torch.stack((at, at.roll(1, 1))))
    torch.testing.assert_close(whole[0], garment.v_template, atol=0.03, rtol=0)  # as smooth as that, not as creased
    torch.testing.assert_close(whole[:, controls.vertices.long()], torch.stack((at, at.roll(1, 1))), atol=5e-3, rtol=0)
    torch.testing.assert_close(controls(torch.ones(1, 40, 2)), torch.ones(1, garment.n_vertices, 2))
    decoder = BasisDecoder(at, at.flatten()[None], controls=controls)
    torch.testing.assert_close(decoder(torch.zeros(1, 1))[0], whole[0], atol=1e-3, rtol=0)
    stored = decoder.tensors()
    again = BasisDecoder.of_tensors(stored, garment)
    assert torch.equal(again.components, decoder.components)
    assert again.is_stored_as(stored)
    assert not again.is_stored_as({**stored, "mean": stored["mean"] + 1})
    with pytest.raises(WeightsError, match="say whose basis"):
        BasisDecoder.of_tensors(stored)
    for wrong in (stored["controls"] + garment.n_vertices, stored["controls"].float(), stored["controls"] * 0):
        with pytest.raises(WeightsError, match="wanted controls among"):
            BasisDecoder.of_tensors({**stored, "controls": wrong}, garment)
    with pytest.raises(WeightsError, match="wanted a basis at 39 controls"):
        BasisDecoder.of_tensors({**stored, "controls": stored["controls"][1:]}, garment)


def test_a_basis_that_does_not_fit_is_refused() -> None:
    with pytest.raises(WeightsError, match=r"wanted a basis of \(R, 30\)"):
        BasisDecoder(torch.zeros(10, 3), torch.zeros(4, 33))


# Smoothing


def test_smoothing_is_what_a_loop_does(garment: GarmentTemplate, monkeypatch: pytest.MonkeyPatch) -> None:
    steps, size = 3, _frequency.STEP_SIZE
    monkeypatch.setattr(_frequency, "STEPS", steps)
    faces = garment.faces.numpy()
    count: dict[tuple[int, int], int] = {}
    for face in faces:
        for k in range(3):
            a, b = sorted((int(face[k]), int(face[k - 1])))
            count[a, b] = count.get((a, b), 0) + 1
    border = {v for edge, n in count.items() if n == 1 for v in edge}
    neighbours: dict[int, set[int]] = {v: set() for v in range(garment.n_vertices)}
    for (a, b), n in count.items():
        for i, j in ((a, b), (b, a)):
            if i not in border or n == 1:
                neighbours[i].add(j)
    x = garment.v_template.double().numpy().copy()
    for _ in range(steps):
        x = np.stack([v + size * (x[sorted(neighbours[i])].mean(0) - v) for i, v in enumerate(x)])
    smooth = LaplacianSmoothing(garment)
    torch.testing.assert_close(smooth(garment.v_template), torch.as_tensor(x).float(), atol=1e-6, rtol=0)


def test_smoothing_of_a_basis_is_smoothing(garment: GarmentTemplate) -> None:
    smooth = LaplacianSmoothing(garment)
    x, components = torch.randn(2, garment.n_vertices, 3), torch.randn(4, 3 * garment.n_vertices)
    torch.testing.assert_close(
        x.flatten(1) @ smooth.transposed(components).T, smooth(x).flatten(1) @ components.T, atol=2e-3, rtol=1e-3
    )


# GCNN


@pytest.mark.parametrize("stride", [2, 3])
def test_sampled_graphs_cover_the_mesh(garment: GarmentTemplate, stride: int) -> None:
    sizes, ups = sampled(garment.mesh, levels=2, stride=stride)
    assert sizes[0] == garment.n_vertices
    assert sizes[0] > 3 * sizes[1] > 9 * sizes[2] > 0
    for fine, coarse, up in zip(sizes[:-1], sizes[1:], ups, strict=True):
        assert up.index.shape[0] == fine
        assert up.valid[:, 0].all()  # everyone hears someone
        assert set(up.index[up.valid]) == set(range(coarse))  # and everyone is heard


def test_up_convolution_is_what_the_formula_says(garment: GarmentTemplate) -> None:
    sizes, ups = sampled(garment.mesh, levels=3)
    up = ups[2]
    for inputs, outputs in ((3, 5), (5, 3), (4, 4)):
        layer = UpConv(up, inputs, outputs, bases=4, residual=0.3)
        torch.nn.init.normal_(layer.density)
        torch.nn.init.normal_(layer.bias)
        x = torch.randn(sizes[3], 2, inputs)
        got = layer(x)
        for i in range(0, sizes[2], 7):
            conv, passed, total = layer.bias.clone(), torch.zeros(outputs), torch.zeros(())
            for n in np.flatnonzero(up.valid[i]):
                j = int(up.index[i, n])
                weight = sum(layer.coefficients[i, n, m] * layer.basis[m] for m in range(4))
                conv = conv + x[j, 1] @ weight
                rho = layer.density[i, n].abs()
                passed, total = passed + rho * layer.across(x[j, 1]), total + rho
            wanted = 0.7**0.5 * conv + 0.3**0.5 * passed / total
            torch.testing.assert_close(got[i, 1], wanted, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", ["tshirt-male", "skirt-female"])
def test_gcnn_learns_on_a_real_garment(name: str) -> None:
    garment = load_garment(name)
    net = build_backbone(GcnnConfig(load_garment(name).card.joints, hidden=(32,), channels=(9, 8, 8), bases=4), garment)
    assert isinstance(net, Gcnn)
    betas, pose, style = bodies(4)
    target = 0.03 * torch.sin(3 * garment.v_template + pose[:, 1:2])
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-2)
    losses = []
    for _ in range(12):
        prediction = net(betas, pose, style)
        loss = (prediction - target).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())
    assert losses[-1] < 0.7 * losses[0]


def test_papers_gcnn_and_mlp_take_a_step(garment: GarmentTemplate) -> None:
    for name in ("gcnn", "mlp"):
        net = build_backbone(backbone_config(name, garment, preset="paper"), garment)
        net(*bodies(2)).abs().mean().backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())
    assert isinstance(net, Mlp)
    assert len(net.net.layers) == 5


# Files


def write(folder: Path, net: torch.nn.Module, basis: BasisDecoder | None, *, mode: str = "none") -> Path:
    if basis is not None and not (folder / "basis.json").exists():
        save_basis(folder, basis, IDENTITY)
    return save_backbone(folder / f"{_name(net)}-{mode}", net, IDENTITY, others={"refu.k": torch.ones(3)})


def _name(net: torch.nn.Module) -> str:
    return {TailorNet: "tailornet", Mlp: "mlp", Gcnn: "gcnn"}[type(net)]  # type: ignore[index]


@pytest.fixture
def nets(garment: GarmentTemplate, basis: BasisDecoder) -> dict[str, torch.nn.Module]:
    joints = load_garment(GARMENT).card.joints
    return {
        "tailornet": tailornet(garment, basis),
        "mlp": build_backbone(MlpConfig(joints, hidden=(16,)), garment, basis=basis).eval(),
        "gcnn": build_backbone(GcnnConfig(joints, hidden=(16,), channels=(4, 4), bases=2), garment).eval(),
    }


@pytest.mark.parametrize("name", TRAINABLE)
def test_saved_and_loaded_it_predicts_the_same(
    tmp_path: Path, nets: dict[str, torch.nn.Module], basis: BasisDecoder, name: str
) -> None:
    path = write(tmp_path, nets[name], None if name == "gcnn" else basis, mode="hybrid")
    loaded = load_backbone(name, GARMENT, mode="hybrid", folder=tmp_path)
    with torch.no_grad():
        got, wanted = loaded(*bodies(2)), nets[name](*bodies(2))
    torch.testing.assert_close(got, wanted, atol=5e-3, rtol=0)  # half precision
    assert not got.requires_grad
    assert torch.equal(load_weights(path.with_suffix("")).tensors["refu.k"], torch.ones(3))
    assert not any(k.startswith("backbone.decoder") for k in load_weights(path.with_suffix("")).tensors)


def test_modes_share_the_basis_and_no_other(
    tmp_path: Path, garment: GarmentTemplate, nets: dict[str, torch.nn.Module], basis: BasisDecoder
) -> None:
    write(tmp_path, nets["tailornet"], basis)
    write(tmp_path, nets["tailornet"], basis, mode="approx")
    stored, digest = load_basis(tmp_path, garment, expect=IDENTITY)
    assert torch.equal(stored.components, basis.components)
    assert json.loads((tmp_path / "tailornet-approx.json").read_text())["basis_sha256"] == digest
    other = BasisDecoder(torch.zeros(garment.n_vertices, 3), basis.components.roll(1, 0))
    with pytest.raises(WeightsError, match="isn't the one that the backbone was trained with"):
        write(tmp_path, tailornet(garment, other), None)
    save_basis(tmp_path, other, IDENTITY)
    with pytest.raises(WeightsError, match="made for another basis"):
        load_backbone("tailornet", GARMENT, folder=tmp_path)


def test_weights_of_another_mode_or_garment_are_refused(
    tmp_path: Path, nets: dict[str, torch.nn.Module], basis: BasisDecoder
) -> None:
    write(tmp_path, nets["mlp"], basis)
    with pytest.raises(WeightsError, match="refu train"):
        load_backbone("mlp", GARMENT, mode="hybrid", folder=tmp_path)
    with pytest.raises(WeightsError, match="garment is tshirt-male"):
        load_backbone("mlp", "tshirt-male", folder=tmp_path)


def test_weights_of_another_network_are_refused(
    tmp_path: Path, garment: GarmentTemplate, nets: dict[str, torch.nn.Module], basis: BasisDecoder
) -> None:
    path = write(tmp_path, nets["mlp"], basis)
    weights = load_weights(path.with_suffix(""))
    card = dict(weights.card)
    for change, message in (({"config": {"joints": [0], "depth": 3}}, "doesn't know"), ({"backbone": "fit"}, "'fit'")):
        path.with_suffix(".json").write_text(json.dumps({**card, **change}))
        with pytest.raises(WeightsError, match=message):
            backbone_from_weights(load_weights(path.with_suffix("")), garment)
    config = {**card["config"], "hidden": [17]}
    path.with_suffix(".json").write_text(json.dumps({**card, "config": config}))
    with pytest.raises(WeightsError, match="doesn't fit short-pant-male"):
        backbone_from_weights(load_weights(path.with_suffix("")), garment)


def test_unknown_names_are_refused(garment: GarmentTemplate) -> None:
    assert load_backbone("skinned", GARMENT)(*bodies(1)) is None
    with pytest.raises(WeightsError, match="no backbone 'bert'"):
        load_backbone("bert", GARMENT)
    with pytest.raises(WeightsError, match="no mode of a backbone 'fast'"):
        load_backbone("mlp", GARMENT, mode="fast")
    with pytest.raises(WeightsError, match="could be trained"):
        backbone_config("skinned", garment)
    with pytest.raises(WeightsError, match="no preset 'tiny'"):
        backbone_config("mlp", garment, preset="tiny")
    with pytest.raises(WeightsError, match="needs pivots"):
        build_backbone(backbone_config("tailornet", garment), garment)
    assert set(TRAINABLE) | {"skinned", "auto", "dynamic"} == set(BackboneName)


def _rotvec(rotation: Tensor) -> Tensor:
    """Rotation vectors (B, 3) of matrices (B, 3, 3), off zero and half a turn."""
    angle = torch.acos(((rotation.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1))
    axis = torch.stack(
        (
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ),
        1,
    )
    return axis / (2 * angle.sin())[:, None] * angle[:, None]
