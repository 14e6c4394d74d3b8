"""Training of what motion does to a garment, on top of a backbone for cloth at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from refu_core.backbones import (
    BasisDecoder,
    Controls,
    Dynamics,
    DynamicsConfig,
    TailorNet,
    carried_dynamics,
    save_dynamics,
)
from refu_core.body import SmplBody
from refu_core.errors import RefuError
from refu_core.frames import SmplFrame
from refu_core.garments import GarmentTemplate, load_garment
from refu_core.history import PoseHistory
from refu_core.simulation import GarmentSequences
from refu_core.training import _data as data
from refu_core.training._carry import Carried, CarrySettings, borne_out, own_codes
from refu_core.training._loop import Loop, LoopSettings, Objective, TrainingStage, is_writer, seeded, start_parallel
from refu_core.training._loss import code_loss


@dataclass(frozen=True)
class DynamicsSettings:
    """How dynamics are trained."""

    loop: LoopSettings = field(default_factory=lambda: LoopSettings(weight_decay=0.3))
    steps: int = 3000
    noise: float = 0.05
    """Standard deviation of the noise added to each number of the past [1, m]. Without it the training set has nobody
    who stands still but is observed with a little noise, and cloth trembles: noise of 0.1 degrees in joints and 3 mm in
    the root shakes a skirt by 2.1 mm from frame to frame (0.7 without dynamics); with 0.01 by 1.1, with 0.03 by 0.7.
    The error on other sequences is 11.7, 11.7 and 11.8 mm (14.0 without dynamics); of a T-shirt's code
    it is 15.2 mm with 0.05 and with 0.1 (17.5)."""
    validation_share: float = 0.15
    """Share held out for validation, as whole sequences."""
    later_rate: float = 1e-4
    """Learning rate of dynamics that are carried over: a shirt's code is off by 16.29 mm, with 3e-4 and 3e-5 by
    16.36 and 16.32."""


class _Prepared(NamedTuple):
    """The data that the loop draws from."""

    features: Tensor
    """Features of the poses, shape (N, I)."""
    style_shape: Tensor
    """(β, γ), shape (N, 14)."""
    past: Tensor
    """Shape (N, 4, 219)."""
    code: Tensor
    """Code of the simulated cloth minus that of cloth at rest, shape (N, R)."""


def train_dynamics(
    garment: str | GarmentTemplate,
    datasets: data.Sets,
    folder: str | Path,
    *,
    mode: str = "hybrid",
    like: str | None = None,
    settings: DynamicsSettings | None = None,
    body: SmplBody | None = None,
    device: str = "cpu",
    quiet: bool = False,
) -> dict[str, Any]:
    """Trains what moving cloth does beyond the garment's tailornet in `folder`, and writes `folder`/dynamics.

    All else, and what is returned, is as in `pretrain`; figures stand beside those of the tailornet alone. Raises
    `RefuError` as that does, and for no set or one of samples at rest; `WeightsError` for no tailornet there, a damaged
    one, or no dynamics of `like`.

    Args:
        datasets: sets of simulated sequences (`refu simulate --sequences`), of plans with different seeds.
        folder: holds tailornet-<mode> and its basis, which are left as they are.
        mode: mode of the tailornet; modes that share one share the dynamics, too.
        like: a related garment whose dynamics ship: what they know is carried over first, and learning goes on there.
    """
    opened = data.TrainingSet.of(garment, datasets, body)
    template, body, samples, folder = opened.garment, opened.body, opened.samples, Path(folder)
    sets = [one for one in opened.sets if isinstance(one, GarmentSequences)]
    if len(sets) < len(opened.sets):
        raise RefuError(f"dynamics need sequences, got samples at rest: refu simulate {template.name} --sequences")
    test = opened.test()  # where no set is for the test, that is said before any work
    still, card_of_still = opened.tailornet(folder, mode)
    settings = settings or DynamicsSettings()
    torch_device = start_parallel(device)
    if like is None:
        with seeded(settings.loop.seed):
            dynamics = Dynamics(DynamicsConfig(still.config.joints), still)
    else:
        dynamics = _carried(like, still, samples, template, body)
        settings = replace(settings, loop=replace(settings.loop, learning_rate=settings.later_rate))
    mirror = data.Mirror.of(template)
    prepared = [_prepared(still, samples, _pasts(sets, "train"))]
    if mirror is not None:
        turned = data.mirrored(samples, mirror)
        prepared.append(_prepared(still, turned, _pasts(sets, "train", is_mirrored=True)))
    train, validation = _split(samples, prepared, settings)
    if like is None:
        dynamics.standardise(*train[:3], still.features.are_bounded(template))
    described = {
        **opened.identity,
        "mode": mode,
        **({} if like is None else {"start": like}),
        "tailornet_sha256": card_of_still["sha256"],
        "settings": asdict(settings),
        "samples": len(train.code),
    }
    identity = [described, asdict(dynamics.config)]
    loop = Loop(dynamics, settings.loop, folder / "dynamics", identity, torch_device, quiet=quiet)

    def predict(x: Tensor, s: Tensor, past: Tensor) -> Tensor:
        if dynamics.training:
            past = past + settings.noise * torch.randn_like(past)
        code: Tensor = dynamics(x, s, past)
        return code

    objective = Objective([dynamics], predict, code_loss(still))
    loop.run(TrainingStage("dynamics", objective, settings.steps, train, validation))
    dynamics.to("cpu").eval()
    figures = _figures(still, dynamics, test, _prepared(still, test, _pasts(sets, "test")), body, template)
    card = {**described, "datasets": opened.cards, "figures": figures}
    if is_writer():
        save_dynamics(folder, dynamics, card)
        loop.checkpoint.unlink(missing_ok=True)
    return card


def _carried(
    like: str, still: TailorNet, samples: data.TrainingSamples, garment: GarmentTemplate, body: SmplBody
) -> Dynamics:
    """The dynamics of a related garment, as far as the samples bear out that the cloth moves alike."""
    if not isinstance(still.decoder, BasisDecoder):
        raise RefuError(f"dynamics are carried over to a tailornet of the preset realtime: {garment.name}'s is another")
    settings = CarrySettings()
    carried = Carried(load_garment(like), garment, body, settings)
    here, controls = carried(samples.betas, samples.pose), Controls.spread(garment, settings.controls)
    share = borne_out(here, samples.displacement, controls)
    return carried_dynamics(like, own_codes(carried, share[:, None], like, still.decoder), still)


def _pasts(sets: Sequence[GarmentSequences], split: str, *, is_mirrored: bool = False) -> Tensor:
    """The past of every kept frame of a split's sequences, shape (N, 4, 219), in the order of `read_samples`."""
    found = []
    for sequence in (rows.sequence(row) for rows in sets for row in range(len(rows))):
        if sequence.split != split:
            continue
        poses, transl = sequence.pose, sequence.transl.astype(np.float64)
        if is_mirrored:
            poses, transl = data.mirror_pose(torch.as_tensor(poses)).numpy(), transl * (-1, 1, 1)
        frames = PoseHistory.told(
            SmplFrame(pose, transl=at, stamp_ns=round(1e9 * t / sequence.fps))
            for t, (pose, at) in enumerate(zip(poses, transl, strict=True))
        )
        found += [frame.past for frame, is_kept in zip(frames, sequence.kept, strict=True) if is_kept]
    return torch.as_tensor(np.stack([past for past in found if past is not None]))


