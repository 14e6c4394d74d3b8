"""What a trained network rehearses while it learns from new samples, so that it doesn't forget what it knew."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import count as counted
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refu_core.backbones import Network
from refu_core.errors import RefuError
from refu_core.simulation import Clip, SamplePlan, names_of, split_clips
from refu_core.training._data import Mirror, TrainingSamples, in_chunks, mirror_pose

_SEEDS_APART = 1_000_003
"""Between the seed of a plan and those of its further bodies."""


Asked = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From β (B, 10), θ (B, 24, 3) [rad] and γ (B, 4) to displacements (B, V, 3) [m]."""


@dataclass(frozen=True)
class Rehearsal:
    """Bodies of the plans that a network was trained on, with the network's predictions in place of the truth.

    The simulated samples aren't needed: a plan says the pose, shape and style of each.
    """

    count: int
    """Bodies, evenly spread over the training splits of all plans."""
    motions: str | Path | Sequence[Clip] | None = None
    """The motions of those plans; None where they have drawn poses alone."""
    further: int = 0
    """Further bodies, drawn as those plans draw theirs: no simulation has seen them."""

    @property
    def most(self) -> int:
        """Bodies at most."""
        return self.count + self.further

    def of(
        self, card: Mapping[str, Any], network: Asked, *, known: Sequence[Mapping[str, Any]] = ()
    ) -> TrainingSamples:
        """The samples for a trained `network` and the card of its weights.

        At most as many as its plans have, and the further ones. The plans `known`, those of the new samples, are left
        out, since their truth is there.

        Raises `RefuError` for a card without a plan of its garment, and `SimulationError` for an invalid plan or
        missing motions.
        """
        names = {field.name for field in fields(SamplePlan)}
        given = plans_of(card, known=known)
        plans = [SamplePlan(**{key: value for key, value in one.items() if key in names}) for one in given]
        has_slots = sum(plan.count - plan.n_test for plan in plans) > 0
        if not has_slots or not all(str(card["garment"]) in names_of(plan.garment).split("+") for plan in plans):
            raise RefuError("nothing to rehearse: the weights' card has no plan of their garment")
        clips: Sequence[Clip] = []
        recorded = max(plan.recorded_share for plan in plans)
        if recorded > 0:
            if self.motions is None:
                raise RefuError(f"up to {recorded:.0%} of what is to be rehearsed are recorded poses: give them")
            clips = split_clips(self.motions)[0]
        chosen = [*_spread(plans, self.count), *islice(_further(plans, self.further), self.further)]
        pose = torch.as_tensor(np.stack([plan.pose(slot, 0, clips)[0] for plan, slot in chosen]))
        shapes = zip(*(plan.style_shape(plan.pair_of(slot)) for plan, slot in chosen), strict=True)
        betas, style = (torch.as_tensor(np.stack(values)) for values in shapes)
        with torch.no_grad():
            displacement = in_chunks(network, betas, pose, style, size=256)
        return TrainingSamples(pose, betas, style, displacement, torch.arange(len(chosen)))


def _spread(plans: Sequence[SamplePlan], count: int) -> list[tuple[SamplePlan, int]]:
    """So many training slots, evenly spread over all plans; at most as many as there are."""
    ends = np.cumsum([plan.count - plan.n_test for plan in plans])
    rows = np.unique(np.linspace(0, ends[-1] - 1, min(count, ends[-1])).round().astype(int))
    of = np.searchsorted(ends, rows, side="right")
    return [(plans[k], int(row - (ends[k - 1] if k else 0))) for k, row in zip(of, rows, strict=True)]


def _further(plans: Sequence[SamplePlan], count: int) -> Iterator[tuple[SamplePlan, int]]:
    """Training slots of the same plans with other seeds, without end if there are any."""
    for k in counted(1):
        others = [replace(plan, seed=plan.seed + k * _SEEDS_APART) for plan in plans]
        yield from _spread(others, count)


def symmetric(network: Network, mirror: Mirror) -> Asked:
    """The mean of what a network says of a person, and of the mirrored one in the mirror.

    It is wrong about the two in different ways, so the mean is nearer to the truth.
    """

    def mean(betas: Tensor, pose: Tensor, style: Tensor) -> Tensor:
        said, turned = network(betas, pose, style), network(betas, mirror_pose(pose), style)
        both: Tensor = 0.5 * (said + mirror.displacement(turned))
        return both

    return mean


def plans_of(card: Mapping[str, Any], *, known: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The plans that weights were trained on, by their card, except `known`: the rehearsed ones, then their sets'."""
    rehearsed, sets = card.get("rehearsed"), card.get("datasets", [card.get("dataset")])  # one set, in older cards
    earlier = rehearsed.get("plans") if isinstance(rehearsed, Mapping) else None
    found = [*earlier] if isinstance(earlier, (list, tuple)) else []
    found += [one.get("plan") for one in sets if isinstance(one, Mapping)] if isinstance(sets, (list, tuple)) else []
    return [one for one in found if isinstance(one, Mapping) and {"garment", "count"} <= set(one) and one not in known]
