"""Training of what cloth does in postures that a backbone doesn't know, on top of it: lying, legs apart, running."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refu_core import backbones as nets
from refu_core.body import SmplBody
from refu_core.errors import RefuError, printable
from refu_core.garments import GarmentTemplate
from refu_core.training import _data as data
from refu_core.training._loop import Loop, LoopSettings, Objective, TrainingStage, is_writer, seeded, start_parallel
from refu_core.training._loss import code_loss
from refu_core.training._rehearsal import Rehearsal, plans_of
from refu_core.weights import load_card, load_weights


@dataclass(frozen=True)
class BeyondSettings:
    """How a network for further postures is trained."""

    loop: LoopSettings = field(default_factory=LoopSettings)
    steps: int = 6000
    """With twice as many a skirt comes no nearer."""
    rank: int = 32
    """Components of its own basis; with 64 a skirt is 2 % nearer and the file twice as large, a T-shirt no nearer."""
    validation_share: float = 0.15
    """Share held out for validation, as whole style-shape pairs."""


def train_beyond(
    kind: str,
    garment: str | GarmentTemplate,
    datasets: data.Sets,
    folder: str | Path,
    *,
    rehearsal: Rehearsal,
    mode: str = "hybrid",
    settings: BeyondSettings | None = None,
    body: SmplBody | None = None,
    device: str = "cpu",
    quiet: bool = False,
) -> dict[str, Any]:
    """Trains what is added to the garment's tailornet in `folder` in postures of a kind, and writes `folder`/<kind>.

    Samples in other postures are left out. A network of that kind which was trained beside that tailornet is gone on
    with: what it adds to people of its plans is rehearsed. All else, and what is returned, is as in `pretrain`; figures
    stand beside those of the tailornet alone.

    Raises `RefuError` as that does, for no such kind, and for too few people in such postures to learn from or test on;
    `WeightsError` for no tailornet there, or for one of the two networks that is damaged.

    Args:
        kind: `lying`, `legs` for thighs apart or drawn up or back, or `heels` for lower legs raised behind.
        folder: holds tailornet-<mode> and its basis, which are left as they are.
        rehearsal: bodies of the tailornet's plans, and of those of a network that is gone on with. To those of them who
            are in such a posture nothing is added, or what that network adds. None is needed if `datasets` are of all
            these plans.
        mode: mode of the tailornet; modes that share a basis share this, too.
    """
    if kind not in nets.KINDS:
        raise RefuError(f"no kind of postures {printable(kind)}: wanted {', '.join(nets.KINDS)}")

    def who(pose: Tensor) -> Tensor:
        return nets.KINDS[kind].share(pose) > 0

    opened = data.TrainingSet.of(garment, datasets, body, who=who)
    template, body, folder = opened.garment, opened.body, Path(folder)
    test = opened.test(who=who)
    samples = opened.samples
    if not len(samples) or not len(test):
        msg = f"wanted people of the kind {kind} to learn from and to test on, the set of {template.name} has "
        raise RefuError(f"{msg}{len(samples)} and {len(test)}: refu simulate --postures")
    known, card_of_known = opened.tailornet(folder, mode)
    settings = settings or BeyondSettings()
    torch_device = start_parallel(device)
    train, validation = data.split_validation(samples, share=settings.validation_share, seed=settings.loop.seed)
    train = data.with_mirrored(train, data.Mirror.of(template))
    owed = [one.displacement - data.displacements(known, one) for one in (train, validation)]
    # With both signs the mean is zero, so that nothing can be added.
    both = torch.cat((owed[0], -owed[0]))
    controls = known.decoder.controls if isinstance(known.decoder, nets.BasisDecoder) else None
    if controls is None:
        mean, components = data.principal_components(both, rank=settings.rank)
    else:
        mean, components = data.smooth_components(both, controls, rank=settings.rank)
    decoder = nets.BasisDecoder(torch.zeros_like(mean), components, controls=controls)
    with seeded(settings.loop.seed):
        joints = tuple(dict.fromkeys((*known.config.joints, *nets.KINDS[kind].joints)))
        beyond = nets.Beyond(kind, nets.BeyondConfig(joints), decoder)
    earlier, its_card = _earlier(kind, template, folder, mode)
    its_plans = plans_of(its_card, known=opened.plans)
    plans = [*plans_of(card_of_known, known=opened.plans), *its_plans]

    def added(betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        if earlier is None:
            return torch.zeros(len(pose), template.n_vertices, 3)
        return earlier.decoder(earlier(earlier.seen(betas, pose, style)))

    rehearsed = train.take(torch.zeros(len(train), dtype=torch.bool))
    if plans or not plans_of(card_of_known, known=()):
        rehearsed = rehearsal.of({**opened.identity, "datasets": [{"plan": plan} for plan in plans]}, added)
        rehearsed = rehearsed.take(who(rehearsed.pose))
    owed[0] = torch.cat((owed[0], rehearsed.displacement))
    parts = [
        (beyond.seen(one.betas, one.pose, one.style), decoder.encode(wanted))
        for one, wanted in zip((train.joined(rehearsed), validation), owed, strict=True)
    ]
    beyond.standardise(parts[0][0])
    described = {
        **opened.identity,
        "mode": mode,
        "tailornet_sha256": card_of_known["sha256"],
        "settings": asdict(settings),
        "samples": len(train),
        "rehearsed": {"count": len(rehearsed), "plans": its_plans},
    }
    loop = Loop(beyond, settings.loop, folder / kind, [described, asdict(beyond.config)], torch_device, quiet=quiet)
    loop.run(TrainingStage(kind, Objective([beyond], beyond, code_loss(beyond)), settings.steps, *parts))
    beyond.to("cpu").eval()
    networks: dict[str, nets.Backbone] = {"mpve_mm": nets.WithBeyond(known, [beyond]), "without_mm": known}
    figures = {name: data.mpve(data.displacements(one, test), test, body, template) for name, one in networks.items()}
    card = {**described, "datasets": opened.cards, "figures": {"samples": len(test), **figures}}
    if is_writer():
        nets.save_beyond(folder, beyond, card)
        loop.checkpoint.unlink(missing_ok=True)
    return card


def _earlier(
    kind: str, garment: GarmentTemplate, folder: Path, mode: str
) -> tuple[nets.Beyond | None, Mapping[str, Any]]:
    """The network of a kind in a folder, and its card; None and an empty card if none goes with the tailornet there."""
    if not (folder / f"{kind}.json").exists():
        return None, {}
    card, tailornet = load_card(folder / kind), load_weights(folder / f"tailornet-{mode}")
    if card.get("tailornet_sha256") != tailornet.card["sha256"]:  # what it adds is added to another one
        return None, {}
    return nets.load_beyond(kind, tailornet, garment), card
