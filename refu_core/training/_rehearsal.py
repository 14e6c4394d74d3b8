"""What a trained network is asked for again while it learns from new samples, lest it forget what it knew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from refu_core.backbones import Network
from refu_core.errors import RefuError
from refu_core.simulation import Clip, SamplePlan, load_clips, split_clips
from refu_core.training._data import TrainingSamples, in_chunks


@dataclass(frozen=True)
class Rehearsal:
    """Bodies of the plan that a network was trained on, with what it predicts on them in place of the truth.

    Their samples aren't needed: a plan says pose, shape and style of each.
    """

    count: int
    """Bodies, evenly spread over the plan's training split."""
    motions: str | Path | Sequence[Clip] | None = None
    """The motions of that plan; None where it has drawn poses alone."""

    def of(self, card: Mapping[str, Any], network: Network) -> TrainingSamples:
        """Of a trained `network` and the card of its weights; of as many bodies as the plan has at most.

        Raises `RefuError` for a card without a plan, and `SimulationError` for motions that aren't there.
        """
        known = {field.name for field in fields(SamplePlan)}
        found = plan_of(card)
        if found is None or not {"garment", "count"} <= set(found):
            msg = "nothing to rehearse: the weights' card doesn't say what plan they were trained on"
            raise RefuError(msg)
        plan = SamplePlan(**{key: value for key, value in found.items() if key in known})
        clips: Sequence[Clip] = []
        if plan.recorded_share > 0:
            if self.motions is None:
                msg = f"{plan.recorded_share:.0%} of what is to be rehearsed are recorded poses: give those motions"
                raise RefuError(msg)
            all_clips = load_clips(self.motions) if isinstance(self.motions, (str, Path)) else self.motions
            clips = split_clips(all_clips)[0]
        n = plan.count - plan.n_test
        slots = np.unique(np.linspace(0, n - 1, min(self.count, n)).round().astype(int)).tolist()
        pair = [plan.pair_of(slot) for slot in slots]
        pose = torch.as_tensor(np.stack([plan.pose(slot, 0, clips)[0] for slot in slots]))
        shapes = zip(*(plan.style_shape(one) for one in pair), strict=True)
        betas, style = (torch.as_tensor(np.stack(values)) for values in shapes)
        with torch.no_grad():
            displacement = in_chunks(network, betas, pose, style)
        return TrainingSamples(pose, betas, style, displacement, torch.tensor(pair))


def plan_of(card: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The plan that weights were trained on first, by their card; None where it doesn't say."""
    rehearsed = card.get("rehearsed") or {}
    found = rehearsed.get("plan") or (card.get("dataset") or {}).get("plan")
    return found if isinstance(found, Mapping) else None
