"""Pre-training of backbones on unposed displacements, before ReFU comes in (paper, Sec. 3.2; Patel et al. 2020)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refu_core import backbones as nets
from refu_core._files import write_file
from refu_core.body import JOINT_NAMES, SmplBody
from refu_core.errors import RefuError, WeightsError
from refu_core.frames import N_JOINTS
from refu_core.garments import GarmentTemplate
from refu_core.refu import refu_from_weights, refu_tensors
from refu_core.training import _data as data
from refu_core.training._loop import Loop, LoopSettings, Objective, TrainingStage, is_writer, seeded, start_parallel
from refu_core.training._loss import VertexError, code_loss, vertex_loss
from refu_core.training._rehearsal import Rehearsal, plans_of, symmetric
from refu_core.weights import load_weights

SOME = 1900
"""From this many samples on a tailornet is trained twice as long: with 1,933 of a T-shirt the test error is 10.69 mm
and not 10.83, with 3,853 it is 9.82 and not 10.15. Fewer weren't tried."""
MANY = 4000
"""From this many on it is regularised less, too. With 6,000 samples of shorts the validation error is 7.61 mm with
weight decay 1, 7.21 with 0.3, 7.18 with half the dropout, 7.04 with 0.1 (on the test split 6.68, 6.43, 6.39 and 6.36).
A T-shirt's 3,853 gain nothing, and 1,933 lose: 11.16 mm."""


@dataclass(frozen=True)
class PretrainSettings:
    """How a backbone is pre-trained; the defaults are those of the shipped weights (preset `realtime`)."""

    loop: LoopSettings = field(default_factory=LoopSettings)
    rank: int = 128
    """R, components of the output basis."""
    style_shape_steps: int = 800
    low_steps: int = 5000
    steps: int = 3000
    """Steps of the last stage, which is the only one for backbones other than the tailornet. Half of these and of the
    low-frequency net's steps leave a test error of 11.3 mm, all of them 11.1 (a T-shirt's 980 samples)."""
    is_joint: bool = True
    """Whether the high-frequency nets are trained through the mixture, on all samples and together with the
    low-frequency net, or each on its own pivot's samples, as in the original."""
    joint_rate: float = 0.3
    """Relative learning rate of a joint last stage: the low-frequency net is only fine-tuned there."""
    dropout: float | None = None
    """Dropout in a tailornet's low-frequency net, half that in high-frequency nets; None for the configuration's."""
    is_mirrored: bool = True
    """Whether mirror images are learnt from, too, if the garment is symmetric."""
    validation_share: float = 0.08

    @classmethod
    def of(cls, backbone: str, preset: str = "realtime", *, samples: int = 0) -> PretrainSettings:
        """A backbone's settings in a preset, for this many samples of a training split."""
        if preset == "paper":  # TailorNet's own
            loop = LoopSettings(batch_size=32, learning_rate=1e-4, weight_decay=1e-6, check_every=1000)
            return cls(loop, style_shape_steps=100_000, low_steps=300_000, steps=300_000, is_joint=False)
        if backbone == "tailornet" and samples >= SOME:
            loop = LoopSettings(weight_decay=0.1 if samples >= MANY else 1.0)
            return cls(loop, low_steps=10_000, steps=6000, dropout=0.05)
        # A gcnn's step costs many times that of a network with an output basis, and larger batches hardly help.
        return cls(LoopSettings(batch_size=32, learning_rate=5e-3, weight_decay=0.1)) if backbone == "gcnn" else cls()


