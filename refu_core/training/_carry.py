"""Networks from few samples: those of a related garment, carried over, and what the samples add to them.

A network learns little from a hundred simulated samples alone. But a T-shirt of another cut, on another body, falls
much like the one whose networks learnt from a thousand. Where it lies near that one, it moves as that one does, as far
as the samples bear that out. The rest is interpolated between the samples. A small net learns both.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core import backbones as nets
from refu_core.body import SmplBody, load_fit
from refu_core.errors import RefuError
from refu_core.frames import N_BETAS
from refu_core.garments import N_STYLES, GarmentTemplate, load_garment, worn_on
from refu_core.modes import SdfMode
from refu_core.simulation import random_pose
from refu_core.training import _data as data
from refu_core.training._loop import Loop, LoopSettings, Objective, TrainingStage, seeded
from refu_core.training._loss import code_loss
from refu_core.weights import load_weights, save_weights, weights_folder

_DOUBT = 0.1
"""Damps what is carried over where it varies by less than about this share of its mean variation."""
BASE = SdfMode.HYBRID
"""The mode whose file has the network; the other modes' files only refer to it."""


@dataclass(frozen=True)
class CarrySettings:
    """How networks are carried over."""

    loop: LoopSettings = field(default_factory=lambda: LoopSettings(weight_decay=0.01, check_every=500))
    rank: int = 96
    """Components of the output basis. Those of 230 samples of a T-shirt are 5.6 mm off unseen ones; 48 are 7.3 mm."""
    controls: int = 400
    """Vertices at which the basis is stored."""
    hidden: tuple[int, ...] = (256, 256)
    """Hidden layers of the net."""
    poses: int = 16_000
    """Bodies that the net learns from beside the samples. What it is taught is 10.4 mm off a T-shirt's unseen samples,
    and itself 10.7 mm; with (128, 128) 11.0, and with 4,000 bodies and 3,000 steps 11.6."""
    steps: int = 10_000
    reach: float = 0.05
    """Cloth nearer than this to the related garment, both in the T-pose, is moved as that garment is [m]."""
    fade: float = 0.05
    """Distance beyond `reach` over which it ends [m]. A dress led by a skirt up to 45 mm away errs by 24 mm, not 18."""
    hem: float = 0.12
    """Within this of the related garment's hem its influence fades out [m], where the other garment goes on."""
    jitter: float = 0.15
    """Standard deviation by which poses of the set are varied [rad]."""
    length: float = 5.0
    """How far samples reach: at this distance between inputs the kernel is at 0.48. Half of all samples are 2 to 3.5
    apart. With 4 and 6 a T-shirt's error changes by 0.1 mm, and that of trousers by 0.2 mm."""
    shape_scale: float = 0.2
    """One unit of β, where an entry of a rotation matrix counts 1. With 0.1 and 0.3 it is 0.2 mm at most."""
    ridge: float = 0.03
    """Variance of what inputs don't tell, relative to that of what they do. With 0.01 and 0.1 it is 0.2 mm at most."""

    def __post_init__(self) -> None:
        """Raises `RefuError` for sizes that make no network."""
        if min(self.rank, self.poses, self.steps, *self.hidden) < 1 or not min(self.length, self.ridge) > 0:
            raise RefuError(f"rank, poses, steps, layers, length and ridge must be above zero, got {self}")


class Carried:
    """What the networks of one garment predict, applied to another.

    Cloth is moved and posed as the related garment is where the two lie near each other, with that garment's skinning
    weights: a displacement makes sense only with the weights that pose it. With the other garment's own weights, a hem
    that hangs 100 mm off a person who bends would end up elsewhere, within reach of the hands.
    """

    def __init__(
        self, related: GarmentTemplate, garment: GarmentTemplate, body: SmplBody, settings: CarrySettings
    ) -> None:
        """For `garment` on its `body`. Raises `WeightsError` when no networks of `related` ship."""
        self.network = nets.load_backbone("tailornet", related, mode=SdfMode.HYBRID)
        fit = None if garment.body == related.body else load_fit(garment.body)
        self._betas = None if fit is None else fit.difference(related.body).betas
        worn = worn_on(related, fit)
        vertices = garment.v_template.double().numpy()
        nearest, place, distance = data.SurfaceMixture.nearest(worn, vertices)
        share = _smooth((settings.reach + settings.fade - distance) / settings.fade)
        # Trousers go on where shorts end: if they followed the hem that swings there, they would have a step.
        ends = _from_rim(worn, place)
        goes_on = _smooth((_from_rim(garment, vertices) - ends) / settings.hem)
        share *= 1 - goes_on * _smooth(1 - ends / settings.hem)
        self.mixed = data.SurfaceMixture(nearest.corners, nearest.weights * torch.as_tensor(share)[:, None])
        """Carries displacements over, before they are posed."""
        self._garment, self._body = garment, body
        kept = torch.as_tensor(1 - share, dtype=torch.float32)[:, None]
        self._posed_as = replace(garment, weights=self.mixed(worn.weights[None])[0] + kept * garment.weights)

    @torch.no_grad()
    def __call__(self, betas: Tensor, pose: Tensor) -> Tensor:
        """Displacements of the other garment [m], (B, V, 3), for its betas (B, 10) and poses (B, 24, 3) [rad]."""

        def one(betas: Tensor, pose: Tensor) -> Tensor:
            known = betas if self._betas is None else self._betas(betas).float()
            there = self.network(known, pose, None)
            assert there is not None  # a network was asked for
            rest, transforms = self._garment.rest(betas), self._body(pose, betas).transforms
            posed = self._posed_as.pose(rest + self.mixed(there), transforms)
            return self._garment.unpose(posed, transforms) - rest

        return data.in_chunks(one, betas, pose, size=32)


