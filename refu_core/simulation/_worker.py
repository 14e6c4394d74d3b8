"""Simulates slots of a set of samples: draws, drapes, checks, and the row that comes of them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from refu_core.body import SmplBody, load_body
from refu_core.garments import GarmentTemplate, load_garment
from refu_core.simulation._drape import Drape, Draper, DrapeSettings
from refu_core.simulation._plan import TEST, Plan
from refu_core.simulation._poses import Clip, RoomMaker, RoomSettings
from refu_core.simulation._selection import CAUSES, SelectionSettings, Selector
from refu_core.simulation._store import DONE, GIVEN_UP, Shard, dequantise, quantise


@dataclass(frozen=True)
class SimulationSettings:
    """All settings of a data set but its plan."""

    drape: DrapeSettings = field(default_factory=DrapeSettings)
    room: RoomSettings = field(default_factory=RoomSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    attempts: int = 8
    """Poses that a slot tries before it is given up."""


class SlotSimulator:
    """Simulates the slots of a plan, in any order, each with the same result every time."""

    def __init__(
        self,
        plan: Plan,
        garment: GarmentTemplate,
        body: SmplBody,
        clips: tuple[list[Clip], list[Clip]],
        settings: SimulationSettings,
    ) -> None:
        """For the clips of the training and of the test set."""
        self.plan = plan
        self.settings = settings
        self._clips = clips
        self._body = body
        self._draper = Draper(garment, body, settings=settings.drape)
        self._room = RoomMaker(garment, body, settings=settings.room)
        self._selector = Selector(body.faces, garment.faces, settings=settings.selection)

    def simulate(self, slot: int) -> dict[str, Any]:
        """The columns of a slot's row (see `_store`)."""
        start = time.perf_counter()
        plan = self.plan
        split = plan.split_of(slot)
        pair = plan.pair_of(slot)
        betas, style = plan.style_shape(pair)
        dropped = np.zeros(len(CAUSES), np.uint8)
        row: dict[str, Any] = {"slot": slot, "pair": pair, "split": split, "betas": betas, "style": style}
        for attempt in range(self.settings.attempts):
            pose, clip, frame = plan.pose(slot, attempt, self._clips[split == TEST])
            made = self._room.make_room(pose, betas, style)
            if made is None:
                dropped[CAUSES.index("no_room")] += 1
                continue
            pose, share = made
            drape = self._draper.drape(pose, betas, style)
            cause, stored = self._examine(drape, pose, betas)
            if cause is not None:
                dropped[CAUSES.index(cause)] += 1
                continue
            row |= {"vertices": stored, "pose": pose, "clip": clip, "frame": frame, "share": share}
            row |= {"stretch": drape.stretch, "speed": drape.speed, "state": DONE}
            break
        else:
            row["state"] = GIVEN_UP
        return row | {"dropped": dropped, "seconds": time.perf_counter() - start}

    def _examine(self, drape: Drape, pose: Any, betas: Any) -> tuple[str | None, Any]:
        if not np.isfinite(drape.vertices).all() or np.abs(drape.vertices).max() > 1.9:
            return "unsettled", None
        stored = quantise(drape.vertices)
        body = self._body(pose[None], torch.as_tensor(betas)[None]).vertices[0].numpy()
        # What is checked is what will be read, rounding included.
        read = dequantise(stored)
        judged = replace(drape, stretch=max(drape.stretch, self._draper.stretch(read)))
        return self._selector.cause(read, body, judged), stored


@dataclass(frozen=True, eq=False)
class SampleJob:
    """What a process needs to simulate slots of a set of samples."""

    plan: Plan
    clips: tuple[list[Clip], list[Clip]]
    settings: SimulationSettings
    body: str | Path

    rows: ClassVar[type[Shard]] = Shard

    def simulator(self) -> SlotSimulator:
        """The simulator of this process."""
        garment, body = load_pair(self.plan.garment, self.body)
        return SlotSimulator(self.plan, garment, body, self.clips, self.settings)


def load_pair(garment: str, body: str | Path | None) -> tuple[GarmentTemplate, SmplBody]:
    """The garment and the body it is worn on: its own if `body` is None."""
    template = load_garment(garment)
    return template, load_body(template.body if body is None else body)
