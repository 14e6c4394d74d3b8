"""Training with ReFU: of a pre-trained backbone (paper, Sec. 3.2), or from scratch (supplement, Sec. C)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refu_core import backbones as nets
from refu_core.body import SmplBody
from refu_core.errors import RefuError
from refu_core.garments import GarmentTemplate
from refu_core.modes import DEFAULT_MARGIN
from refu_core.refu import SCALE_PRESETS, Refu, ScaleKind, refu_tensors
from refu_core.training import _data as data
from refu_core.training._dresser import Dresser, Sdf, refu_loss
from refu_core.training._loop import Loop, LoopSettings, Objective, TrainingStage, is_writer, seeded, start_parallel
from refu_core.training._pretrain import PretrainSettings, basis_of, bring_basis, pivots_of, stages
from refu_core.weights import load_weights

_UNIT = 1e3
"""Factor on the loss, so that its curves show readable numbers. It makes no difference to Adam."""


_MODES: dict[str, tuple[Sdf, Sdf, float | None]] = {
    "approx": ("approx", "approx", 0.0),
    "accurate": ("accurate", "accurate", 1.0),
    "hybrid": ("approx", "accurate", 0.0),
    "collision-approx": ("approx", "approx", None),
    "collision-accurate": ("accurate", "accurate", None),
}
"""The distance in ReFU and in the loss, and ReFU's least scale; None without ReFU."""
FINETUNE_MODES: tuple[str, ...] = tuple(_MODES)
"""The paper's three settings: approximate or accurate distance everywhere; or hybrid, accurate in the loss and
approximate in ReFU. And its baseline, a collision loss without ReFU, with either distance."""


@dataclass(frozen=True)
class FinetuneSettings:
    """How a backbone is trained with ReFU; the defaults are those of the shipped weights."""

    loop: LoopSettings = field(
        default_factory=lambda: LoopSettings(batch_size=16, learning_rate=2e-4, weight_decay=0.1, check_every=100)
    )
    steps: int = 1000
    scale: str | None = "realtime"
    """Preset of the scale networks; None fixes α at 1."""
    scale_kind: ScaleKind = "vertex"
    """What α is predicted from: see `refu_core.refu.ScaleSettings`."""
    margin: float = DEFAULT_MARGIN
    """ε [m]."""
    is_blended: bool = True
    """Whether pushed vertices take their neighbourhood along in training, as they do at run time."""
    is_mirrored: bool = True
    validation_share: float = 0.08
    """The same share as in pre-training, so that the same samples are held out: see `split_validation`."""

    @classmethod
    def paper(cls) -> FinetuneSettings:
        """The paper's settings (Sec. 4.2): Adam with 1e-5, networks of 1024, ε = 0, no blending."""
        loop = LoopSettings(batch_size=32, learning_rate=1e-5, weight_decay=0.0, check_every=1000)
        return cls(loop, steps=100_000, scale="paper", margin=0.0, is_blended=False, is_mirrored=False)

    @classmethod
    def of(cls, backbone: str, preset: str = "realtime") -> FinetuneSettings:
        """A backbone's settings in a preset. The gcnn starts from scratch, so steps and rates are as in `pretrain`."""
        if preset == "paper":
            return cls.paper()
        alone = PretrainSettings.of(backbone)
        return cls(alone.loop, steps=alone.steps) if backbone == "gcnn" else cls()


