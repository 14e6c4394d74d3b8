"""What backbones learn from: unposed displacements of a simulated set, mirrored, split, and as codes of a basis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core.backbones import BasisDecoder, style_shape
from refu_core.body import Collider, SmplBody, load_body
from refu_core.errors import RefuError
from refu_core.garments import GarmentTemplate, SkinBelow, load_garment
from refu_core.realtime import RootTurn
from refu_core.simulation import GarmentDataset, GarmentSequences, SamplePlan, dequantise, open_dataset
from refu_core.training._mirror import Mirror, mirror_pose

_SPARE = 32
"""Extra components that a randomised decomposition finds: the last ones that it finds are the least accurate."""
_SWEEPS = 4
"""Power iterations of the randomised decomposition."""


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

    def joined(self, other: TrainingSamples) -> TrainingSamples:
        """These samples and those of `other`."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return TrainingSamples(*(torch.cat(pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """A simulated set, its garment and body, and the samples of its training split."""

    garment: GarmentTemplate
    body: SmplBody
    rows: GarmentDataset | GarmentSequences
    samples: TrainingSamples

    @classmethod
    def of(
        cls,
        garment: str | GarmentTemplate,
        dataset: str | Path | GarmentDataset | GarmentSequences,
        body: SmplBody | None,
    ) -> TrainingSet:
        """Opens a set; the body is the garment's own if not given. Raises `RefuError` as `read_samples`."""
        template = load_garment(garment) if isinstance(garment, str) else garment
        body = load_body(template.body) if body is None else body
        rows = open_dataset(dataset) if isinstance(dataset, (str, Path)) else dataset
        return cls(template, body, rows, read_samples(rows, body, template, split="train"))

    @property
    def identity(self) -> dict[str, Any]:
        """The garment and body that weights trained on the set are for."""
        return {"garment": self.garment.name, "body_fingerprint": self.body.fingerprint}

    @property
    def card(self) -> dict[str, Any]:
        """What the card of the weights says about the set."""
        return {key: self.rows.card.get(key) for key in ("garment_fingerprint", "motions_fingerprint", "plan")}

    @property
    def n_pivots(self) -> int:
        """How many pairs of the plan have many poses each. Raises `RefuError` for a card without a valid number."""
        found = self.rows.card["plan"].get("pivots", SamplePlan.pivots)
        if not isinstance(found, int) or found < 1:
            msg = f"wanted a set whose card says in plan.pivots how many pairs have many poses, got {str(found)[:80]}"
            raise RefuError(msg)
        return found

    @property
    def knows_limbs(self) -> bool:
        """Whether limbs beside cloth were simulated where recorded: old sets, without colliders, held limbs back."""
        return "gap" in self.rows.card.get("settings", {}).get("drape", {})