def pretrain(
    garment: str | GarmentTemplate,
    datasets: data.Sets,
    output: str | Path,
    *,
    backbone: str = "tailornet",
    preset: str = "realtime",
    settings: PretrainSettings | Callable[[int], PretrainSettings] | None = None,
    config: nets.BackboneConfig | None = None,
    start: str | Path | None = None,
    mode: str = "none",
    joints: Sequence[int] = (),
    rehearsal: Rehearsal | None = None,
    body: SmplBody | None = None,
    device: str = "cpu",
    quiet: bool = False,
) -> dict[str, Any]:
    """Trains the backbone of one garment and writes `output`/basis and `output`/<backbone>-<mode>.

    A basis that is there already is used, so that all backbones and modes in a folder share it. If interrupted, the
    same call goes on from the last checkpoint. Under `torchrun` all processes share one training. Returns the card:
    what was trained on what, and its figures on the test split.

    Args:
        garment: name of a built-in garment, or a template.
        datasets: simulated set (`refu simulate`), of garments at rest or of sequences; or several of plans with
            different seeds. Pivots are those of the first. None to learn from what is rehearsed alone.
        output: folder of the weights, of the checkpoint while it is needed, and of the loss curves.
        backbone: `tailornet`, `mlp` or `gcnn`.
        preset: `realtime` or `paper`.
        settings: or what gives them for a number of samples; the backbone's own in the preset if not given.
        config: sizes of the network; the preset's if not given. A network that goes on from `start` keeps its own.
        start: folder of the weights and basis to go on from, by the last stage only; None to start from scratch.
        mode: mode of the weights in `start` to go on from, and of those written; a ReFU layer stays as it is.
        joints: numbers of further joints that the network sees from now on; at first they change nothing.
        rehearsal: what the network rehearses beside the new samples.
        body: the body that the set was simulated on; the garment's built-in one if not given.
        device: `cpu` or `cuda`.
        quiet: show no progress.

    Raises:
        RefuError: the set is of another garment or body or too small, or a checkpoint there is of another training.
        WeightsError: no such backbone or preset, or files in `output` are damaged or of another garment.
    """
    opened = data.TrainingSet.of(garment, datasets, body, may_be_empty=rehearsal is not None)
    template, body, samples, identity = opened.garment, opened.body, opened.samples, opened.identity
    test = opened.test()  # a missing test split is reported first
    if not isinstance(settings, PretrainSettings):
        most = len(samples) + (0 if rehearsal is None else rehearsal.most)
        settings = PretrainSettings.of(backbone, preset, samples=most) if settings is None else settings(most)
    if start is None and (rehearsal is not None or joints or mode != "none"):
        raise RefuError("there is nothing to go on from or to rehearse without weights to start from")
    torch_device, output = start_parallel(device), Path(output)
    stem = output / f"{backbone}-{mode}"
    mirror = data.Mirror.of(template) if settings.is_mirrored else None
    # Which pairs are held out mustn't depend on what is made of the samples afterwards.
    # A rehearsing network can't stray far: with none of 500 samples held out, shorts' last weights are 0.2 mm nearer.
    held_out = 0.0 if rehearsal is not None else settings.validation_share
    train, validation = data.split_validation(samples, share=held_out, seed=settings.loop.seed)
    train = data.with_mirrored(train, mirror)
    described = {**identity, "backbone": backbone, "preset": preset}
    described |= {"settings": asdict(settings), "samples": len(train)}
    stored = None
    if start is None:
        config = nets.backbone_config(backbone, template, preset=preset) if config is None else config
        if settings.dropout is not None and isinstance(config, nets.TailorNetConfig):
            config = replace(config, dropout=settings.dropout, high_dropout=2 * settings.dropout)
        basis = basis_of(output, opened, mirror, settings.rank) if nets.uses_basis(config, preset) else None
        with seeded(settings.loop.seed):
            model = nets.build_backbone(config, template, basis=basis, pivots=pivots_of(samples, opened.n_pivots))
    else:
        stored = load_weights(Path(start) / f"{backbone}-{mode}", expect=identity)
        model = nets.backbone_from_weights(stored, template)
        config = model.config
        described |= {"goes_on_from": stored.card["sha256"], "refu": stored.card.get("refu")}
        if rehearsal is not None:
            asked = model if mirror is None else symmetric(model, mirror)
            rehearsed = rehearsal.of(stored.card, asked, known=opened.plans)
            train = train.joined(rehearsed) if len(train) else rehearsed
            described["rehearsed"] = {"count": len(rehearsed), "plans": plans_of(stored.card, known=opened.plans)}
            for net in _of_pose(model):
                net.dropout = 0.0  # rehearsed targets have no noise: with dropout a T-shirt was off by 0.2 mm more
        if joints:
            tell_of(model, joints, train.pose)
            config = model.config
        bring_basis(Path(start), output, written=stem.name)
    loop = Loop(model, settings.loop, stem, [described, asdict(config)], torch_device, quiet=quiet)
    for stage in stages(model, train, validation, template, settings, goes_on=stored is not None):
        loop.run(stage)
    model.to("cpu").eval()
    card = {
        **described,
        "mode": mode,
        "datasets": opened.cards,
        "knows_limbs": opened.knows_limbs if stored is None or opened.sets else stored.card.get("knows_limbs", False),
    }
    if opened.sets:
        card["figures"] = data.backbone_figures(model, test, body, template, mean=samples.displacement.mean(0))
    if is_writer():
        refu = None if stored is None else refu_from_weights(stored)
        layer = None if refu is None else refu_tensors(refu, half=preset != "paper")
        nets.save_backbone(stem, model, card, others=layer, exact=preset == "paper")
        loop.checkpoint.unlink(missing_ok=True)
    return card