def finetune(
    garment: str | GarmentTemplate,
    datasets: data.Sets,
    weights: str | Path | None,
    output: str | Path,
    *,
    mode: str = "hybrid",
    backbone: str = "tailornet",
    preset: str = "realtime",
    settings: FinetuneSettings | None = None,
    body: SmplBody | None = None,
    device: str = "cpu",
    quiet: bool = False,
) -> dict[str, Any]:
    """Trains a backbone together with ReFU and writes `output`/<backbone>-<mode>; returns the card.

    All else is as in `pretrain`. Raises as that does, `RefuError` for no such mode, and `WeightsError` for weights that
    are missing, damaged or of another garment.

    Args:
        weights: folder with <backbone>-none and its basis, as `pretrain` wrote them; None to train from scratch, as the
            supplement does with the gcnn.
        output: folder of the weights, of the checkpoint while it is needed, and of the loss curves; may be `weights`.
        mode: one of `FINETUNE_MODES`.
        preset: `realtime` or `paper`, of ReFU and of a backbone from scratch.
    """
    if mode not in _MODES:
        raise RefuError(f"no mode {mode!r} of training: wanted {', '.join(FINETUNE_MODES)}")
    in_refu, in_loss, least = _MODES[mode]
    settings = settings or FinetuneSettings.of(backbone, preset)
    opened = data.TrainingSet.of(garment, datasets, body)
    template, body, samples, identity = opened.garment, opened.body, opened.samples, opened.identity
    torch_device, output = start_parallel(device), Path(output)
    stem = output / f"{backbone}-{mode}"
    train, validation = data.split_validation(samples, share=settings.validation_share, seed=settings.loop.seed)
    if settings.is_mirrored:
        train = data.with_mirrored(train, data.Mirror.of(template))
    network: nets.Network
    with seeded(settings.loop.seed):
        if weights is None:
            config = nets.backbone_config(backbone, template, preset=preset)
            basis = basis_of(output, opened, None, PretrainSettings().rank) if nets.uses_basis(config, preset) else None
            network = nets.build_backbone(config, template, basis=basis, pivots=pivots_of(samples, opened.n_pivots))
            # Called because it sets the scale of inputs and outputs; the stages themselves aren't run.
            stages(network, train, validation, template, PretrainSettings())
        else:
            stored = load_weights(Path(weights) / f"{backbone}-none", expect=identity)
            network = nets.backbone_from_weights(stored, template)
            bring_basis(Path(weights), output, written=stem.name)
        refu = None if least is None else _layer(least, settings, template.n_vertices)
    described = {**identity, "backbone": backbone, "preset": preset, "mode": mode, "settings": asdict(settings)}
    described |= {"samples": len(train), "from_scratch": weights is None}
    garment, there = template.to(device=torch_device), body.to(device=torch_device)
    dresser = Dresser(network, refu, garment, there, in_refu, in_loss, is_blended=settings.is_blended)
    loop = Loop(dresser, settings.loop, stem, described, torch_device, quiet=quiet)

    def loss(dressed: Tensor, truth: Tensor) -> Tensor:
        """Of garments with their distance, (B, N, 4), against the true garments, (B, N, 3) [m]."""
        return _UNIT * refu_loss(dressed[..., :3], truth, dressed[..., 3])

    objective = Objective([dresser], dresser, loss)
    parts = [_tensors(part, body, template) for part in (train, validation)]
    loop.run(TrainingStage("refu", objective, settings.steps, *parts))
    dresser.to("cpu").eval()
    card = described | {"refu": refu.config if refu else None, "datasets": opened.cards}
    card["knows_limbs"] = opened.knows_limbs
    if is_writer():
        others = None if refu is None else refu_tensors(refu, half=preset != "paper")
        nets.save_backbone(stem, network, card, others=others, exact=preset == "paper")
        loop.checkpoint.unlink(missing_ok=True)
    return card


@torch.no_grad()
def _tensors(samples: data.TrainingSamples, body: SmplBody, garment: GarmentTemplate) -> tuple[Tensor, ...]:
    """The data that the loop draws from: β, θ, γ and the posed true garments [m], shape (N, V, 3)."""
    along = data.TakenAlong(body, garment)

    def posed(displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        rest = garment.rest(betas, garment.own(style))
        whole = along.added(1, displacement, betas, pose, style)
        return garment.pose(rest + whole, body(pose, betas).transforms)

    inputs = samples.betas, samples.pose, samples.style
    whole = data.in_chunks(posed, samples.displacement, *inputs) if len(samples) else samples.displacement
    return *inputs, whole


def _layer(least: float, settings: FinetuneSettings, n_vertices: int) -> Refu:
    if settings.scale is not None and settings.scale not in SCALE_PRESETS:
        msg = f"no preset {settings.scale!r} of the scale networks: wanted {', '.join(SCALE_PRESETS)} or None"
        raise RefuError(msg)
    return Refu(
        n_vertices,
        least=least,
        scale=None if settings.scale is None else replace(SCALE_PRESETS[settings.scale], kind=settings.scale_kind),
        margin=settings.margin,
    )
