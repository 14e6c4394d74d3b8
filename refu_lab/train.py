"""What `refu train` does: a backbone, then the backbone with ReFU; or the paper's network for the body's distance."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from refu_core import RefuError, load_garment, training
from refu_core._device import checked_device
from refu_core._files import exclusive
from refu_core.backbones import KINDS, PRESETS
from refu_core.body import JOINT_NAMES, load_fit
from refu_core.errors import printable
from refu_core.garments import worn_on
from refu_core.options import check
from refu_core.sdf import SDF_PRESETS
from refu_core.simulation import GarmentDataset, GarmentSequences, load_clips, open_dataset
from refu_lab.commands.train import TrainOptions
from refu_lab.tables import format_table


def train(options: TrainOptions, *, progress: bool) -> dict[str, Any]:
    """Trains networks; returns the card of what was trained last.

    A mode with ReFU starts from the backbone alone, which is trained first if the output folder has none. The gcnn
    starts from scratch in every mode, as in the paper's supplement.

    Raises `RefuError` for invalid options, for a folder that another run writes to, and whenever training does.
    """
    _check(options)
    opening = GarmentDataset if options.network == "sdf" else open_dataset
    datasets = [opening(path) for path in options.data]
    folder = options.folder
    folder.mkdir(parents=True, exist_ok=True)
    if os.environ.get("RANK", "0") != "0":  # under torchrun, whose first process holds the lock
        return _train(options, datasets, progress=progress)
    busy = RefuError(f"{folder}: another training writes here; wait for it, or give another --output")
    with exclusive(folder / "lock", error=busy):
        return _train(options, datasets, progress=progress)


def _train(
    options: TrainOptions, datasets: Sequence[GarmentDataset | GarmentSequences], *, progress: bool
) -> dict[str, Any]:
    template = load_garment(options.garment)
    fit = load_fit(options.body or template.body)
    template, body = worn_on(template, fit), fit.body
    steps: dict[str, Any] = {} if options.steps is None else {"steps": options.steps}
    common: dict[str, Any] = {"device": options.device, "quiet": not progress}
    if options.network == "sdf":
        dataset = datasets[0]
        assert isinstance(dataset, GarmentDataset)  # `train` has opened it as one
        to_sdf = replace(training.SdfSettings.of(options.preset), seed=options.seed, **steps)
        return training.train_sdf(dataset, body, template, options.folder, settings=to_sdf, **common)
    common["body"] = body
    given = template, datasets, options.folder
    motions = options.motions and load_clips(options.motions, axes=options.input_axes, fps=options.fps)
    rehearsal = None
    if options.rehearse is not None:
        rehearsal = training.Rehearsal(options.rehearse, motions, further=options.further)
    if options.network == "dynamics":
        common |= {"mode": options.mode, "like": options.like}
        moving = _seeded(training.DynamicsSettings(), options, **steps)
        return training.train_dynamics(*given, settings=moving, **common)
    if options.network in KINDS:
        assert rehearsal is not None  # `_check` has seen to it
        beyond = _seeded(training.BeyondSettings(), options, **steps)
        common |= {"mode": options.mode, "rehearsal": rehearsal, "settings": beyond}
        return training.train_beyond(options.network, *given, **common)
    if options.like is not None:
        few = _seeded(training.CarrySettings(), options, **steps)
        return training.carry_over(*given, like=options.like, settings=few, body=body, quiet=not progress)
    common |= {"backbone": options.backbone, "preset": options.preset}
    of_all = {} if options.steps is None else dict.fromkeys(("style_shape_steps", "low_steps", "steps"), options.steps)

    def first(samples: int) -> Any:
        whole = training.PretrainSettings.of(options.backbone, options.preset, samples=samples)
        return _seeded(whole, options, **of_all)

    if options.start is not None:
        common |= {"start": options.start, "mode": options.mode, "joints": _numbers(options.joints)}
        return training.pretrain(*given, settings=first, rehearsal=rehearsal, **common)
    if options.mode == "none":
        return training.pretrain(*given, settings=first, **common)
    source: Path | None = options.folder
    if options.backbone == "gcnn":
        source = None
    elif not (options.folder / f"{options.backbone}-none.json").exists():
        training.pretrain(*given, settings=first, **common)
    changes: dict[str, Any] = {"scale": None} if options.scale == "fixed" else {"scale_kind": options.scale}
    changes |= {} if options.margin is None else {"margin": options.margin}
    changes |= {"is_blended": False} if options.unblended else {}
    last = _seeded(training.FinetuneSettings.of(options.backbone, options.preset), options, **changes, **steps)
    return training.finetune(template, datasets, source, options.folder, mode=options.mode, settings=last, **common)


def _check(options: TrainOptions) -> None:
    checked_device(options.device)
    is_plain = (options.network, options.backbone, options.preset) == ("garment", "tailornet", "realtime")
    changed = options.scale, options.margin, options.unblended, options.network, options.preset
    is_changed = changed != ("vertex", None, False, "garment", "realtime")
    presets = SDF_PRESETS if options.network == "sdf" else PRESETS
    learns_from_weights = options.network == "garment" and options.start is not None and options.rehearse is not None
    refused = {
        "give --data, a set of refu simulate; what weights know alone is learnt with --start and --rehearse": (
            not options.data and not learns_from_weights
        ),
        "the distance's network learns from one set of --data": len(options.data) > 1 and options.network == "sdf",
        "--like makes a tailornet of the preset realtime, or dynamics: leave --backbone, --preset and others out": (
            options.like is not None and options.network != "dynamics" and not is_plain
        ),
        "--like trains networks of its own: leave --start out": options.like is not None and options.start is not None,
        "--start goes on with networks as they are: leave --scale, --margin, --unblended, --network and --preset out": (
            options.start is not None and is_changed
        ),
        "what cloth does in such postures is learnt beside what others' does: give --rehearse N, 8000 for instance": (
            options.network in KINDS and options.rehearse is None
        ),
        f"no preset {options.preset!r} of training: wanted {', '.join(presets)}": options.preset not in presets,
    }
    for msg, is_so in refused.items():
        if is_so:
            raise RefuError(msg)
    check(options)


def _numbers(joints: Sequence[str]) -> list[int]:
    unknown = [name for name in joints if name not in JOINT_NAMES]
    if unknown:
        raise RefuError(f"no joint {printable(unknown[0])}: wanted some of {', '.join(JOINT_NAMES)}")
    return [JOINT_NAMES.index(name) for name in joints]


def _seeded(settings: Any, options: TrainOptions, **changes: Any) -> Any:
    return replace(settings, loop=replace(settings.loop, seed=options.seed), **changes)


def training_table(card: dict[str, Any], options: TrainOptions) -> str:
    named = [name for name in ("backbone", "mode", "preset", "like") if name in card]
    rows: list[tuple[str, str]] = [(name, str(card[name])) for name in named]
    # Mirrored ones count, too, where they were learnt from.
    rows += [("training samples", str(card["samples"]))] if "samples" in card else []
    for name, value in card.get("figures", {}).items():
        if isinstance(value, int):
            rows.append((f"test {name}", str(value)))
        elif isinstance(value, float):
            rows.append((name.replace("_", " "), f"{value:.3f}"))
    return format_table((options.garment, str(options.folder)), rows)
