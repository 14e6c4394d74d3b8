"""Simulates slots of a set, and says which drapes may enter it: exact checks, and limits on stretch and speed."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from refu_core.body import load_body, load_fit
from refu_core.garments import load_garment, worn_on
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.simulation._cloth import F32, ClothCut
from refu_core.simulation._drape import Draper, DrapeSettings, SettledDrape
from refu_core.simulation._joined import JoinedGarments
from refu_core.simulation._plan import TEST, SamplePlan, garments_of
from refu_core.simulation._poses import Clip
from refu_core.simulation._store import CAUSES, DONE, FORMAT, GIVEN_UP, dequantise, quantise


@dataclass(frozen=True)
class SelectionSettings:
    """Limits on the drapes that are taken."""

    stretch: float = 1.15
    """Limit on the 99.9th percentile of edge length over the length that the edge reaches freely."""
    speed: float = 0.10
    """Limit on the root mean square speed that is left [m/s]: a faster cloth hasn't settled."""


class Selector:
    """Says why a drape can't be taken, judged as it will be stored."""

    def __init__(self, body_faces: Any, garment_faces: Any, *, settings: SelectionSettings | None = None) -> None:
        """For a garment on a body, faces of the shape (F, 3) each."""
        self.settings = settings or SelectionSettings()
        self._body = CollisionChecker(body_faces)
        self._itself = SheetChecker(garment_faces)

    def cause(self, vertices: F32, body: F32, *, stretch: float = 1.0, speed: float = 0.0) -> str | None:
        """One of `CAUSES`, or None for a drape that can be taken.

        `vertices` (N, 3) are the garment's as they will be read back, `body` (V, 3) those of the body below it [m];
        `stretch` and `speed` are those of `SettledDrape`.
        """
        self._body.update(body)
        if not self._body.check(vertices, self._itself.faces).is_free:
            return "body_collision"
        self._itself.update(vertices)
        if len(self._itself.with_itself()):
            return "self_intersection"
        if stretch > self.settings.stretch:
            return "stretch"
        return "unsettled" if speed > self.settings.speed else None


_FARTHEST = 1.9  # [m] along an axis: `quantise` doesn't reach much farther


def is_lost(vertices: F32) -> bool:
    """Whether cloth (N, 3) [m] is somewhere not finite, or too far off to be stored."""
    return not np.abs(vertices).max() <= _FARTHEST


@dataclass(frozen=True)
class SimulationSettings:
    """All settings of a data set except its plan."""

    drape: DrapeSettings = field(default_factory=DrapeSettings)
    selection: SelectionSettings = field(default_factory=SelectionSettings)
    attempts: int = 8
    """Poses that a slot tries before it is given up."""


class Simulator(ABC):
    """Makes the row of any slot of a set, in any order, the same every time; each process has its own simulator."""

    kind: ClassVar[str]
    """Format of the set."""

    def __init__(
        self, plan: Any, clips: tuple[list[Clip], list[Clip]], settings: SimulationSettings, body: str | Path | None
    ) -> None:
        """For clips of the training and the test set, on `body`, or on the one the garment is cut for if None.

        Raises `SimulationError` for garments of different bodies, and what loaders and `Draper` raise.
        """
        self.plan = plan
        self.settings = settings
        self.clips = clips
        own = None if body is None else load_fit(body)
        outfit = JoinedGarments([worn_on(load_garment(garment), own) for garment in garments_of(plan.garment)])
        self.garment, self.parts = outfit.joined, outfit.parts
        self.body = load_body(self.garment.body) if own is None else own.body
        self.draper = Draper(outfit, self.body, settings=settings.drape)
        self._selector = Selector(self.body.faces, self.garment.faces, settings=settings.selection)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a row's garment."""
        return (self.garment.n_vertices, 3)

    def __call__(self, slots: list[int]) -> list[dict[str, Any]]:
        """The rows of some slots."""
        return [self.simulate(slot) for slot in slots]

    @abstractmethod
    def simulate(self, slot: int) -> dict[str, Any]:
        """The columns of a slot's row (see `_store`)."""

    def _examine(self, vertices: F32, body: F32, cut: ClothCut, *, speed: float = 0.0) -> tuple[str | None, Any]:
        """Why cloth is rejected, if it is, and the cloth as stored: None where it isn't finite or is too far off."""
        if is_lost(vertices):
            return "unsettled", None
        stored = quantise(vertices)
        read = dequantise(stored)  # What is checked is what will be read, rounding included.
        stretch = max(cut.stretch(self.draper.topology, one) for one in (vertices, read))
        return self._selector.cause(read, body, stretch=stretch, speed=speed), stored


class SlotSimulator(Simulator):
    """Simulates samples."""

    kind = FORMAT
    plan: SamplePlan

    def tried(self, slot: int, attempt: int) -> tuple[F32, int, int]:
        """The pose (24, 3) [rad] of a slot's attempt, and its clip and frame, as `SamplePlan.pose`."""
        return self.plan.pose(slot, attempt, self.clips[self.plan.split_of(slot) == TEST])

    def judged(self, drape: SettledDrape, pose: F32, betas: F32) -> tuple[str | None, dict[str, Any]]:
        """Why a drape in this pose (24, 3) and shape (10,) is rejected, if it is, and its columns (see `_store`)."""
        body = self.draper.bodies(pose[None], betas)[0]
        cause, stored = self._examine(drape.vertices, body, drape.cut, speed=drape.speed)
        return cause, {"vertices": stored, "stretch": drape.stretch, "speed": drape.speed, "state": DONE}

    def begun(self, slot: int) -> dict[str, Any]:
        """The columns of a slot's row that its drape doesn't change."""
        plan, pair = self.plan, self.plan.pair_of(slot)
        betas, style = plan.style_shape(pair)
        return {"slot": slot, "pair": pair, "split": plan.split_of(slot), "betas": betas, "style": style}

    def simulate(self, slot: int) -> dict[str, Any]:
        """The columns of a slot's row (see `_store`)."""
        start, row = time.perf_counter(), self.begun(slot)
        betas, style = row["betas"], row["style"]
        dropped = np.zeros(len(CAUSES), np.uint8)
        for attempt in range(self.settings.attempts):
            pose, clip, frame = self.tried(slot, attempt)
            drape = self.draper.drape(pose, betas, style)
            cause, taken = self.judged(drape, pose, betas)
            if cause is None:
                row |= taken | {"pose": pose, "clip": clip, "frame": frame}
                break
            dropped[CAUSES.index(cause)] += 1
        else:
            row["state"] = GIVEN_UP
        return row | {"dropped": dropped, "seconds": time.perf_counter() - start}
