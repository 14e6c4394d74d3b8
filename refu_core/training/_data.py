"""What backbones learn from, unposed displacements of a simulated set, mirrored, too; and how far off they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core.backbones import Backbone, BasisDecoder, Controls, TailorNet, backbone_from_weights, style_shape
from refu_core.body import Collider, SmplBody, load_body
from refu_core.errors import RefuError
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.garments import N_STYLES, GarmentTemplate, SkinBelow, load_garment
from refu_core.simulation import GarmentDataset, GarmentSequences, SamplePlan, dequantise, open_dataset
from refu_core.training._loop import seeded
from refu_core.training._mirror import Mirror as Mirror
from refu_core.training._mirror import SurfaceMixture as SurfaceMixture
from refu_core.training._mirror import mirror_pose as mirror_pose
from refu_core.weights import load_weights

_SPARE = 32
"""Extra components that a randomised decomposition finds: the last ones that it finds are the least accurate."""


@dataclass(frozen=True, eq=False)
class TrainingSamples:
    """N bodies and the displacement of the garment on each."""

    pose: Tensor
    """θ that was simulated, rotation vectors [rad], shape (N, 24, 3)."""
    betas: Tensor
    """β, shape (N, 10)."""
    style: Tensor
    """γ, shape (N, 4)."""
    displacement: Tensor
    """D = unpose(x) - t(β, γ) of the simulated garment x, less what `TakenAlong` adds to it [m], shape (N, V, 3)."""
    pair: Tensor
    """Number of the style-shape pair, or of the sequence, shape (N,), int64."""

    def __len__(self) -> int:
        """N."""
        return len(self.pose)

    @property
    def style_shape(self) -> Tensor:
        """(β, γ), shape (N, 14)."""
        return style_shape(self.betas, self.style)

    def take(self, which: Tensor) -> TrainingSamples:
        """The samples of these indices, or of this mask."""
        return TrainingSamples(*(getattr(self, field.name)[which] for field in fields(self)))

    def joined(self, *others: TrainingSamples) -> TrainingSamples:
        """These samples and those of `others`."""
        return TrainingSamples(*(torch.cat([getattr(one, f.name) for one in (self, *others)]) for f in fields(self)))


Rows = GarmentDataset | GarmentSequences
Sets = str | Path | Rows | Sequence[str | Path | Rows]
"""A simulated set, or several of plans with different seeds: each is open, or the path of one."""


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Simulated sets of a garment on a body, and the samples of their training splits."""

    garment: GarmentTemplate
    body: SmplBody
    sets: Sequence[Rows]
    samples: TrainingSamples

    @classmethod
    def of(
        cls,
        garment: str | GarmentTemplate,
        datasets: Sets,
        body: SmplBody | None,
        *,
        who: Callable[[Tensor], Tensor] | None = None,
        may_be_empty: bool = False,
    ) -> TrainingSet:
        """Opens sets; the body is the garment's own if not given. Raises `RefuError` as `read_samples`."""
        template = load_garment(garment) if isinstance(garment, str) else garment
        body = load_body(template.body) if body is None else body
        given = datasets if isinstance(datasets, Sequence) and not isinstance(datasets, str) else [datasets]
        sets = [open_dataset(one) if isinstance(one, (str, Path)) else one for one in given]
        if not sets and not may_be_empty:
            raise RefuError(f"wanted a set of {template.name}, got none: refu simulate {template.name} makes one")
        for one in sets:
            check_set(one, body, template)
        return cls(template, body, sets, _joined(sets, body, template, "train", who))

    def test(self, *, who: Callable[[Tensor], Tensor] | None = None) -> TrainingSamples:
        """The samples of the sets' test splits. Raises `RefuError` as `read_samples`."""
        return _joined(self.sets, self.body, self.garment, "test", who)

    @property
    def identity(self) -> dict[str, Any]:
        """The garment and body that weights trained on the set are for."""
        return {"garment": self.garment.name, "body_fingerprint": self.body.fingerprint}

    @property
    def cards(self) -> list[dict[str, Any]]:
        """What the card of the weights says about each set."""
        keys = "garment_fingerprint", "motions_fingerprint", "plan"
        return [{key: one.card.get(key) for key in keys} for one in self.sets]

    def tailornet(self, folder: Path, mode: str) -> tuple[TailorNet, Mapping[str, Any]]:
        """The garment's trained tailornet in `folder`, and its card.

        Raises `WeightsError` for none there, or a damaged one, and `RefuError` for another backbone.
        """
        stored = load_weights(folder / f"tailornet-{mode}", expect=self.identity)
        found = backbone_from_weights(stored, self.garment)
        if not isinstance(found, TailorNet):
            raise RefuError(f"{stored.path}: wanted a tailornet, got {type(found).__name__}")
        return found, stored.card

    @property
    def plans(self) -> list[Mapping[str, Any]]:
        """The plan of each set."""
        return [one.card.get("plan", {}) for one in self.sets]

    @property
    def n_slots(self) -> int:
        """Finished rows of all sets."""
        return sum(map(len, self.sets))

    @property
    def n_pivots(self) -> int:
        """How many pairs of the first plan have many poses each. Raises `RefuError` where its card doesn't say."""
        found = self.plans[0].get("pivots", SamplePlan.pivots)
        if not isinstance(found, int) or found < 1:
            raise RefuError(f"wanted the number of its pivots in the set's card (plan.pivots), got {str(found)[:80]}")
        return found

    @property
    def knows_limbs(self) -> bool:
        """Whether limbs beside cloth were simulated where recorded: old sets, without colliders, held limbs back."""
        return all("gap" in one.card.get("settings", {}).get("drape", {}) for one in self.sets)


