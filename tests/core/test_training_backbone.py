"""Pre-training: mirrored and split samples, a basis, and trainings that resume to the same weights."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_set import write_set
from torch import Tensor

from refu_core import WeightsError, load_body, load_garment
from refu_core.backbones import (
    GcnnConfig,
    LaplacianSmoothing,
    MlpConfig,
    TailorNetConfig,
    WithoutWearerCode,
    load_backbone,
)
from refu_core.body import Collider, SmplBody
from refu_core.errors import RefuError
from refu_core.garments import GarmentTemplate
from refu_core.realtime import Outfit, Wearable, Wearer, dress
from refu_core.simulation import GarmentDataset
from refu_core.training import LoopSettings, PretrainSettings, TrainingLog, pretrain
from refu_core.training import _loop as loop_module
from refu_core.training._data import (
    Mirror,
    TakenAlong,
    TrainingSamples,
    TrainingSet,
    displacements,
    mirror_pose,
    mirrored,
    output_basis,
    posed_errors,
    read_samples,
    split_validation,
)
from refu_core.training._record import load_checkpoint, save_checkpoint
from refu_core.weights import load_weights

GARMENT = "short-pant-male"
N, N_PAIRS = 240, 24
JOINTS = (0, 1, 2, 4, 5)
SMALL = TailorNetConfig(JOINTS, low=(24,), high=(8,), style_shape=(8,), dropout=0.05)
QUICK = PretrainSettings(
    LoopSettings(batch_size=16, learning_rate=1e-2, weight_decay=0.01, check_every=20),
    rank=8,
    style_shape_steps=40,
    low_steps=80,
    steps=80,
    validation_share=0.2,
)


@pytest.fixture(scope="module")
def garment() -> GarmentTemplate:
    return load_garment(GARMENT)


@pytest.fixture(scope="module")
def body(garment: GarmentTemplate) -> SmplBody:
    return load_body(garment.body)


def cloth(garment: GarmentTemplate, pose: Tensor) -> Tensor:
    """Displacements (N, V, 3) that both knees and hips make, symmetric in left and right, four waves in all."""
    x = garment.v_template
    waves = torch.stack((torch.sin(9 * x[:, 1]), torch.cos(9 * x[:, 1])), 1)
    left, right = torch.sigmoid(20 * x[:, :1]), torch.sigmoid(-20 * x[:, :1])
    bend = pose[:, [1, 2], 0] + 0.5 * pose[:, [4, 5], 0]
    height = 0.03 * (bend[:, 0, None, None] * left * waves + bend[:, 1, None, None] * right * waves)
    return torch.stack((torch.zeros_like(height[..., 0]), height[..., 0], height[..., 1]), -1)


def waves_of(folder: Path, garment: GarmentTemplate, body: SmplBody, **sizes: int) -> Path:
    displacement = partial(cloth, garment)
    return write_set(folder, garment, body, spread=0.4, displacement=displacement, **sizes)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory, garment: GarmentTemplate, body: SmplBody) -> Path:
    """Shorts with waves that knees and hips make."""
    folder = tmp_path_factory.mktemp("set") / GARMENT
    return waves_of(folder, garment, body, pairs=N_PAIRS, poses=N // N_PAIRS, test_pairs=N_PAIRS - 20)


@pytest.fixture(scope="module")
def small_set(tmp_path_factory: pytest.TempPathFactory, garment: GarmentTemplate, body: SmplBody) -> Path:
    """The same with fewer samples: to read a set takes longer than some steps of training."""
    return waves_of(tmp_path_factory.mktemp("small") / GARMENT, garment, body, pairs=12, poses=6)


@pytest.fixture(scope="module")
def samples(dataset: Path, garment: GarmentTemplate, body: SmplBody) -> TrainingSamples:
    """What the set is trained with."""
    return read_samples(GarmentDataset(dataset), body, garment, split="train")


# Samples


class Told(WithoutWearerCode):
    """A backbone that says what it was told."""

    def __init__(self, displacement: Tensor) -> None:
        self.displacement = displacement

    def __call__(self, *inputs: Tensor | None, wearer_code: Tensor | None = None) -> Tensor:
        del inputs, wearer_code
        return self.displacement


def test_a_network_that_says_what_samples_say_makes_the_simulated_garment(
    dataset: Path, samples: TrainingSamples, garment: GarmentTemplate, body: SmplBody
) -> None:
    """Where limbs touch, too: the collider takes cloth along, and no network has to say that."""
    opened = GarmentDataset(dataset)
    few = samples.take(torch.arange(6))
    true = opened.column("vertices")[np.flatnonzero(opened.train)[:6]] * float(opened.card["quantum_m"])
    outfit = Outfit(body, {GARMENT: Wearable(garment, Told(few.displacement), None, 0.0)}, Collider(body))
    dressed = dress(few.pose, Wearer.of(outfit, few.betas, garment.own(few.style)))
    for turn, made, wanted in zip(dressed.turns, dressed.drapes[GARMENT].vertices, true, strict=True):
        assert np.abs(turn.to_host(made) - wanted).max() < 2e-4


def test_samples_are_unposed_displacements(
    dataset: Path, samples: TrainingSamples, garment: GarmentTemplate, body: SmplBody
) -> None:
    assert len(samples) == 200
    whole = TakenAlong(body, garment).added(1, samples.displacement, samples.betas, samples.pose, samples.style)
    torch.testing.assert_close(whole, cloth(garment, samples.pose), atol=2e-4, rtol=0)
    assert (samples.displacement - whole).abs().max() > 0.01, "in some of these poses skin gives way"
    wrong = torch.zeros_like(samples.displacement)
    errors = posed_errors(wrong, samples, body, garment)
    transforms = body(samples.pose[:1], samples.betas[:1]).transforms
    rest = garment.rest(samples.betas[:1], samples.style[:1])
    distance = garment.pose(rest + samples.displacement[:1], transforms) - garment.pose(rest, transforms)
    torch.testing.assert_close(errors[0], 1e3 * distance[0].norm(dim=-1), atol=1e-3, rtol=1e-4)
    with pytest.raises(RefuError, match="wanted a set whose garment is skirt-female"):
        read_samples(GarmentDataset(dataset), load_body("female"), load_garment("skirt-female"), split="train")


def test_sets_are_one_with_pairs_of_their_own(dataset: Path, small_set: Path) -> None:
    one, other, both = (TrainingSet.of(GARMENT, sets, None) for sets in (dataset, small_set, [dataset, small_set]))
    n, count = len(one.samples), int(one.samples.pair.max()) + 1
    assert torch.equal(both.samples.pose, torch.cat((one.samples.pose, other.samples.pose)))
    assert torch.equal(both.samples.pair[n:], other.samples.pair + count)
    assert len(both.test()) == len(one.test()) + len(other.test())
    assert both.cards == one.cards + other.cards
    with pytest.raises(RefuError, match="wanted a set"):
        TrainingSet.of(GARMENT, [], None)


@pytest.mark.parametrize("name", ["shirt-male", "tshirt-male", "short-pant-male", "skirt-female"])
def test_built_in_garments_and_bodies_are_their_own_mirror_images(name: str) -> None:
    garment = load_garment(name)
    body = load_body(garment.body)
    mirror = Mirror.of(garment)
    flip = torch.tensor((-1.0, 1.0, 1.0))
    generator = torch.Generator().manual_seed(0)
    betas, style = torch.randn(1, 10, generator=generator), torch.randn(1, 4, generator=generator)
    pose = 0.5 * torch.randn(1, 24, 3, generator=generator)
    pose[:, 0] = torch.tensor((0.3, 0.2, -0.1))

    smooth = 0.02 * torch.sin(5 * garment.v_template + 1.0)[None]
    posed = garment.pose(garment.rest(betas, style) + smooth, body(pose, betas).transforms)
    other = garment.pose(
        garment.rest(betas, style) + mirror.displacement(smooth), body(mirror_pose(pose), betas).transforms
    )
    # The mirrored garment is the garment in the mirror: vertex i lies where its triangle's mixture lies, flipped.
    corners, weights = mirror.image.corners, mirror.image.weights.float()
    wanted = (weights[..., None] * posed[0][corners]).sum(1) * flip
    away = (other[0] - wanted).norm(dim=-1)
    assert away.mean() < 4e-4
    assert away.max() < 8e-3
    torch.testing.assert_close(mirror_pose(mirror_pose(pose)), pose)
    body_mirrored = body(mirror_pose(pose), betas).vertices[0] * flip
    body_posed = body(pose, betas).vertices[0]
    torch.testing.assert_close(body_mirrored.sum(0), body_posed.sum(0), atol=1e-2, rtol=1e-3)


@pytest.mark.usefixtures("no_curves")
def test_an_asymmetric_garment_learns_without_mirror_images(
    garment: GarmentTemplate, body: SmplBody, tmp_path: Path
) -> None:
    leaning = replace(garment, v_template=garment.v_template + 0.1 * garment.v_template[:, [1, 0, 2]])
    folder = write_set(tmp_path / "set", leaning, body, pairs=6, poses=2, test_pairs=1)
    settings = replace(QUICK, style_shape_steps=2, low_steps=2, steps=2)
    card = pretrain(leaning, folder, tmp_path / "weights", settings=settings, config=SMALL, body=body, quiet=True)
    assert card["samples"] == 8, "of ten, two are for validation"


def test_pairs_are_held_out_whole(samples: TrainingSamples) -> None:
    train, validation = split_validation(samples, share=0.3, seed=1)
    assert not set(train.pair.tolist()) & set(validation.pair.tolist())
    assert len(train) + len(validation) == 200
    assert len(validation) == 60
    assert set(split_validation(samples, share=0.3, seed=2)[1].pair.tolist()) != set(validation.pair.tolist())
    assert len(split_validation(samples, share=0.0, seed=1)[1]) == 0


def test_of_five_pairs_one_is_held_out_however_large(samples: TrainingSamples) -> None:
    for n_pairs, n_held_out in ((5, 1), (4, 0)):
        few = samples.take(samples.pair < n_pairs)
        assert len(torch.unique(few.pair)) == n_pairs
        train, validation = split_validation(few, share=0.08, seed=1)
        assert len(torch.unique(validation.pair)) == n_held_out
        assert len(torch.unique(train.pair)) == n_pairs - n_held_out


def test_the_basis_is_the_principal_components(samples: TrainingSamples, garment: GarmentTemplate) -> None:
    both = samples.joined(mirrored(samples, Mirror.of(garment)))
    basis = output_basis(both.displacement, rank=2)
    torch.testing.assert_close(basis.components @ basis.components.T, torch.eye(2), atol=2e-3, rtol=0)
    centred = (both.displacement - both.displacement.mean(0)).flatten(1).double()
    wanted = torch.linalg.eigh(centred @ centred.T).eigenvectors[:, -2:].T @ centred
    same_plane = (torch.nn.functional.normalize(wanted).float() @ basis.components[:2].T).det().abs()
    torch.testing.assert_close(same_plane, torch.tensor(1.0), atol=0.02, rtol=0)
    rebuilt = basis(basis.encode(both.displacement))
    assert (rebuilt - both.displacement).norm(dim=-1).mean() < 8e-3


def test_a_basis_of_few_samples_has_fewer_components(samples: TrainingSamples) -> None:
    """So that a first trial of the whole way needs no set of hundreds."""
    displacement = samples.displacement[:5]
    basis = output_basis(displacement, rank=128)
    assert basis.size == 4
    torch.testing.assert_close(basis(basis.encode(displacement)), displacement, atol=2e-4, rtol=0)
    with pytest.raises(RefuError, match="2 samples at least, got 1"):
        output_basis(displacement[:1], rank=128)


# Training


@pytest.mark.parametrize("is_joint", [True, False])
def test_a_trained_tailornet_beats_the_mean(
    tmp_path: Path, dataset: Path, garment: GarmentTemplate, body: SmplBody, is_joint: bool
) -> None:
    card = pretrain(GARMENT, dataset, tmp_path, settings=replace(QUICK, is_joint=is_joint), config=SMALL, quiet=True)
    figures = card["figures"]
    assert figures["mpve_mm"] < 0.95 * figures["mean_mm"]
    assert figures["basis_mm"] < 1.0
    assert figures["samples"] == 40
    assert card["body_fingerprint"] == body.fingerprint
    samples = read_samples(GarmentDataset(dataset), body, garment, split="test")
    loaded = load_backbone("tailornet", GARMENT, folder=tmp_path)
    again = posed_errors(displacements(loaded, samples), samples, body, garment).mean().item()
    assert again == pytest.approx(figures["mpve_mm"], abs=0.3)  # half precision
    assert (tmp_path / "tailornet-none.png").read_bytes()[:4] == b"\x89PNG"
    assert not (tmp_path / "tailornet-none.checkpoint").exists()


@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("mlp", MlpConfig(JOINTS, hidden=(24, 24), dropout=0.0)),
        ("gcnn", GcnnConfig(JOINTS, hidden=(24,), channels=(6, 6, 6), bases=2, dropout=0.0)),
    ],
)
@pytest.mark.usefixtures("no_curves")
def test_other_backbones_are_trained_the_same_way(
    tmp_path: Path, dataset: Path, name: str, config: MlpConfig | GcnnConfig
) -> None:
    settings = replace(QUICK, steps=40, loop=replace(QUICK.loop, batch_size=8, learning_rate=1e-2))
    card = pretrain(GARMENT, dataset, tmp_path, backbone=name, settings=settings, config=config, quiet=True)
    figures = card["figures"]
    assert figures["mpve_mm"] < 0.85 * figures["mean_mm"]


def weights(folder: Path) -> dict[str, Tensor]:
    return dict(load_weights(folder / "tailornet-none").tensors)


@pytest.mark.usefixtures("no_curves")
def test_interrupted_it_resumes_to_the_same_weights(
    tmp_path: Path, small_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train(folder: Path, seed: int = 0) -> None:
        loop = replace(QUICK.loop, seed=seed, check_every=10)
        settings = PretrainSettings(
            loop, rank=8, style_shape_steps=20, low_steps=20, steps=20, is_mirrored=False, validation_share=0.2
        )
        pretrain(GARMENT, small_set, folder, settings=settings, config=SMALL, quiet=True)

    random_state = torch.get_rng_state()
    train(tmp_path / "whole")
    assert torch.equal(torch.get_rng_state(), random_state)

    real, calls = loop_module.save_checkpoint, 0

    def interrupted(*args: Any) -> None:
        nonlocal calls
        real(*args)
        calls += 1
        if calls in (1, 4):  # in the first stage, and in the second
            raise KeyboardInterrupt

    monkeypatch.setattr(loop_module, "save_checkpoint", interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "parts")
    with pytest.raises(RefuError, match="other settings or data"):
        train(tmp_path / "parts", seed=1)
    torch.manual_seed(123)
    train(tmp_path / "parts")
    whole, parts = weights(tmp_path / "whole"), weights(tmp_path / "parts")
    assert all(torch.equal(whole[k], parts[k]) for k in whole)
    lines = [(tmp_path / folder / "tailornet-none.jsonl").read_text() for folder in ("whole", "parts")]
    assert lines[0] == lines[1]
    train(tmp_path / "other", seed=1)
    assert any(not torch.equal(t, whole[k]) for k, t in weights(tmp_path / "other").items())


class Noisy(torch.nn.Module):
    """A parameter whose loss is random on its device, as dropout makes it."""

    def __init__(self, device: str) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(4, device=device))

    def forward(self, batch: Tensor) -> Tensor:
        return (self.weight * torch.rand_like(self.weight) - batch).square().sum()


def of_noise(stem: Path, device: str) -> Tensor:
    """The weights after nine steps, with three checkpoints."""
    model, settings = Noisy(device), LoopSettings(batch_size=2, check_every=3)
    loop = loop_module.Loop(model, settings, stem, 0, torch.device(device), quiet=True)
    loop.run(loop_module.TrainingStage("all", model, 9, (torch.ones(5, 4),)))
    return model.weight.detach().cpu()


def of_noise_resumed(stem: Path, device: str, patch: pytest.MonkeyPatch) -> Tensor:
    """The same, stopped at the first checkpoint."""
    real = loop_module.save_checkpoint
    patch.setattr(loop_module, "save_checkpoint", lambda *args: (real(*args), pytest.fail("stopped")))
    with pytest.raises(pytest.fail.Exception, match="stopped"):
        of_noise(stem, device)
    patch.setattr(loop_module, "save_checkpoint", real)
    return of_noise(stem, device)


@pytest.mark.usefixtures("no_curves")
@pytest.mark.parametrize(
    "device",
    ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU"))],
)
def test_random_numbers_go_on_where_they_were(tmp_path: Path, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints had the CPU's alone: on a GPU a resumed stage drew what its first steps had drawn."""
    assert torch.equal(of_noise_resumed(tmp_path / "parts", device, monkeypatch), of_noise(tmp_path / "whole", device))


