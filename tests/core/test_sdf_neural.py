"""The paper's distance network: what it starts as, what it doesn't depend on, its loss, samples and training."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from small_set import write_set
from torch import Tensor

from refu_core.body import SmplBody, load_body, rotvec_to_rotmat
from refu_core.errors import MeshError, RefuError, WeightsError
from refu_core.garments import GarmentTemplate, load_garment
from refu_core.sdf import (
    SDF_PRESETS,
    BodySdf,
    ExactSdf,
    NeuralSdf,
    SdfNetwork,
    SdfNetworkConfig,
    load_sdf_network,
    save_sdf_network,
    with_gradient,
)
from refu_core.simulation import GarmentDataset
from refu_core.training._sdf import SdfBatch, SdfSampler, SdfSettings, sdf_figures, sdf_loss, train_sdf


@pytest.fixture(scope="module")
def body() -> SmplBody:
    return load_body("male")


@pytest.fixture(scope="module")
def garment() -> GarmentTemplate:
    return load_garment("short-pant-male")


@pytest.fixture(scope="module")
def dataset(body: SmplBody, garment: GarmentTemplate, tmp_path_factory: pytest.TempPathFactory) -> GarmentDataset:
    """Twelve skinned garments, eight to learn from."""
    folder = tmp_path_factory.mktemp("set") / garment.name
    return GarmentDataset(write_set(folder, garment, body, pairs=6, poses=2, test_pairs=2))


def untrained(**sizes: int) -> SdfNetwork:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return SdfNetwork(SdfNetworkConfig(**sizes))


def conditioned(network: SdfNetwork) -> SdfNetwork:
    """One that depends on β and θ, which an untrained one doesn't."""
    with torch.no_grad():
        generator = torch.Generator().manual_seed(1)
        network.condition.weight.copy_(0.02 * torch.randn(network.condition.weight.shape, generator=generator))
    return network


def test_paper_preset_is_the_papers_network() -> None:
    network = untrained()
    shapes = [tuple(layer.weight.shape) for layer in (network.point, *network.layers, network.last)]
    assert shapes == [(1024, 3), *[(1024, 1024)] * 3, (1024, 1027), *[(1024, 1024)] * 4, (1, 1024)]
    assert network.condition.weight.shape == (1024, 10 + 69)
    assert network.activation.beta == 100
    assert SDF_PRESETS["paper"] == network.config


def test_starts_as_a_sphere() -> None:
    network = untrained(width=512, hidden=6, skip=3)
    points = torch.randn(1, 500, 3, generator=torch.Generator().manual_seed(0))
    zeros = torch.zeros(1, 10), torch.zeros(1, 23, 3)
    distance, gradient = with_gradient(network, points, *zeros, keep_graph=False)
    radius = points.norm(dim=-1)
    direction = (gradient * points).sum(-1) / radius
    assert np.corrcoef(distance[0], radius[0])[0, 1] > 0.95
    assert 0.7 < float(direction.mean()) < 1.2
    assert (distance[radius < 0.2] < 0).all()
    assert (distance[radius > 1.2] > 0).all()


