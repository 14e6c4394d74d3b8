"""What `refu train` does: a backbone, then the backbone with ReFU; or the paper's network for the body's distance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, cast

from refu_core import RefuError, load_garment
from refu_core._device import checked_device
from refu_core.backbones import PRESETS
from refu_core.body import load_fit
from refu_core.garments import worn_on
from refu_core.options import check
from refu_core.refu import ScaleKind
from refu_core.sdf import SDF_PRESETS
from refu_core.simulation import GarmentDataset, GarmentSequences, open_dataset
from refu_core.training import (
    CarrySettings,
    DynamicsSettings,
    FinetuneSettings,
    PretrainSettings,
    SdfSettings,
    carry_over,
    finetune,
    pretrain,
    train_dynamics,
    train_sdf,
)
from refu_lab.commands.train import TrainOptions
from refu_lab.tables import format_table

Settings = TypeVar("Settings", CarrySettings, DynamicsSettings)


def train(options: TrainOptions, *, progress: bool) -> dict[str, Any]:
    """Trains; returns the card of what was trained last.

    A mode with ReFU starts from the backbone alone, which is trained first where the output folder has none; the gcnn
    starts from scratch in every mode, as in the paper's supplement.

    Raises `RefuError` for options that name nothing, and where training does.
    """
    _check(options)
    template = load_garment(options.garment)
    fit = load_fit(options.body or template.body)
    template, body = worn_on(template, fit), fit.body
    common: dict[str, Any] = {"device": options.device, "quiet": not progress}
    if options.network == "sdf":
        return train_sdf(
            GarmentDataset(options.data), body, template, options.folder, settings=_sdf_training(options), **common
        )
    dataset = open_dataset(options.data)
    if options.network == "dynamics":
        return train_dynamics(
            template,
            dataset,
            options.folder,
            mode=options.mode,
            settings=_asked(DynamicsSettings(), options),
            body=body,
            **common,
        )
    if options.like is not None:
        few = _asked(CarrySettings(), options)
        return carry_over(
            template, dataset, options.folder, like=options.like, settings=few, body=body, quiet=not progress
        )
    common |= {"backbone": options.backbone, "preset": options.preset, "body": body}
    if options.mode == "none":
        return pretrain(template, dataset, options.folder, settings=_pretraining(options, dataset), **common)
    source: Path | None = options.folder
    if options.start is not None:
        source = options.start
    elif options.backbone == "gcnn":
        source = None
    elif not (options.folder / f"{options.backbone}-none.json").exists():
        pretrain(template, dataset, options.folder, settings=_pretraining(options, dataset), **common)
    common |= {"settings": _finetuning(options), "goes_on": options.start is not None}
    return finetune(template, dataset, source, options.folder, mode=options.mode, **common)


def _check(options: TrainOptions) -> None:
    checked_device(options.device)
    if options.like is not None and (options.network, options.backbone, options.preset) != (
        "garment",
        "tailornet",
        "realtime",
    ):
        msg = "--like makes a tailornet of the preset realtime: leave --network, --backbone and --preset out"
        raise RefuError(msg)
    if options.start is not None and (options.mode == "none" or options.like is not None):
        msg = "--start goes on with a mode that has ReFU: leave --like and --mode none out"
        raise RefuError(msg)
    presets = SDF_PRESETS if options.network == "sdf" else PRESETS
    if options.preset not in presets:
        msg = f"no preset {options.preset!r} of training: wanted {', '.join(presets)}"
        raise RefuError(msg)
    check(options)


def _sdf_training(options: TrainOptions) -> SdfSettings:
    settings = replace(SdfSettings.of(options.preset), seed=options.seed)
    return settings if options.steps is None else replace(settings, steps=options.steps)


def _pretraining(options: TrainOptions, dataset: GarmentDataset | GarmentSequences) -> PretrainSettings:
    settings = PretrainSettings.of(options.backbone, options.preset, samples=int(dataset.train.sum()))
    settings = replace(settings, loop=replace(settings.loop, seed=options.seed))
    if options.steps is None:
        return settings
    return replace(settings, style_shape_steps=options.steps, low_steps=options.steps, steps=options.steps)


def _asked(settings: Settings, options: TrainOptions) -> Settings:
    """The settings with the seed and the steps that were asked for."""
    settings = replace(settings, loop=replace(settings.loop, seed=options.seed))
    return settings if options.steps is None else replace(settings, steps=options.steps)


def _finetuning(options: TrainOptions) -> FinetuneSettings:
    settings = FinetuneSettings.of(options.backbone, options.preset)
    settings = replace(settings, loop=replace(settings.loop, seed=options.seed))
    if options.scale == "fixed":
        settings = replace(settings, scale=None)
    else:
        settings = replace(settings, scale_kind=cast("ScaleKind", options.scale))
    if options.margin is not None:
        settings = replace(settings, margin=options.margin)
    if options.unblended:
        settings = replace(settings, is_blended=False)
    return settings if options.steps is None else replace(settings, steps=options.steps)


def training_table(card: dict[str, Any], options: TrainOptions) -> str:
    """What `refu train` prints."""
    rows = [(name, str(card[name])) for name in ("backbone", "mode", "preset", "like", "samples") if name in card]
    rows += [
        (name.replace("_", " "), f"{value:.3f}")
        for name, value in card.get("figures", {}).items()
        if isinstance(value, (int, float))
    ]
    return format_table((options.garment, str(options.folder)), rows)