@pytest.mark.usefixtures("no_curves")
def test_a_resumed_stage_sets_its_gpus_random_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state, told = torch.arange(3), []
    monkeypatch.setattr(loop_module, "_gpu_state", lambda _: {"gpu_rng": state})
    monkeypatch.setattr(loop_module, "_set_gpu_state", lambda device, saved: told.append((device.type, saved.tolist())))
    of_noise_resumed(tmp_path / "parts", "cpu", monkeypatch)
    assert told == [("cpu", [0, 1, 2])]


def test_a_checkpoint_has_the_random_numbers_of_its_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of a GPU, a generator of its own."""
    gpu, device = torch.Generator().manual_seed(5), torch.device("cuda", 1)
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda of: of == device and gpu.get_state())
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, of: of == device and gpu.set_state(state))
    saved = loop_module._gpu_state(device)["gpu_rng"]
    drawn = torch.rand(3, generator=gpu)
    loop_module._set_gpu_state(device, None)  # of a checkpoint that has none
    assert not torch.equal(torch.rand(3, generator=gpu), drawn)
    loop_module._set_gpu_state(torch.device("cpu"), saved)
    assert not torch.equal(torch.rand(3, generator=gpu), drawn)
    loop_module._set_gpu_state(device, saved)
    assert torch.equal(torch.rand(3, generator=gpu), drawn)
    assert loop_module._gpu_state(torch.device("cpu")) == {}


def test_low_frequency_targets_are_smoothed_garments(samples: TrainingSamples, garment: GarmentTemplate) -> None:
    from refu_core.backbones import TailorNet, build_backbone
    from refu_core.training._pretrain import low_frequency_code, pivots_of

    samples = samples.take(torch.arange(20))
    smooth = LaplacianSmoothing(garment)
    rest = garment.rest(samples.betas, samples.style)
    wanted = smooth(rest + samples.displacement) - rest
    for basis in (None, output_basis(wanted, rank=12)):
        net = build_backbone(SMALL, garment, basis=basis, pivots=pivots_of(samples, 20))
        assert isinstance(net, TailorNet)
        code = low_frequency_code(net, smooth, garment, samples)
        torch.testing.assert_close(code, net.decoder.encode(wanted), atol=2e-4, rtol=0)


@pytest.mark.usefixtures("no_curves")
def test_it_stops_when_nothing_gets_better(tmp_path: Path, small_set: Path) -> None:
    loop = replace(QUICK.loop, learning_rate=0.0, check_every=5, patience=2)
    settings = replace(QUICK, loop=loop, is_mirrored=False)
    pretrain(GARMENT, small_set, tmp_path, settings=settings, config=SMALL, quiet=True)
    entries = [json.loads(line) for line in (tmp_path / "tailornet-none.jsonl").read_text().splitlines()]
    assert max(entry["step"] for entry in entries) == 15


def test_bad_settings_and_files_are_refused(tmp_path: Path, small_set: Path) -> None:
    with pytest.raises(WeightsError, match="no backbone 'bert'"):
        pretrain(GARMENT, small_set, tmp_path, backbone="bert", quiet=True)
    (tmp_path / "x.checkpoint").write_bytes(b"PK\x03\x04nothing")
    with pytest.raises(WeightsError, match="damaged checkpoint"):
        load_checkpoint(tmp_path / "x.checkpoint")
    assert load_checkpoint(tmp_path / "none.checkpoint") is None
    (tmp_path / "file").touch()
    with pytest.raises(WeightsError, match="can't be written"):
        save_checkpoint(tmp_path / "file" / "x.checkpoint", {"step": 1})


def test_a_log_goes_on_where_its_run_was_interrupted(tmp_path: Path) -> None:
    log = TrainingLog(tmp_path, name="run", quiet=True)
    log.begin("a", step=0, steps=4)
    for step in (1, 2, 3):
        log.check("a", step, train=4.0 - step)
    again = TrainingLog(tmp_path, name="run", quiet=True)
    again.begin("a", step=2, steps=4)
    again.check("a", 3, train=0.5, validation=0.7)
    again.end()
    entries = [json.loads(line) for line in (tmp_path / "run.jsonl").read_text().splitlines()]
    assert [entry["train"] for entry in entries] == [3.0, 2.0, 0.5]
    assert again.picture.exists()


_PARALLEL = """
import sys, torch, torch._dynamo  # which each of the two would import for its optimiser
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from refu_core.backbones import MlpConfig
from refu_core.training import LoopSettings, PretrainSettings, TrainingLog, pretrain