@torch.no_grad()
def _prepared(still: TailorNet, samples: data.TrainingSamples, past: Tensor) -> _Prepared:
    def owed(pose: Tensor, style_shape: Tensor, displacement: Tensor) -> Tensor:
        return still.decoder.encode(displacement) - still.code(still.features(pose), style_shape)

    code = data.in_chunks(owed, samples.pose, samples.style_shape, samples.displacement)
    return _Prepared(data.in_chunks(still.features, samples.pose), samples.style_shape, past, code)


def _split(
    samples: data.TrainingSamples, prepared: Sequence[_Prepared], settings: DynamicsSettings
) -> tuple[_Prepared, _Prepared]:
    """Samples to learn from, mirrored ones included, and samples for validation."""
    which = replace(samples, displacement=torch.arange(len(samples)))  # sample numbers, to split those
    train, validation = data.split_validation(which, share=settings.validation_share, seed=settings.loop.seed)
    to_learn = [torch.cat([one[train.displacement] for one in both]) for both in zip(*prepared, strict=True)]
    return _Prepared(*to_learn), _Prepared(*(one[validation.displacement] for one in prepared[0]))


@torch.no_grad()
def _figures(
    still: TailorNet,
    dynamics: Dynamics,
    test: data.TrainingSamples,
    prepared: _Prepared,
    body: SmplBody,
    garment: GarmentTemplate,
) -> dict[str, Any]:
    """MPVE on the test sequences [mm]: with dynamics, without, and the least that the basis allows."""

    def predicted(pose: Tensor, style_shape: Tensor, owed: Tensor) -> Tensor:
        return still.decoder(still.code(still.features(pose), style_shape) + owed)

    moved = data.in_chunks(dynamics, *prepared[:3])
    owed = {"mpve_mm": moved, "still_mm": torch.zeros_like(moved), "basis_mm": prepared.code}
    garments = {name: data.in_chunks(predicted, test.pose, prepared.style_shape, code) for name, code in owed.items()}
    return {"samples": len(test), **{name: data.mpve(one, test, body, garment) for name, one in garments.items()}}