class TakenAlong:
    """How far `refu_core.realtime.dress` moves cloth along with skin that gives way, in unposed displacements.

    Networks needn't predict this part.
    """

    def __init__(self, body: SmplBody, garment: GarmentTemplate) -> None:
        self._body, self._garment = body, garment
        self._collider, self._below = Collider(body), SkinBelow.of(garment, body)

    def without(self, displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        """The part of simulated displacements (B, N, 3) [m] that a network has to predict."""
        return self._moved(displacement, betas, pose, style, -1.0)

    def with_it(self, displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        """The inverse of `without`."""
        return self._moved(displacement, betas, pose, style, 1.0)

    @torch.no_grad()
    def _moved(self, displacement: Tensor, betas: Tensor, pose: Tensor, style: Tensor, sign: float) -> Tensor:
        garment, shape = self._garment, self._body.shape(betas)
        _, at_root = RootTurn.taken_off(pose, shape.joints)
        posed = self._body.posed(at_root, shape)
        shift = self._below(self._collider(posed.vertices, posed.transforms) - posed.vertices)
        rest = garment.rest(betas, garment.own(style))
        vertices = garment.pose(rest + displacement, posed.transforms) + sign * shift
        return garment.unpose(vertices, posed.transforms) - rest


def in_chunks(of: Callable[..., Tensor], *values: Any, size: int = 64) -> Tensor:
    """Calls `of` on these arrays, some rows at a time, which bounds the memory; all have N rows, the result too."""
    starts = range(0, max(len(values[0]), 1), size)
    return torch.cat([of(*(value[start : start + size] for value in values)) for start in starts])


def read_samples(
    dataset: GarmentDataset | GarmentSequences, body: SmplBody, garment: GarmentTemplate, *, split: str
) -> TrainingSamples:
    """The samples of one split, `train` or `test`, with the simulated poses; of sequences, the frames that were kept.

    Raises `RefuError` when the set is of another garment or body, or the split has no finished sample.
    """
    check_set(dataset, body, garment)
    rows = np.flatnonzero(dataset.train if split == "train" else dataset.test)
    if not len(rows):
        msg = f"the set of {garment.name} has no finished sample to {split} on: let `refu simulate` run longer"
        raise RefuError(msg)
    names = ("vertices", "pose", "betas", "style", "pair")
    if isinstance(dataset, GarmentSequences):
        stored = _frames(dataset, rows)
    else:
        stored = {name: dataset.column(name)[rows] for name in names}
    vertices = stored.pop("vertices")[:, dataset.parts[garment.name]]
    column = {name: torch.as_tensor(values) for name, values in stored.items()}

    along = TakenAlong(body, garment)

    def displacement(units: NDArray[np.int16], pose: Tensor, betas: Tensor, style: Tensor) -> Tensor:
        posed = torch.as_tensor(dequantise(units))
        whole = garment.unpose(posed, body(pose, betas).transforms) - garment.rest(betas, garment.own(style))
        return along.without(whole, betas, pose, style)

    with torch.no_grad():
        found = in_chunks(displacement, vertices, column["pose"], column["betas"], column["style"])
    return TrainingSamples(column["pose"], column["betas"], column["style"], found, column["pair"].long())


def _frames(dataset: GarmentSequences, rows: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
    """The same columns for every kept frame of some sequences; a frame's pair is the number of its sequence."""
    kept = dataset.column("cause")[rows] == 0
    found = {name: dataset.column(name)[rows][kept] for name in ("vertices", "pose")}
    found |= {name: dataset.column(name)[rows].repeat(kept.sum(1), axis=0) for name in ("betas", "style")}
    return found | {"pair": dataset.column("slot")[rows].repeat(kept.sum(1))}


def mirrored(samples: TrainingSamples, mirror: Mirror) -> TrainingSamples:
    """The mirror images of the samples."""
    return replace(
        samples,
        pose=mirror_pose(samples.pose),
        displacement=in_chunks(mirror.displacement, samples.displacement),
    )


def split_validation(samples: TrainingSamples, *, share: float, seed: int) -> tuple[TrainingSamples, TrainingSamples]:
    """Samples to learn from and samples for validation; whole style-shape pairs go to one or the other.

    With a `share` of 0 the validation part is empty.
    """
    held_out = drawn_pairs(samples.pair, share=share, seed=seed)
    return samples.take(~held_out), samples.take(held_out)


_FEWEST_PAIRS = 5
"""With fewer pairs than this none are held out: the rest would be too similar to learn from."""


def drawn_pairs(pair: Tensor, *, share: float, seed: int, fewest: int = _FEWEST_PAIRS) -> Tensor:
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
        msg = f"an output basis needs 2 samples at least, got {n}: simulate more"
        raise RefuError(msg)
    rank = min(rank, n - 1)
    mean = values.mean(0)
    centred = (values - mean).flatten(1)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        # Randomised: an exact decomposition takes 7 s for 3,000 samples and, growing with the cube, minutes for 12,000.
        _, _, components = torch.svd_lowrank(centred, q=min(rank + _SPARE, n), niter=_SWEEPS)
    return mean, components[:, :rank].T.contiguous()


def check_set(dataset: GarmentDataset | GarmentSequences, body: SmplBody, garment: GarmentTemplate) -> None:
    """Raises `RefuError` for a set that wasn't simulated for this garment on this body."""
    for what, wanted, of_set in (
        ("garment", garment.name, dataset.parts),
        ("body_fingerprint", body.fingerprint, [dataset.card.get("body_fingerprint")]),
    ):
        if wanted not in of_set:
            got = dataset.card.get(what)
            msg = f"wanted a set whose {what} is {wanted}, got {got}: simulate one with `refu simulate {garment.name}`"
            raise RefuError(msg)