TrainingLog.draw = lambda _: None

def train(dataset, folder):
    loop = LoopSettings(batch_size=16, weight_decay=0.01, check_every=10)
    settings = PretrainSettings(loop, rank=8, steps=20, is_mirrored=False, validation_share=0.2)
    config = MlpConfig((0, 1, 2, 4, 5), hidden=(24, 24), dropout=0.0)
    pretrain("short-pant-male", dataset, folder, backbone="mlp", settings=settings, config=config, quiet=True)

if __name__ == "__main__":
    torch.set_num_threads(1)
    config = LaunchConfig(1, 1, 2, rdzv_backend="c10d", rdzv_endpoint="localhost:0", start_method="fork")
    elastic_launch(config, train)(*sys.argv[1:])
"""
"""As `torchrun --standalone --nproc-per-node 2`, but of processes that have imported what this one has."""


@pytest.mark.skipif(not torch.distributed.is_available(), reason="this torch build has no torch.distributed")
@pytest.mark.usefixtures("no_curves")
def test_two_processes_make_the_training_of_one(tmp_path: Path, small_set: Path) -> None:
    script = tmp_path / "train.py"
    script.write_text(_PARALLEL)
    command = [sys.executable, str(script), str(small_set), str(tmp_path / "two")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    runpy.run_path(str(script))["train"](str(small_set), str(tmp_path / "one"))
    curves = [
        [json.loads(line) for line in next((tmp_path / folder).glob("*.jsonl")).read_text().splitlines()]
        for folder in ("one", "two")
    ]
    for alone, shared in zip(*curves, strict=True):
        assert {k: v for k, v in shared.items() if isinstance(v, (str, int))} == {
            k: v for k, v in alone.items() if isinstance(v, (str, int))
        }
        for name in ("train", "validation"):
            assert shared[name] == pytest.approx(alone[name], rel=2e-3)
    assert curves[0][-1]["train"] < curves[0][0]["train"]
    one, two = (load_weights(tmp_path / folder / "mlp-none").tensors for folder in ("one", "two"))
    assert set(one) == set(two)
    for name, tensor in one.items():
        torch.testing.assert_close(two[name].float(), tensor.float(), atol=3e-3, rtol=0)