class TakenAlong:
    """How far `dress` moves cloth along with skin that gives way, unposed: networks needn't predict this part."""

    def __init__(self, body: SmplBody, garment: GarmentTemplate) -> None:
        self._body, self._garment = body, garment
        self._collider, self._below = Collider(body), SkinBelow.of(garment, body)

    @torch.no_grad()
    def added(self, sign: int, displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        """Displacements (B, N, 3) [m] with it, or, with a `sign` of -1, simulated ones without it."""
        garment, shape = self._garment, self._body.shape(betas)
        posed = self._body.posed(pose, shape, in_root=True)
        shift = self._below(self._collider(posed.vertices, posed.transforms) - posed.vertices)
        rest = garment.rest(betas, garment.own(style))
        vertices = garment.pose(rest + displacement, posed.transforms) + sign * shift
        return garment.unpose(vertices, posed.transforms) - rest


def in_chunks(of: Callable[..., Tensor], *values: Any, size: int = 64) -> Tensor:
    """Calls `of` on these arrays, some rows at a time, which bounds the memory; all have N rows, the result too."""
    starts = range(0, max(len(values[0]), 1), size)
    return torch.cat([of(*(value[start : start + size] for value in values)) for start in starts])


def read_samples(
    dataset: Rows,
    body: SmplBody,
    garment: GarmentTemplate,
    *,
    split: str,
    who: Callable[[Tensor], Tensor] | None = None,
) -> TrainingSamples:
    """The samples of one split, `train` or `test`, with the simulated poses; of sequences, the frames that were kept.

    `who` may say of poses (N, 24, 3) which of them are wanted, (N,): to pull a body's limbs apart takes long.
    Raises `RefuError` when the set is of another garment or body, or the split has no finished sample.
    """
    check_set(dataset, body, garment)
    rows = np.flatnonzero(dataset.train if split == "train" else dataset.test)
    if not len(rows):
        raise RefuError(f"the set of {garment.name} has no finished sample to {split} on: finish it, or enlarge it")
    if isinstance(dataset, GarmentSequences):
        stored = _frames(dataset, rows)
    else:
        stored = {name: dataset.column(name)[rows] for name in ("vertices", "pose", "betas", "style", "pair")}
    if who is not None:
        wanted = who(torch.as_tensor(stored["pose"])).numpy()
        stored = {name: values[wanted] for name, values in stored.items()}
    vertices = stored.pop("vertices")[:, dataset.parts[garment.name]]
    pose, betas, style, pair = (torch.as_tensor(stored[name]) for name in ("pose", "betas", "style", "pair"))
    along = TakenAlong(body, garment)

    def displacement(units: NDArray[np.int16], pose: Tensor, betas: Tensor, style: Tensor) -> Tensor:
        posed = torch.as_tensor(dequantise(units))
        whole = garment.unpose(posed, body(pose, betas).transforms) - garment.rest(betas, garment.own(style))
        return along.added(-1, whole, betas, pose, style)

    with torch.no_grad():
        found = in_chunks(displacement, vertices, pose, betas, style)
    return TrainingSamples(pose, betas, style, found, pair.long())


def _joined(
    sets: Sequence[Rows], body: SmplBody, garment: GarmentTemplate, split: str, who: Callable[[Tensor], Tensor] | None
) -> TrainingSamples:
    """The samples of a split of all sets, any of which may lack it; each pair keeps a number of its own."""
    if not sets:
        shapes = (N_JOINTS, 3), (N_BETAS,), (N_STYLES,), (garment.n_vertices, 3), ()
        pose, betas, style, displacement, pair = (torch.zeros(0, *shape) for shape in shapes)
        return TrainingSamples(pose, betas, style, displacement, pair.long())
    having = [one for one in sets if (one.train if split == "train" else one.test).any()] or sets[:1]
    numbered, count = [], 0
    for one in having:
        samples = read_samples(one, body, garment, split=split, who=who)
        numbered.append(replace(samples, pair=samples.pair + count))
        count += int(samples.pair.max()) + 1 if len(samples) else 0
    first, *others = numbered
    return first.joined(*others) if others else first


def _frames(dataset: GarmentSequences, rows: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
    """The same columns for every kept frame of some sequences; a frame's pair is the number of its sequence."""
    kept = dataset.column("cause")[rows] == 0
    found = {name: dataset.column(name)[rows][kept] for name in ("vertices", "pose")}
    found |= {name: dataset.column(name)[rows].repeat(kept.sum(1), axis=0) for name in ("betas", "style")}
    return found | {"pair": dataset.column("slot")[rows].repeat(kept.sum(1))}


def mirrored(samples: TrainingSamples, mirror: Mirror) -> TrainingSamples:
    """The mirror images of the samples."""
    turned = in_chunks(mirror.displacement, samples.displacement)
    return replace(samples, pose=mirror_pose(samples.pose), displacement=turned)


def with_mirrored(samples: TrainingSamples, mirror: Mirror | None) -> TrainingSamples:
    """The samples and their mirror images; without a mirror the samples alone."""
    return samples if mirror is None else samples.joined(mirrored(samples, mirror))


def split_validation(samples: TrainingSamples, *, share: float, seed: int) -> tuple[TrainingSamples, TrainingSamples]:
    """Samples to learn from and samples for validation; whole style-shape pairs go to one or the other.

    With a `share` of 0 the validation part is empty.
    """
    # With fewer pairs than five none are held out: the rest would be too similar to learn from.
    held_out = drawn_pairs(samples.pair, share=share, seed=seed, fewest=5)
    return samples.take(~held_out), samples.take(held_out)


def drawn_pairs(pair: Tensor, *, share: float, seed: int, fewest: int) -> Tensor:
    """Which of N samples, of the style-shape pairs `pair` (N,), are chosen: bool, shape (N,).

    Whole pairs are drawn as long as they stay within `share`; at least one if there are `fewest` pairs or more, unless
    `share` is 0.
    """
    known, counts = torch.unique(pair, return_counts=True)
    order = torch.randperm(len(known), generator=torch.Generator().manual_seed(seed))
    n_chosen = int((counts[order].cumsum(0) <= share * len(pair)).sum())
    if share > 0 and len(known) >= fewest:
        n_chosen = max(n_chosen, 1)
    return torch.isin(pair, known[order[:n_chosen]])


def output_basis(displacement: Tensor, *, rank: int) -> BasisDecoder:
    """The basis of the `rank` principal components of displacements (N, V, 3) [m]. Raises `RefuError` for N < 2."""
    return BasisDecoder(*principal_components(displacement, rank=rank))


def principal_components(values: Tensor, *, rank: int) -> tuple[Tensor, Tensor]:
    """The mean (V, 3) and the `rank` principal components (R, 3 V) of `values` (N, V, 3), at most N - 1.

    Raises `RefuError` for fewer than two values.
    """
    n = len(values)
    if n < 2:  # to learn it well takes hundreds
        raise RefuError(f"an output basis needs 2 samples at least, got {n}: simulate more")
    rank = min(rank, n - 1)
    mean = values.mean(0)
    centred = (values - mean).flatten(1)
    with seeded(0):
        # Randomised: an exact decomposition takes 7 s for 3,000 samples and, growing with the cube, minutes for 12,000.
        _, _, components = torch.svd_lowrank(centred, q=min(rank + _SPARE, n), niter=4)
    return mean, components[:, :rank].T.contiguous()


def smooth_components(values: Tensor, controls: Controls, *, rank: int) -> tuple[Tensor, Tensor]:
    """As `principal_components`, at `controls`, (C, 3) and (R, 3 C), of what these can represent of `values`."""
    smooth, triangle = torch.linalg.qr(controls.matrix())
    at = torch.einsum("vc,nvk->nck", smooth, values)
    mean, components = principal_components(at, rank=rank)  # orthonormal columns: as over all vertices
    both = torch.cat((mean.flatten()[None], components)).view(-1, *mean.shape)
    mean, components = torch.linalg.solve_triangular(triangle, both, upper=True).flatten(1).tensor_split((1,))
    return mean.view(-1, 3), components


def check_set(dataset: Rows, body: SmplBody, garment: GarmentTemplate) -> None:
    """Raises `RefuError` for a set that wasn't simulated for this garment on this body."""
    for what, wanted, of_set in (
        ("garment", garment.name, dataset.parts),
        ("body_fingerprint", body.fingerprint, [dataset.card.get("body_fingerprint")]),
    ):
        if wanted not in of_set:
            got = dataset.card.get(what)
            raise RefuError(f"wanted a set whose {what} is {wanted}, got {got}: refu simulate {garment.name} makes one")


@torch.no_grad()
def displacements(backbone: Backbone, samples: TrainingSamples) -> Tensor:
    """What a backbone predicts for samples [m], shape (N, V, 3); zero for one without a network."""

    def predict(betas: Tensor, pose: Tensor, style: Tensor, truth: Tensor) -> Tensor:
        predicted = backbone(betas, pose, style)
        return torch.zeros_like(truth) if predicted is None else predicted

    return in_chunks(predict, samples.betas, samples.pose, samples.style, samples.displacement, size=32)


@torch.no_grad()
def posed_errors(predicted: Tensor, samples: TrainingSamples, body: SmplBody, garment: GarmentTemplate) -> Tensor:
    """Errors of posed vertices [mm], shape (N, V), for predicted displacements (N, V, 3) [m] (the paper's MPVE)."""

    def error(predicted: Tensor, truth: Tensor, pose: Tensor, betas: Tensor) -> Tensor:
        rotation = garment.vertex_transforms(body(pose, betas).transforms).rotation
        distance: Tensor = (rotation @ (predicted - truth).unsqueeze(-1)).squeeze(-1).norm(dim=-1)
        return 1e3 * distance

    return in_chunks(error, predicted, samples.displacement, samples.pose, samples.betas, size=32)


def mpve(predicted: Tensor, samples: TrainingSamples, body: SmplBody, garment: GarmentTemplate) -> float:
    """Mean of `posed_errors` [mm]."""
    return round(float(posed_errors(predicted, samples, body, garment).mean()), 3)


def backbone_figures(
    backbone: Backbone, samples: TrainingSamples, body: SmplBody, garment: GarmentTemplate, *, mean: Tensor
) -> dict[str, Any]:
    """MPVE on the test split [mm], beside baselines to compare it with.

    `skinned_mm` is without a network, `mean_mm` with the best constant displacement (`mean`, shape (V, 3)), and
    `basis_mm` the least that the output basis allows.
    """
    truth, decoder = samples.displacement, getattr(backbone, "decoder", None)
    shown = {
        "mpve_mm": displacements(backbone, samples),
        "skinned_mm": torch.zeros_like(truth),
        "mean_mm": mean.expand_as(truth),
    }
    if isinstance(decoder, BasisDecoder):
        shown["basis_mm"] = decoder(decoder.encode(truth))
    return {"samples": len(samples), **{name: mpve(one, samples, body, garment) for name, one in shown.items()}}