def basis_of(folder: Path, opened: data.TrainingSet, mirror: data.Mirror | None, rank: int) -> nets.BasisDecoder:
    """The folder's basis, made if there is none."""
    if (folder / "basis.json").exists():
        return nets.load_basis(folder, opened.garment, expect=opened.identity)[0]
    displacement = data.with_mirrored(opened.samples, mirror).displacement
    basis = data.output_basis(displacement, rank=rank)
    if is_writer():
        nets.save_basis(folder, basis, {**opened.identity, "samples": len(displacement), "set": opened.n_slots})
    return basis


def bring_basis(source: Path, target: Path, *, written: str) -> None:
    """Copies the output basis from `source` to `target`, where the weights that will be `written` need it.

    Raises `WeightsError` where other weights in `target` need the basis there, and where it can't be copied.
    """
    if not is_writer() or not (source / "basis.json").exists():
        return
    basis = load_weights(source / "basis")
    nets.require_basis(target, str(basis.card["sha256"]), written=(written,))
    for name in ("basis.safetensors", "basis.json"):
        if not (target / name).exists() or not (target / name).samefile(source / name):
            write_file(target / name, (source / name).read_bytes(), error=WeightsError)


def pivots_of(samples: data.TrainingSamples, n_pivots: int) -> Tensor:
    """(β, γ) of a set's pivots, its first `n_pivots` pairs, shape (K, 14); of as many other pairs if it has none."""
    pairs = [k for k in torch.unique(samples.pair).tolist() if k < n_pivots]
    pairs = pairs or torch.unique(samples.pair)[:n_pivots].tolist()
    return torch.stack([samples.style_shape[samples.pair == k][0] for k in pairs])


def stages(
    model: nets.Network,
    train: data.TrainingSamples,
    validation: data.TrainingSamples,
    garment: GarmentTemplate,
    settings: PretrainSettings,
    *,
    goes_on: bool = False,
) -> list[TrainingStage]:
    """The stages to train, in order; for a network that `goes_on`, the last one alone."""
    take_inputs(model, train, garment, widen=goes_on)
    if isinstance(model, nets.Gcnn):
        if not goes_on:
            mean = train.displacement.mean(0)
            model.mean.copy_(mean)
            model.scale.copy_((train.displacement - mean).std())
        parts = [(s.betas, s.pose, s.style, s.displacement) for s in (train, validation)]
        objective = Objective([model], model, vertex_loss)
        return [TrainingStage("all", objective, settings.steps, *parts)]
    decoder = model.decoder
    error = VertexError(decoder) if isinstance(decoder, nets.BasisDecoder) else None
    last, targets = (vertex_loss, decoder.encode) if error is None else (error, error.targets)
    inputs = [(model.features(s.pose), s.style_shape) for s in (train, validation)]
    whole = [(*given, targets(s.displacement)) for given, s in zip(inputs, (train, validation), strict=True)]
    if isinstance(model, nets.Mlp):
        return [TrainingStage("all", Objective([model.net], model.code, last), settings.steps, *whole)]
    joint = Objective([model.low, model.high], model.code, last)
    together = TrainingStage("joint", joint, settings.steps, *whole, rate=settings.joint_rate)
    if goes_on:
        return [together]

    loss = code_loss(model)
    codes = [data.in_chunks(decoder.encode, s.displacement, size=256) for s in (train, validation)]
    both = [(x, s, code) for (x, s), code in zip(inputs, codes, strict=True)]

    smooth = nets.LaplacianSmoothing(garment)
    coarse = [low_frequency_code(model, smooth, garment, s) for s in (train, validation)]
    drape = [(s, code) for _, s, code in both]
    low = [(x, s, code) for (x, s, _), code in zip(both, coarse, strict=True)]
    shape_net = model.style_shape
    found = [
        TrainingStage("style-shape", Objective([shape_net], shape_net, loss), settings.style_shape_steps, *drape),
        TrainingStage("low", Objective([model.low], model.low_code, loss), settings.low_steps, *low),
    ]
    if settings.is_joint:
        return [*found, together]
    fine = []
    for (x, s, code), low_code in zip(both, coarse, strict=True):
        own = (s[:, None] == model.pivots).all(-1)  # (N, K): which pivot each sample belongs to
        kept = own.any(1)
        fine.append((x[kept], own[kept].float(), (code - low_code)[kept]))
    return [*found, TrainingStage("high", Objective([model.high], model.high, loss), settings.steps, *fine)]


