"""All checks, round after round, until there have been enough of them."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from refu_core.stress._guarantees import guarantee_checks
from refu_core.stress._invariance import invariance_checks
from refu_core.stress._numbers import numbers_checks
from refu_core.stress._subject import Subject, Wardrobe
from refu_core.stress._trial import Check, StressError, Tally, load_trial, save_trial

PARTS: tuple[str, ...] = ("numbers", "guarantees", "invariance", "soak")


def all_checks() -> list[Check]:
    """Every check but the soak."""
    return [*numbers_checks(), *guarantee_checks(), *invariance_checks()]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is tried, and how often."""

    checks: tuple[Check, ...]
    wardrobes: tuple[Wardrobe, ...]
    weights: Path | None = None
    rounds: int = 1
    seconds: float = 0.0
    """Rounds go on until so much time is over, too."""
    seed: int = 0

    def pairs(self) -> list[tuple[Check, Wardrobe]]:
        """Each check with each mode that promises it."""
        return [(check, wardrobe) for check in self.checks for wardrobe in self.wardrobes if check.holds_for(wardrobe)]


def run_checks(plan: Plan, *, tick: Callable[[str], object] = str) -> list[Tally]:
    """Tries all, round after round; what is drawn depends on the seed, the check and the round alone.

    Args:
        plan: What is tried.
        tick: Called with a check's name after each of its turns.

    Returns:
        One tally a check and mode, in the checks' order.

    Raises:
        RefuError: as `GarmentPipeline.load`.
    """
    subjects = {wardrobe: Subject(wardrobe, weights=plan.weights) for wardrobe in plan.wardrobes}
    tallies: dict[tuple[str, str], Tally] = {}
    for round_, (check, wardrobe) in _turns(plan):
        tally = tallies.setdefault((check.name, wardrobe.mode), Tally(check.name, wardrobe.mode))
        key = zlib.crc32(f"{check.name} {wardrobe.garments}".encode())
        rng = np.random.default_rng((plan.seed, key, round_))
        for _ in range(check.trials):
            trial = check.draw(rng)
            tally.add(wardrobe, trial, check.run(subjects[wardrobe], trial))
        tick(check.name)
    return list(tallies.values())


def _turns(plan: Plan) -> Iterator[tuple[int, tuple[Check, Wardrobe]]]:
    """Whose turn it is, with the number of the round; whole rounds first, then until the time is over."""
    start = time.monotonic()
    for round_ in count():
        for pair in plan.pairs():
            if round_ >= plan.rounds and time.monotonic() - start >= plan.seconds:
                return
            yield round_, pair


def save_worst(tallies: Sequence[Tally], folder: Path) -> list[Path]:
    """Writes the worst trial of each tally as `folder`/<check>-<mode>.npz."""
    written = []
    for tally in tallies:
        if tally.worst is not None and tally.worst[1].frames:
            name = "".join(c if c.isalnum() else "-" for c in f"{tally.case} {tally.mode}".replace(": ", "-"))
            written.append(save_trial(folder / f"{name}.npz", tally.case, *tally.worst))
    return written


def replay_trial(path: Path, *, weights: Path | None = None) -> Tally:
    """Tries again what `save_worst` wrote.

    Raises:
        StressError: the file can't be read, or is of a check that there isn't.
        RefuError: as `GarmentPipeline.load`.
    """
    name, wardrobe, trial = load_trial(path)
    found = [check for check in all_checks() if check.name == name]
    if not found:
        msg = f"{path}: of the check {name!r}, which this version doesn't have"
        raise StressError(msg)
    tally = Tally(name, wardrobe.mode)
    tally.add(wardrobe, trial, found[0].run(Subject(wardrobe, weights=weights), trial))
    return tally
