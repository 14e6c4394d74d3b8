"""Training of what cloth does on lying people, on top of a backbone that isn't told of more than half of a tilt."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refu_core import backbones as nets
from refu_core.body import SmplBody
from refu_core.errors import RefuError
from refu_core.garments import GarmentTemplate
from refu_core.simulation import GarmentDataset, GarmentSequences
from refu_core.training import _data as data
from refu_core.training._loop import Loop, LoopSettings, Objective, TrainingStage, is_writer, start_parallel
from refu_core.training._pretrain import code_loss
from refu_core.training._rehearsal import Rehearsal


@dataclass(frozen=True)
class LyingSettings:
    """How what lying does is trained."""

    loop: LoopSettings = field(default_factory=LoopSettings)
    steps: int = 3000
    rank: int = 32
    """Components of its own basis; with 64 or 128 a T-shirt comes no nearer."""
    validation_share: float = 0.15
    """Share held out for validation, as whole style-shape pairs."""


def train_lying(
    garment: str | GarmentTemplate,
    dataset: str | Path | GarmentDataset | GarmentSequences,
    folder: str | Path,
    *,
    rehearsal: Rehearsal,
    mode: str = "hybrid",
    settings: LyingSettings | None = None,
    body: SmplBody | None = None,
    device: str = "cpu",
    quiet: bool = False,
) -> dict[str, Any]:
    """Trains what lying adds to the garment's tailornet in `folder`, and writes `folder`/lying.

    Samples of people who don't lie are left out. If interrupted, the same call goes on from the last checkpoint.

    Args:
        folder: holds tailornet-<mode> and its basis, which are left as they are.
        rehearsal: bodies of the tailornet's plans. To those of them who bend or crawl nothing is added.
        mode: mode of the tailornet; modes that share a basis share this, too.
        settings: the default ones if not given.
        garment, dataset, body, device, quiet: as in `pretrain`.

    Returns:
        The card: what was trained on what, and its figures on test samples of lying people, beside the tailornet's.

    Raises:
        RefuError: the set is of another garment or body, has too few lying people or none to test on, or a checkpoint
            there is of another training.
        WeightsError: no tailornet there, or a damaged one.
    """
    opened = data.TrainingSet.of(garment, dataset, body, who=_lie)
    template, body, folder = opened.garment, opened.body, Path(folder)
    test = data.read_samples(opened.rows, body, template, split="test", who=_lie)
    samples = opened.samples
    if not len(samples) or not len(test):
        msg = f"wanted lying people to learn from and to test on, the set of {template.name} has {len(samples)} and "
        raise RefuError(f"{msg}{len(test)}: refu simulate --postures")
    upright, card_of_upright = opened.tailornet(folder, mode)
    settings = settings or LyingSettings()
    torch_device = start_parallel(device)
    train, validation = data.split_validation(samples, share=settings.validation_share, seed=settings.loop.seed)
    train = train.joined(data.mirrored(train, data.Mirror.of(template)))
    owed = [one.displacement - data.displacements(upright, one) for one in (train, validation)]
    # With both signs the mean is zero, so that nothing can be added.
    mean, components = data.principal_components(torch.cat((owed[0], -owed[0])), rank=settings.rank)
    decoder = nets.BasisDecoder(torch.zeros_like(mean), components)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.loop.seed)
        lying = nets.Lying(nets.LyingConfig(upright.config.joints), decoder)
    rehearsed = rehearsal.of(card_of_upright, upright, known=opened.card["plan"])
    rehearsed = rehearsed.take(_lie(rehearsed.pose))
    owed[0] = torch.cat((owed[0], torch.zeros_like(rehearsed.displacement)))
    parts = [
        (lying.seen(one.betas, one.pose, one.style), decoder.encode(added))
        for one, added in zip((train.joined(rehearsed), validation), owed, strict=True)
    ]
    groups = torch.cat((torch.zeros(3, dtype=torch.long), 1 + lying.features.groups))
    lying.net.standardise(parts[0][0], groups)
    described = {
        **opened.identity,
        "mode": mode,
        "tailornet_sha256": card_of_upright["sha256"],
        "settings": asdict(settings),
        "samples": len(train),
        "rehearsed": len(rehearsed),
    }
    loop = Loop(lying, settings.loop, folder / "lying", [described, asdict(lying.config)], torch_device, quiet=quiet)
    loop.run(TrainingStage("lying", Objective([lying], lying, code_loss(lying)), settings.steps, *parts))
    lying.to("cpu").eval()
    both: dict[str, nets.Backbone] = {"mpve_mm": nets.WithLying(upright, lying), "upright_mm": upright}
    figures = {name: data.mpve(data.displacements(one, test), test, body, template) for name, one in both.items()}
    card = {**described, "dataset": opened.card, "figures": {"samples": len(test), **figures}}
    if is_writer():
        nets.save_lying(folder, lying, card)
        loop.checkpoint.unlink(missing_ok=True)
    return card


def _lie(pose: Tensor) -> Tensor:
    """Which of some people (N, 24, 3) lie, or nearly, shape (N,)."""
    return nets.lying_share(nets.up_in_root(pose)) > 0