def tell_of(model: nets.Network, joints: Sequence[int], pose: Tensor) -> None:
    """Makes a network see further joints, without effect at first, in the range of the poses (N, 24, 3) [rad].

    Raises `RefuError` for joints that it sees already or that don't exist, and for a network of rotation vectors.
    """
    config, before = model.config, model.features.size
    others = [joint for joint in range(1, N_JOINTS) if joint not in config.joints]
    if config.encoding != "matrix":
        raise RefuError(f"a network that sees poses as {config.encoding} takes no further joints: train a new one")
    if len(set(joints)) < len(joints) or not set(joints) <= set(others):
        msg = f"wanted joints that the network isn't told of, each once ({', '.join(JOINT_NAMES[j] for j in others)}), "
        msg += f"got {', '.join(JOINT_NAMES[j] if 0 <= j < N_JOINTS else str(j) for j in joints)}"
        raise RefuError(msg)
    model.config = replace(config, joints=(*config.joints, *joints))
    model.features = nets.PoseFeatures(model.config.joints, config.encoding)
    further = model.features(pose)[:, before:]
    groups = torch.arange(further.shape[1]) // 9
    for net in _of_pose(model):
        net.take_in(further, groups, at=before)


def _of_pose(model: nets.Network) -> tuple[nets.Perceptron | nets.StackedPerceptrons, ...]:
    """The networks whose first inputs are pose features."""
    if isinstance(model, nets.TailorNet):
        return model.low, model.high
    return (model.head if isinstance(model, nets.Gcnn) else model.net,)


def take_inputs(model: nets.Network, train: data.TrainingSamples, garment: GarmentTemplate, *, widen: bool) -> None:
    """Standardises a network's inputs by the samples; to `widen` a trained one, only extends the range that it sees."""
    x, s = model.features(train.pose), train.style_shape
    seen = [(net, x if net is getattr(model, "high", None) else torch.cat((x, s), 1)) for net in _of_pose(model)]
    seen += [(model.style_shape, s)] if isinstance(model, nets.TailorNet) else []
    groups, bounded = model.features.groups, model.features.are_bounded(garment)
    for net, inputs in seen:
        n = inputs.shape[1]
        if widen:
            net.widen(inputs)
        elif net is getattr(model, "style_shape", None):
            net.standardise(inputs)
        else:
            net.standardise(inputs, groups[:n], is_bounded=bounded[:n])


def low_frequency_code(
    model: nets.TailorNet, smooth: nets.LaplacianSmoothing, garment: GarmentTemplate, samples: data.TrainingSamples
) -> Tensor:
    """Code of D_LF, shape (N, C): the smoothed garment minus its template (Patel et al. 2020)."""
    decoder = model.decoder
    if isinstance(decoder, nets.BasisDecoder):
        smoothed = smooth.transposed(decoder.components)

    def code(betas: Tensor, style: Tensor, displacement: Tensor) -> Tensor:
        rest = garment.rest(betas, garment.own(style))
        whole = rest + displacement
        if isinstance(decoder, nets.BasisDecoder):
            return whole.flatten(1) @ smoothed.T - (rest.flatten(1) + decoder.mean) @ decoder.components.T
        return decoder.encode(smooth(whole) - rest)

    return data.in_chunks(code, samples.betas, samples.style, samples.displacement)