def _smooth(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smoothstep of shares cut off at 0 and 1: from 0 to 1, level at both ends."""
    cut: NDArray[np.float64] = np.clip(share, 0, 1)
    return cut * cut * (3 - 2 * cut)


def _from_rim(garment: GarmentTemplate, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far `points` (P, 3) are from the nearest hem of a garment [m], shape (P,)."""
    hem = garment.v_template.double().numpy()[np.unique(garment.mesh.boundary)]
    return np.asarray(cKDTree(hem).query(points)[0])


def carry_over(
    garment: str | GarmentTemplate,
    datasets: data.Sets,
    output: str | Path,
    *,
    like: str,
    settings: CarrySettings | None = None,
    body: SmplBody | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Makes a garment's networks from those of a related one and few samples; writes `output`/basis and all modes.

    Fifty samples are enough to be useful. `like` is the name of the related garment, one whose networks ship. All else,
    and what is returned, is as in `pretrain`. Raises `RefuError` for a set of another garment or body, or a too small
    one, `GarmentError` for no such related garment, and `WeightsError` where no networks of it ship.
    """
    settings, output = settings or CarrySettings(), Path(output)
    nets.require_basis(output, None, written=[f"tailornet-{mode}" for mode in SdfMode])
    opened = data.TrainingSet.of(garment, datasets, body)
    template, body = opened.garment, opened.body
    test = opened.test()
    carried = Carried(load_garment(like), template, body, settings)
    samples = data.with_mirrored(opened.samples, data.Mirror.of(template))
    controls = nets.Controls.spread(template, settings.controls)
    here = carried(samples.betas, samples.pose)
    share = borne_out(here, samples.displacement, controls)[:, None]
    drawn = _bodies(opened.samples, settings)
    # As many of each: the folds of the samples need components of their own.
    there = share * carried(*(values[: len(samples)] for values in drawn))
    both = torch.cat((samples.displacement, there))
    basis = nets.BasisDecoder(*data.smooth_components(both, controls, rank=settings.rank), controls=controls)
    described = {**opened.identity, "samples": len(samples), "simulated": len(opened.samples), "like": like}
    nets.save_basis(output, basis, {**described, "set": opened.n_slots})

    config = nets.TailorNetConfig(template.card.joints, low=settings.hidden, high=(), style_shape=(), dropout=0.0)
    with seeded(settings.loop.seed):
        model = nets.build_backbone(config, template, basis=basis, pivots=torch.zeros(1, N_BETAS + N_STYLES))
    assert isinstance(model, nets.TailorNet)
    with torch.no_grad():  # the low-frequency net learns it all
        for parameter in (*model.style_shape.parameters(), *model.high.parameters()):
            parameter.zero_()
    encode = model.decoder.encode
    known, of_known = (samples.betas, samples.pose), data.in_chunks(encode, share * here, size=256)
    left = data.in_chunks(encode, samples.displacement, size=256) - of_known
    remainder = _Remainder(model.features, samples, left, settings)

    def code(betas: Tensor, pose: Tensor) -> Tensor:
        return encode(share * carried(betas, pose)) + remainder(betas, pose)

    taught = (*drawn, data.in_chunks(code, *drawn, size=256)), (*known, of_known + remainder(*known))
    stage = _of_bodies(model, template, settings.steps, *taught)
    identity = [described, asdict(settings)]
    loop = Loop(model, settings.loop, output / "carried", identity, torch.device("cpu"), quiet=quiet)
    loop.run(stage)
    loop.checkpoint.unlink(missing_ok=True)
    model.eval()

    card = {
        **described,
        "backbone": "tailornet",
        "preset": "realtime",
        "settings": asdict(settings),
        "datasets": opened.cards,
        "figures": {
            **data.backbone_figures(model, test, body, template, mean=samples.displacement.mean(0)),
            "carried_mm": data.mpve(carried(test.betas, test.pose), test, body, template),
            "borne_out": round(float(share.mean()), 3),
        },
    }
    base = f"tailornet-{BASE}"
    nets.save_backbone(output / base, model, {**card, "mode": str(BASE)})
    stored = load_weights(output / base).card
    for mode in SdfMode:
        if mode is not BASE:
            own = {key: stored[key] for key in ("config", "basis_sha256")}
            save_weights(output / f"tailornet-{mode}", {}, {**card, **own, "mode": str(mode)}, base=base)
    codes = own_codes(carried, share, like, basis)
    nets.save_carried_dynamics(output, like, codes, {**described, "mode": str(BASE)})
    return {**card, "mode": str(BASE)}


def own_codes(carried: Carried, share: Tensor, like: str, decoder: nets.BasisDecoder) -> Tensor:
    """What turns codes of the garment `like`, (C',), into codes (C,), shape (C, C'), for cloth that moves from rest.

    `share` (V, 1) of each is carried over. Skinning weights are left out: moving cloth is centimetres from where it
    rests, which itself has been posed with those of the related garment.
    """
    related, _ = nets.load_basis(weights_folder(like), load_garment(like), expect={"garment": like})
    components = related.components.view(related.size, -1, 3)
    return decoder.components @ (share * carried.mixed(components)).flatten(1).T


def borne_out(carried: Tensor, truth: Tensor, controls: nets.Controls) -> Tensor:
    """How much of what is carried over (N, V, 3) varies as the truth does, from 0 to 1, smoothly over the cloth, (V,).

    A sleeve moves as the related garment's does; a hem that is cut wider may not. It is found by least squares in each
    neighbourhood.
    """
    carried, truth = carried - carried.mean(0), truth - truth.mean(0)
    common, own = (carried * truth).sum((0, 2)), (carried * carried).sum((0, 2))
    field = controls.matrix()
    near = field.clamp_min(0).T / field.clamp_min(0).sum(0)[:, None]
    least = _DOUBT * own.mean() + torch.finfo(own.dtype).tiny
    return (field @ ((near @ common) / (near @ own + least))).clamp(0, 1)


def _bodies(samples: data.TrainingSamples, settings: CarrySettings) -> tuple[Tensor, Tensor]:
    """β (P, 10) and θ (P, 24, 3) [rad] to query a network at: poses near the set's, and any that joints allow."""
    rng = np.random.default_rng(settings.loop.seed)
    known = samples.pose.numpy()[rng.integers(len(samples), size=settings.poses)]
    known = known + rng.normal(0, settings.jitter, known.shape)
    drawn = np.stack([random_pose(rng) for _ in range(settings.poses)])
    pose = np.where((rng.random(settings.poses) < 0.5)[:, None, None], known, drawn)
    betas = rng.normal(0, 1.2, (settings.poses, N_BETAS)).clip(-2, 2)
    return torch.as_tensor(betas, dtype=torch.float32), torch.as_tensor(pose, dtype=torch.float32)


class _Remainder:
    """What samples say beyond what is carried over, at any pose and shape: the mean of a Gaussian process.

    Its kernel is Matérn's of ν = 3/2. A linear function of the pose in its place leaves trousers at 8.4 mm instead of
    6.7, and a T-shirt at 11.0 instead of 10.7 (unseen motions, 333 and 230 samples).
    """

    def __init__(
        self, features: nets.PoseFeatures, samples: data.TrainingSamples, left: Tensor, settings: CarrySettings
    ) -> None:
        """Of samples (N) with the codes (N, C) that are `left`."""
        self._features, self._settings = features, settings
        self._known, self._mean = self._inputs(samples.betas, samples.pose), left.mean(0)
        noise = settings.ridge * torch.eye(len(left), dtype=torch.float64)
        self._weights: Tensor = torch.linalg.solve(self._kernel(self._known) + noise, (left - self._mean).double())

    def __call__(self, betas: Tensor, pose: Tensor) -> Tensor:
        """Codes (B, C) for β (B, 10) and θ (B, 24, 3) [rad]."""
        return (self._kernel(self._inputs(betas, pose)) @ self._weights).float() + self._mean

    def _inputs(self, betas: Tensor, pose: Tensor) -> Tensor:
        return torch.cat((self._features(pose), self._settings.shape_scale * betas), 1).double()

    def _kernel(self, inputs: Tensor) -> Tensor:
        distance = 3**0.5 / self._settings.length * torch.cdist(inputs, self._known)
        return (1 + distance) * torch.exp(-distance)


Bodies = tuple[Tensor, Tensor, Tensor]
"""β (B, 10), θ (B, 24, 3) [rad] and codes (B, C)."""


def _of_bodies(
    model: nets.TailorNet, garment: GarmentTemplate, steps: int, drawn: Bodies, samples: Bodies
) -> TrainingStage:
    """Teaches the low-frequency net the codes of drawn bodies and of samples; a twelfth of the drawn are validation."""
    parts = []
    for betas, pose, code in (drawn, samples):
        parts.append((model.features(pose), torch.cat((betas, betas.new_zeros(len(betas), N_STYLES)), 1), code))
    x, s, _ = parts[0]
    bounded = model.features.are_bounded(garment)
    model.low.standardise(torch.cat((x, s), 1), model.features.groups, is_bounded=bounded)
    model.low.scale[-N_STYLES:] = 0  # a garment of one style ignores γ
    held_out = len(x) // 12
    train = tuple(torch.cat((of_drawn[held_out:], of_samples)) for of_drawn, of_samples in zip(*parts, strict=True))
    validation = tuple(of_drawn[:held_out] for of_drawn in parts[0])
    return TrainingStage("carried", Objective([model.low], model.low_code, code_loss(model)), steps, train, validation)
