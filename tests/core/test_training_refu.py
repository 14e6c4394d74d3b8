"""Training with ReFU: losses, what a batch goes through, and fine-tuning of every mode."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from small_set import write_set
from torch import Tensor, nn

from refu_core import load_body, load_garment
from refu_core.backbones import MlpConfig, WithoutWearerCode, backbone_from_weights
from refu_core.body import ARMS, Collider, SmplBody
from refu_core.contact import Blend
from refu_core.errors import RefuError, WeightsError
from refu_core.garments import GarmentTemplate, SkinBelow
from refu_core.realtime import RootTurn
from refu_core.realtime._load import wearable_of
from refu_core.refu import Refu, trained_from_weights
from refu_core.sdf import ApproxSdf, ExactSdf, RestFaces, SdfSample
from refu_core.training import (
    FinetuneSettings,
    LoopSettings,
    PretrainSettings,
    collision_loss,
    finetune,
    pretrain,
    reconstruction_loss,
    refu_loss,
)
from refu_core.training import _loop as loop_module
from refu_core.training._data import TrainingSet
from refu_core.training._dresser import Dresser
from refu_core.training._finetune import FINETUNE_MODES
from refu_core.training._pretrain import MANY, SOME
from refu_core.weights import load_weights

GARMENT = "short-pant-male"
N, N_PAIRS = 30, 10
QUICK = FinetuneSettings(
    LoopSettings(batch_size=3, learning_rate=3e-3, weight_decay=0.0, check_every=2),
    steps=4,
    validation_share=0.2,
)


def test_losses_are_the_papers() -> None:
    generator = torch.Generator().manual_seed(0)
    vertices, truth = torch.randn(2, 3, 5, 3, generator=generator)
    distance = torch.randn(3, 5, generator=generator)
    squares = sum(float((vertices[b, i] - truth[b, i]).norm() ** 2) for b in range(3) for i in range(5))
    depths = sum(max(0.0, -float(distance[b, i])) for b in range(3) for i in range(5))
    assert float(reconstruction_loss(vertices, truth)) == pytest.approx(squares / 15)
    assert float(collision_loss(distance)) == pytest.approx(depths / 15)
    loss = refu_loss(vertices, truth, distance)
    assert float(loss) == pytest.approx((1.5 * squares + 0.5 * depths) / 15)
    other = refu_loss(vertices, truth, distance, reconstruction_weight=0.0, collision_weight=2.0)
    assert float(other) == pytest.approx(2 * depths / 15)


@pytest.fixture(scope="module")
def garment() -> GarmentTemplate:
    return load_garment(GARMENT)


@pytest.fixture(scope="module")
def body(garment: GarmentTemplate) -> SmplBody:
    return load_body(garment.body)


class Tight(WithoutWearerCode, nn.Module):
    """A backbone whose garment is everywhere `depth` [m] nearer to the skin than the template."""

    def __init__(self, garment: GarmentTemplate, body: SmplBody, depth: float) -> None:
        super().__init__()
        sdf = ExactSdf(body.faces)
        sdf.update(body.v_template)
        self.inward = nn.Parameter(-depth * sdf.query(garment.v_template).gradient)

    def forward(
        self, betas: Tensor, pose: Tensor, style: Tensor | None, *, wearer_code: Tensor | None = None
    ) -> Tensor:
        del pose, style, wearer_code
        return self.inward.expand(len(betas), -1, -1)


def bodies(batch: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    betas, style = torch.randn(batch, 10, generator=generator), torch.randn(batch, 4, generator=generator)
    pose = 0.15 * torch.randn(batch, 24, 3, generator=generator)
    return betas, pose, style


def assert_nearly_all_close(actual: Tensor, wanted: Tensor, tolerance: float) -> None:
    """Where two parts of the skin are equally near, rounding decides which is the closest: for a few vertices."""
    assert ((actual - wanted).abs() < tolerance).float().mean() > 0.99


@pytest.mark.parametrize("in_refu", ["accurate", "approx"])
def test_a_batch_is_dressed_as_the_parts_would_one_by_one(
    garment: GarmentTemplate, body: SmplBody, in_refu: Any
) -> None:
    backbone = Tight(garment, body, 0.03)
    refu = Refu(garment.n_vertices, least=1.0)
    drawn = torch.Generator().manual_seed(0)
    nn.init.normal_(dict(refu.named_parameters())["scale.g.2.weight"], std=0.3, generator=drawn)
    dresser = Dresser(backbone, refu, garment, body, in_refu=in_refu, in_loss="accurate")
    betas, pose, style = bodies(2)
    dressed = dresser(betas, pose, style)
    # An approximate distance is that of the axes that it is asked in: the root's, as everywhere.
    posed = body.posed(pose, body.shape(betas), in_root=True)
    turns, exact, approx, rest_faces = RootTurn.taken_off(posed), ExactSdf(body.faces), ApproxSdf(body), RestFaces(body)
    unposed = garment.rest(betas, style) + backbone.inward
    raw = garment.pose(unposed, posed.transforms)
    apart = Collider(body)(posed.vertices, posed.transforms)
    taken_along = SkinBelow.of(garment, body)(apart - posed.vertices)
    assert taken_along.norm(dim=-1).max() > 0.002
    raw = raw + taken_along
    for b in range(2):
        exact.update(apart[b])
        approx.update(apart[b])
        near = rest_faces(unposed[b] - (garment.shapedirs @ betas[b]).view(-1, 3))
        sample = (exact if in_refu == "accurate" else approx).query(raw[b].detach(), near=near)
        z = refu.feature(betas, pose, style)
        assert z is not None
        batch = SdfSample(sample.distance[None], sample.gradient[None])
        pushed = refu(raw[b : b + 1], batch, z[b : b + 1])
        blend = Blend.of_faces(garment.faces, garment.n_vertices)
        wanted = blend.follow(raw[b : b + 1], pushed, batch, refu.margin)[0]
        torch.testing.assert_close(dressed[b, :, :3], turns[b](wanted), rtol=0, atol=1e-5)
        distance = exact.query(wanted.detach()).distance
        torch.testing.assert_close(dressed[b, :, 3].clamp_max(0.004), distance.clamp_max(0.004), rtol=0, atol=1e-5)
        assert (sample.distance < 0).sum() > 100


def test_the_distance_has_its_own_derivative(garment: GarmentTemplate, body: SmplBody) -> None:
    backbone = Tight(garment, body, 0.03)
    dresser = Dresser(backbone, None, garment, body, in_refu="accurate", in_loss="accurate")
    betas, pose, style = bodies(1)
    distance = dresser(betas, pose, style)[0, :, 3]
    (derivative,) = torch.autograd.grad(distance[distance < 0].sum(), backbone.inward)
    step = 1e-4 * torch.randn(backbone.inward.shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        backbone.inward += step
        moved = dresser(betas, pose, style)[0, :, 3]
    numeric = (moved - distance)[distance < 0].detach()
    analytic = (derivative * step).sum(-1)[distance < 0]
    assert len(numeric) > 100
    assert_nearly_all_close(analytic, numeric, 2e-5)


def test_without_refu_the_garment_is_the_backbones(garment: GarmentTemplate, body: SmplBody) -> None:
    backbone = Tight(garment, body, 0.01)
    dresser = Dresser(backbone, None, garment, body, in_refu="approx", in_loss="approx")
    betas, pose, style = bodies(2)
    posed = body(pose, betas)
    raw = garment.pose(garment.rest(betas, style) + backbone.inward, posed.transforms)
    taken_along = SkinBelow.of(garment, body)(Collider(body)(posed.vertices, posed.transforms) - posed.vertices)
    torch.testing.assert_close(dresser(betas, pose, style)[..., :3], raw + taken_along)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, garment: GarmentTemplate, body: SmplBody) -> Path:
    """Shorts that follow the skin."""
    folder = tmp_path_factory.mktemp("set") / GARMENT
    return write_set(folder, garment, body, pairs=N_PAIRS, poses=N // N_PAIRS, test_pairs=N_PAIRS - 9, spread=0.15)


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory: pytest.TempPathFactory, dataset: Path) -> Path:
    """A small backbone, hardly trained."""
    folder = tmp_path_factory.mktemp("weights")
    settings = PretrainSettings(LoopSettings(batch_size=8, check_every=10), rank=8, steps=10, validation_share=0.2)
    config = MlpConfig((0, 1, 2, 4, 5), hidden=(16,))
    pretrain(GARMENT, dataset, folder, backbone="mlp", settings=settings, config=config, quiet=True)
    return folder


Tuned = Callable[[str], tuple[Path, dict[str, Any]]]


@pytest.fixture(scope="module")
def tuned(tmp_path_factory: pytest.TempPathFactory, dataset: Path, pretrained: Path) -> Tuned:
    """Folder and card of a quick training in a mode, made when it is first asked for."""

    @cache
    def of(mode: str) -> tuple[Path, dict[str, Any]]:
        folder = tmp_path_factory.mktemp(mode)
        card = finetune(GARMENT, dataset, pretrained, folder, mode=mode, backbone="mlp", settings=QUICK, quiet=True)
        return folder, card

    return of


@pytest.mark.parametrize("mode", FINETUNE_MODES)
def test_every_mode_writes_what_can_be_read(
    tuned: Tuned, pretrained: Path, garment: GarmentTemplate, body: SmplBody, mode: str
) -> None:
    folder, card = tuned(mode)
    expect = {"garment": GARMENT, "body_fingerprint": body.fingerprint}
    stem = folder / f"mlp-{mode}"
    network, refu = trained_from_weights(load_weights(stem, expect=expect), garment)
    betas, pose, style = bodies(2)
    before = backbone_from_weights(load_weights(pretrained / "mlp-none", expect=expect), garment)
    assert not torch.equal(network(betas, pose, style), before(betas, pose, style))
    assert card["mode"] == load_weights(stem).card["mode"] == mode
    assert (folder / f"mlp-{mode}.png").exists()
    assert not (folder / f"mlp-{mode}.checkpoint").exists()
    if mode.startswith("collision"):
        assert refu is None
        return
    assert refu is not None
    assert refu.config["least"] == (1.0 if mode == "accurate" else 0.0)
    assert not any(parameter.requires_grad for parameter in refu.parameters())


@pytest.mark.usefixtures("no_curves")
def test_interrupted_it_resumes_to_the_same_weights(
    tuned: Tuned, tmp_path: Path, dataset: Path, pretrained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train() -> dict[str, Tensor]:
        finetune(GARMENT, dataset, pretrained, tmp_path, mode="accurate", backbone="mlp", settings=QUICK, quiet=True)
        return dict(load_weights(tmp_path / "mlp-accurate").tensors)

    whole = load_weights(tuned("accurate")[0] / "mlp-accurate").tensors
    real = loop_module.save_checkpoint

    def interrupted(*args: Any) -> None:
        real(*args)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop_module, "save_checkpoint", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train()
    torch.manual_seed(99)
    parts = train()
    assert whole.keys() == parts.keys()
    assert any(name.startswith("refu.") for name in whole)
    assert all(torch.equal(whole[name], parts[name]) for name in whole)


@pytest.mark.usefixtures("no_curves")
def test_training_brings_the_cloth_out_and_nearer_to_the_truth(
    tuned: Tuned, tmp_path: Path, dataset: Path, pretrained: Path
) -> None:
    settings = replace(QUICK, steps=40, loop=replace(QUICK.loop, check_every=20))
    finetune(GARMENT, dataset, pretrained, tmp_path, mode="hybrid", backbone="mlp", settings=settings, quiet=True)
    lines = [json.loads(line) for line in (tmp_path / "mlp-hybrid.jsonl").read_text().splitlines()]
    first = json.loads((tuned("hybrid")[0] / "mlp-hybrid.jsonl").read_text().splitlines()[0])
    assert lines[-1]["validation"] < 0.8 * first["validation"]


@pytest.mark.usefixtures("no_curves")
def test_goes_on_from_trained_weights_and_keeps_their_layer(tuned: Tuned, tmp_path: Path, dataset: Path) -> None:
    first, _ = tuned("hybrid")
    settings = PretrainSettings(replace(QUICK.loop, learning_rate=1e-9, weight_decay=0.0), steps=1)
    how: dict[str, Any] = {"backbone": "mlp", "settings": settings, "quiet": True}
    card = pretrain(GARMENT, dataset, tmp_path, start=first, mode="hybrid", **how)
    before, after = (load_weights(folder / "mlp-hybrid") for folder in (first, tmp_path))
    assert card["goes_on_from"] == before.card["sha256"]
    assert after.card["refu"] == before.card["refu"]
    assert any(name.startswith("refu.") for name in before.tensors)
    for name, tensor in before.tensors.items():
        assert torch.allclose(after.tensors[name].float(), tensor.float(), atol=1e-3), name


@pytest.mark.usefixtures("no_curves")
def test_a_gcnn_is_trained_from_scratch(tmp_path: Path, dataset: Path, garment: GarmentTemplate) -> None:
    settings = replace(QUICK, steps=2, is_mirrored=False, loop=replace(QUICK.loop, batch_size=1))
    card = finetune(GARMENT, dataset, None, tmp_path, mode="approx", backbone="gcnn", settings=settings, quiet=True)
    assert card["from_scratch"]
    network = backbone_from_weights(load_weights(tmp_path / "gcnn-approx"), garment)
    assert torch.isfinite(network(*bodies(1))).all()


def test_a_gcnn_has_as_much_training_with_refu_as_alone() -> None:
    alone, together = PretrainSettings.of("gcnn"), FinetuneSettings.of("gcnn")
    assert (together.loop, together.steps) == (alone.loop, alone.steps)
    assert FinetuneSettings.of("gcnn", "paper") == FinetuneSettings.paper()
    assert FinetuneSettings.of("tailornet") == FinetuneSettings()
    assert PretrainSettings.of("mlp") == PretrainSettings.of("tailornet", samples=SOME - 1) == PretrainSettings()
    some, many = (PretrainSettings.of("tailornet", samples=samples) for samples in (SOME, MANY))
    assert some.steps == many.steps > PretrainSettings().steps
    assert some.loop == PretrainSettings().loop
    assert many.loop.weight_decay < PretrainSettings().loop.weight_decay


def test_says_what_it_knows(tmp_path: Path, dataset: Path, pretrained: Path) -> None:
    with pytest.raises(RefuError, match="no mode 'exact' of training: wanted approx, accurate"):
        finetune(GARMENT, dataset, pretrained, tmp_path, mode="exact")
    with pytest.raises(RefuError, match="no preset 'huge' of the scale networks"):
        finetune(GARMENT, dataset, pretrained, tmp_path, backbone="mlp", settings=replace(QUICK, scale="huge"))
    with pytest.raises(WeightsError, match="tailornet-none"):
        finetune(GARMENT, dataset, pretrained, tmp_path, settings=QUICK)


def test_networks_know_arms_that_they_are_told_of_and_that_were_beside_the_cloth(pretrained: Path) -> None:
    """Sets of old held limbs back, and shorts' networks aren't told where arms are."""
    stored, template = load_weights(pretrained / "mlp-none"), load_garment(GARMENT)
    arms = tuple(joint for arm in ARMS for joint in arm[:2])
    for joints, told in ((template.card.joints, False), ((0, *arms), True), ((0, *arms[:-1]), False)):
        garment = replace(template, card=replace(template.card, joints=joints))
        for said, knows in ((True, told), (False, False), (None, False), ("yes", False)):
            card = {**stored.card, "knows_limbs": said}
            assert wearable_of(replace(stored, card=card), garment, None).knows_arms is knows
        card = {key: value for key, value in stored.card.items() if key != "knows_limbs"}
        assert not wearable_of(replace(stored, card=card), garment, None).knows_arms


def test_a_set_says_whether_limbs_were_beside_the_cloth(dataset: Path) -> None:
    opened = TrainingSet.of(GARMENT, dataset, None)
    for drape, knows in (({"gap": 0.012}, True), ({}, False)):
        opened.sets[0].card["settings"] = {"drape": drape}
        assert opened.knows_limbs is knows
    opened.sets[0].card.pop("settings")
    assert not opened.knows_limbs