def test_turning_the_body_turns_the_field(body: SmplBody) -> None:
    network = conditioned(untrained(width=64, hidden=4, skip=2))
    generator = torch.Generator().manual_seed(0)
    pose, betas = 0.3 * torch.randn(24, 3, generator=generator), torch.randn(10, generator=generator)
    upright = pose.clone()
    upright[0] = 0
    sdf = NeuralSdf(network, body)
    vertices = body(upright[None], betas[None]).vertices[0]
    with torch.no_grad():
        sdf.update(vertices, pose=upright, betas=betas)
        here = sdf.query(vertices[::9])
        turned = body(pose[None], betas[None]).vertices[0]  # the same places on the body, turned with it
        sdf.update(turned, pose=pose, betas=betas)
        there = sdf.query(turned[::9])
    torch.testing.assert_close(there.distance, here.distance, atol=1e-5, rtol=1e-5)
    rotation = rotvec_to_rotmat(pose[:1])[0]
    torch.testing.assert_close(there.gradient, here.gradient @ rotation.T, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(there.gradient.norm(dim=1), torch.ones(len(here.distance)))
    other = betas + 1
    sdf.update(vertices, pose=upright, betas=other)
    assert not torch.allclose(sdf.query(vertices[::9]).distance, here.distance, atol=1e-3)


def test_gradcheck_of_the_distance_its_gradient_and_the_weights(body: SmplBody) -> None:
    network = conditioned(untrained(width=12, hidden=3, skip=2)).double()
    network.activation.beta = 5.0  # smooth on the scale of a finite difference
    double = body.to(dtype=torch.float64)
    sdf = NeuralSdf(network, double)
    generator = torch.Generator().manual_seed(0)
    pose = 0.3 * torch.randn(24, 3, generator=generator, dtype=torch.float64)
    sdf.update(double.v_template, pose=pose, betas=torch.zeros(10, dtype=torch.float64))

    def f(points: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            network.last.weight.copy_(weight)
        sample = torch.func.functional_call(_Query(sdf), {"sdf_network.last.weight": weight}, (points,))
        return sample.distance, sample.gradient

    points = torch.randn(5, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    weight = network.last.weight.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(f, (points, weight))


class _Query(torch.nn.Module):
    """A query as a module, so that its weights can be exchanged."""

    def __init__(self, sdf: NeuralSdf) -> None:
        super().__init__()
        self.sdf, self.sdf_network = sdf, sdf.network

    def forward(self, points: Tensor) -> object:
        return self.sdf.query(points)


def test_untracked_queries_come_in_chunks_and_agree(body: SmplBody) -> None:
    network = conditioned(untrained(width=32, hidden=3, skip=1))
    sdf = NeuralSdf(network, body)
    sdf.update(body.v_template, pose=torch.zeros(24, 3), betas=torch.zeros(10))
    tracked = sdf.query(body.v_template)
    assert tracked.distance.requires_grad
    assert tracked.face is None
    with torch.no_grad():
        plain = sdf.query(body.v_template, near=torch.zeros(body.n_vertices))
    assert not plain.distance.requires_grad
    torch.testing.assert_close(plain.distance, tracked.distance)
    torch.testing.assert_close(plain.gradient, tracked.gradient)


def test_loss_is_the_papers() -> None:
    generator = torch.Generator().manual_seed(0)
    distance, truth = torch.randn(2, 2, 7, generator=generator)
    gradient, normals = torch.randn(2, 7, 3, generator=generator), torch.randn(2, 3, 3, generator=generator)
    batch = SdfBatch(torch.zeros(2, 10), torch.zeros(2, 23, 3), torch.zeros(2, 7, 3), truth, normals)
    value, normal, eikonal = [], [], []
    for b in range(2):
        for i in range(7):
            value.append(abs(float(distance[b, i] - truth[b, i])))
            if i < 3:
                normal.append(np.linalg.norm(gradient[b, i] - normals[b, i]))
            else:
                eikonal.append((np.linalg.norm(gradient[b, i]) - 1) ** 2)
    wanted = 2 * np.mean(value) + np.mean(normal) + 0.1 * np.mean(eikonal)
    assert float(sdf_loss(distance, gradient, batch)) == pytest.approx(wanted, rel=1e-5)


def test_samples_are_of_three_kinds_and_true(body: SmplBody, garment: GarmentTemplate, dataset: GarmentDataset) -> None:
    sampler = SdfSampler(dataset, body, garment, torch.arange(8))
    batch = sampler.draw(torch.Generator().manual_seed(0), bodies=3, points=800, noise=0.02)
    assert batch.points.shape == (3, 800, 3)
    assert batch.normals.shape == (3, 200, 3)
    assert (batch.distance[:, :200] == 0).all()
    near_skin, on_cloth, box = (batch.distance[:, a:b].abs() for a, b in ((200, 400), (500, 600), (600, 800)))
    assert near_skin.median() < 0.03
    assert on_cloth.max() < 0.1
    assert batch.points[:, 600:].abs().max() <= 2
    assert box.median() > 0.5
    exact = ExactSdf(body.faces)
    for i in range(3):
        pose = torch.cat((torch.zeros(1, 3), batch.pose[i]))
        exact.update(body(pose[None], batch.betas[i][None]).vertices[0])
        true = exact.query(batch.points[i])
        torch.testing.assert_close(true.distance, batch.distance[i], atol=1e-5, rtol=0)
        on_face = (true.gradient[:200] * batch.normals[i]).sum(1)
        assert on_face.quantile(0.1) > 0.9
    again = sampler.draw(torch.Generator().manual_seed(0), bodies=3, points=800, noise=0.02)
    assert torch.equal(again.points, batch.points)


@pytest.mark.usefixtures("no_curves")
def test_training_lowers_the_error_and_resumes_to_the_same_weights(
    body: SmplBody, garment: GarmentTemplate, dataset: GarmentDataset, tmp_path: Path
) -> None:
    settings = SdfSettings(
        preset="tiny",
        steps=40,
        batch_size=2,
        points=160,
        learning_rate=3e-3,
        check_every=20,
        validation_share=0.25,
        is_annealed=True,
    )
    card = train_sdf(dataset, body, garment, tmp_path / "once", settings=settings, quiet=True)
    checks = [json.loads(line) for line in (tmp_path / "once" / "sdf-tiny.jsonl").read_text().splitlines()]
    assert [check["step"] for check in checks] == [20, 40]
    sampler = SdfSampler(dataset, body, garment, torch.arange(8, 12))
    batch = sampler.draw(torch.Generator().manual_seed(1), bodies=4, points=400, noise=0.02)
    before = sdf_figures(untrained(width=64, hidden=4, skip=2), batch)
    trained = load_sdf_network(tmp_path / "once" / "sdf-tiny", body)
    after = sdf_figures(trained, batch)
    assert after["absolute_mm"] < 0.8 * before["absolute_mm"]
    assert card["figures"]["test"]["absolute_mm"] < 0.8 * before["absolute_mm"]

    with pytest.raises(RefuError, match="wanted a set whose garment is skirt-female"):
        train_sdf(dataset, body, load_garment("skirt-female"), tmp_path / "other", settings=settings, quiet=True)

    # Interrupted after the first checkpoint, in the middle of a step's writing.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("refu_core.training._sdf.sdf_figures", _FailsAt(3))
        with pytest.raises(KeyboardInterrupt):
            train_sdf(dataset, body, garment, tmp_path / "twice", settings=settings, quiet=True)
    with pytest.raises(RefuError, match=r"other settings or data"):
        train_sdf(dataset, body, garment, tmp_path / "twice", settings=SdfSettings(preset="tiny", seed=1), quiet=True)
    train_sdf(dataset, body, garment, tmp_path / "twice", settings=settings, quiet=True)
    assert not list((tmp_path / "twice").glob("*.checkpoint"))
    resumed = load_sdf_network(tmp_path / "twice" / "sdf-tiny", body)
    for name, tensor in trained.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name


def test_rates_are_the_papers_or_fall_to_nothing() -> None:
    paper, small = SdfSettings.of("paper"), SdfSettings.of("small")
    assert {paper.rate(step) for step in (0, 1000, paper.steps)} == {1e-5}
    rates = [small.rate(step) for step in range(0, small.steps + 1, 100)]
    assert rates[0] == small.learning_rate
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] == pytest.approx(0.0, abs=1e-12)


class _FailsAt:
    """Stands for a process that is ended: the figures are asked for before a checkpoint is written."""

    def __init__(self, call: int) -> None:
        self.left = call

    def __call__(self, network: SdfNetwork, batch: SdfBatch) -> dict[str, float]:
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt
        return sdf_figures(network, batch)


def test_weights_are_written_read_and_refused(body: SmplBody, tmp_path: Path) -> None:
    network = conditioned(untrained(width=16, hidden=3, skip=1))
    save_sdf_network(tmp_path / "net", network, {"body_fingerprint": body.fingerprint})
    read = load_sdf_network(tmp_path / "net", body)
    points = torch.randn(1, 20, 3)
    arguments = points, torch.ones(1, 10), torch.ones(1, 23, 3)
    assert torch.equal(read(*arguments), network(*arguments))
    with pytest.raises(WeightsError, match=r"trained on the body"):
        load_sdf_network(tmp_path / "net", load_body("female"))
    save_sdf_network(tmp_path / "odd", network, {"body_fingerprint": body.fingerprint})
    card = json.loads((tmp_path / "odd.json").read_text())
    card["network"]["width"] = 17
    (tmp_path / "odd.json").write_text(json.dumps(card))
    with pytest.raises(WeightsError, match=r"not the weights of a distance network"):
        load_sdf_network(tmp_path / "odd", body)


def test_says_what_is_wrong(body: SmplBody) -> None:
    sdf = NeuralSdf(untrained(width=16, hidden=3, skip=1), body)
    assert isinstance(sdf, BodySdf)
    with pytest.raises(MeshError, match=r"call update"):
        sdf.query(torch.zeros(1, 3))
    with pytest.raises(MeshError, match=r"needs pose \(24, 3\) and betas \(10,\) of the body, got None and \(10,\)"):
        sdf.update(body.v_template, betas=torch.zeros(10))
    sdf.update(body.v_template, pose=torch.zeros(24, 3), betas=torch.zeros(10))
    with pytest.raises(MeshError, match=r"shape \(N, 3\)"):
        sdf.query(torch.zeros(1, 2))
    with pytest.raises(WeightsError, match=r"skip among the hidden layers"):
        SdfNetworkConfig(hidden=3, skip=3)
    with pytest.raises(RefuError, match=r"no preset 'large'"):
        SdfSettings(preset="large")
    with pytest.raises(RefuError, match=r"must be positive"):
        SdfSettings(steps=0)
