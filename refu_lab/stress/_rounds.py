"""What `refu stress` does: the table of checks, round after round of them, the soaks, and what is printed."""

from __future__ import annotations

import contextlib
import math
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from refu_core._device import one_thread
from refu_core.backbones import backbone_stem
from refu_core.errors import FrameError, WeightsError
from refu_core.frames import N_BETAS, N_STYLES
from refu_core.garments import load_garment
from refu_core.weights import load_card
from refu_lab.commands.stress import StressOptions
from refu_lab.stress import _guarantees as guarantees
from refu_lab.stress import _invariance as invariance
from refu_lab.stress import _numbers as numbers
from refu_lab.stress._frames import FRAMES, Draw, between, everyday, everyday_pose, frame_of, motion, promised
from refu_lab.stress._soak import SoakResult, soak
from refu_lab.stress._trial import (
    Check,
    Measurement,
    StressError,
    Subject,
    Tally,
    Trial,
    Wardrobe,
    load_trial,
    save_trial,
)
from refu_lab.tables import format_table

_FRAMES = 64
"""Frames in a trial of numbers, and persons in a batch."""
_STEPS = 24


def _many(draw: Draw, rng: np.random.Generator) -> Trial:
    """64 frames; the pipeline never sees those that `SmplFrame` itself refuses."""
    frames = []
    for _ in range(_FRAMES):
        with contextlib.suppress(FrameError):
            frames.append(draw(rng))
    return Trial(tuple(frames), refused=_FRAMES - len(frames))


def _calm(rng: np.random.Generator, *, share: float = 0.6, in_room: bool = False) -> Trial:
    """A scaled-down everyday pose, in which most bodies don't touch themselves, at the origin or in a room."""
    pose, betas = share * everyday_pose(rng), rng.normal(0, 1, N_BETAS)
    transl = rng.normal(0, 3, 3) if in_room else np.zeros(3)
    return Trial((frame_of(pose, betas, transl),), int(rng.integers(2**31)))


_calm_day = partial(_calm, in_room=True)


def _any_day(rng: np.random.Generator) -> Trial:
    return Trial((everyday(rng),)) if rng.random() < 0.5 else _calm_day(rng)


def _promised(rng: np.random.Generator) -> Trial:
    return Trial((promised(rng),))


def _any_frame(rng: np.random.Generator) -> Trial:
    names = [name for name in FRAMES if name != "absurd"]
    return Trial((FRAMES[names[rng.integers(len(names))]](rng),))


def _wide(rng: np.random.Generator) -> Trial:
    """Half of the trials are within the promised range, half anywhere."""
    return _promised(rng) if rng.random() < 0.5 else _any_frame(rng)


def _motion(rng: np.random.Generator) -> Trial:
    betas, style = rng.normal(0, 1, N_BETAS), rng.normal(0, 1, N_STYLES)
    poses = [0.7 * everyday_pose(rng) for _ in range(2)]
    return Trial(tuple(motion(between(poses, _STEPS), betas, style)))


def _folding(rng: np.random.Generator) -> Trial:
    """Motion from an everyday pose to one with limbs through the trunk."""
    last = FRAMES["limbs through the trunk"](rng)
    poses: list[NDArray[np.floating]] = [0.7 * everyday_pose(rng), last.pose]
    return Trial(tuple(motion(between(poses, _STEPS), last.betas)))


def _teleport(rng: np.random.Generator) -> Trial:
    """Frames each of which is far from the one before."""
    names = ("everyday", "any rotation of any joint", "limbs through the trunk", "betas of 5", "angles beyond a turn")
    return Trial((*(FRAMES[name](rng) for name in rng.permutation(names)), everyday(rng)))


def _crowd(rng: np.random.Generator) -> Trial:
    return Trial(tuple(_calm(rng).frames[0] for _ in range(_FRAMES)))


CHECKS: dict[str, Check] = {
    check.name: check
    for check in (
        *(Check(f"numbers: {name}", partial(_many, draw), numbers.against_float64) for name, draw in FRAMES.items()),
        Check(
            "numbers: collider, everyday", partial(_many, everyday), partial(numbers.against_float64, on_collider=True)
        ),
        *(
            Check(f"numbers: distance, {name}", partial(_calm, share=0.5), partial(numbers.distances, place=place))
            for name, place in numbers.POINTS.items()
        ),
        Check("guarantees: nothing inside", _any_day, guarantees.nothing_inside, trials=4, needs_sdf=True),
        Check("guarantees: nothing inside, garment buried in the body", _calm_day, guarantees.buried, needs_sdf=True),
        Check(
            "guarantees: nothing inside, promised poses and shapes",
            _promised,
            guarantees.nothing_inside,
            8,
            needs_sdf=True,
        ),
        Check("guarantees: whatever is inside is counted", _wide, guarantees.counted, trials=8),
        Check("guarantees: no vertex thrown out", _any_day, guarantees.not_thrown, trials=2),
        Check("guarantees: displacement bounded in any pose", _any_frame, guarantees.bounded, trials=4),
        Check("guarantees: no jumps in smooth motion", _motion, guarantees.no_jumps),
        Check(
            "guarantees: no jumps in smooth motion, worn together", _motion, partial(guarantees.no_jumps, together=True)
        ),
        Check("guarantees: bounded jumps through self-contact", _folding, guarantees.bounded_jumps),
        Check("invariance: the person turned", _calm, invariance.turned, trials=2, repeats=1),
        Check("invariance: the person 100 km away", _calm, invariance.moved, trials=2, repeats=1),
        Check("invariance: left and right exchanged", _calm, invariance.mirrored, repeats=1),
        Check("invariance: what came before", _teleport, invariance.history, repeats=2),
        Check("invariance: a batch of 64, predicted", _crowd, invariance.batch, repeats=invariance.ALONE),
        Check("invariance: a batch of 64, resolved", _crowd, invariance.batch_resolved, repeats=invariance.ALONE),
    )
}
"""All checks by name; each round runs them in this order."""


_SOAK_SHARE = 0.3


@dataclass(frozen=True, kw_only=True)
class StressResult:
    tallies: list[Tally] = field(default_factory=list)
    soaks: list[SoakResult] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    """What could not be tried, and why."""
    files: list[Path] = field(default_factory=list)

    @property
    def failures(self) -> int:
        """Number of failed trials, and of limits that soaks exceeded."""
        return sum(one.failures for one in self.tallies) + sum(one.failures for one in self.soaks)

    def as_dict(self) -> dict[str, Any]:
        rows = [one.as_dict() for one in self.tallies] + [one.as_dict() for one in self.soaks]
        return {"rows": rows, "left_out": self.left_out, "failures": self.failures}


def run_stress(options: StressOptions, *, progress: bool) -> StressResult:
    """Runs everything that the options ask for.

    Raises `StressError`: there is nothing to try: no such part, or no weights of any garment; `RefuError`: as
    `GarmentPipeline.load`.
    """
    wardrobes, left_out = _wardrobes(options)
    result = StressResult(left_out=left_out)
    seconds = 0.0 if options.hours is None else 3600 * options.hours
    checks = [check for check in CHECKS.values() if check.part in options.parts]
    has_soak = "soak" in options.parts
    with one_thread():
        subjects = [Subject(one, weights=options.weights, collider=options.collider) for one in wardrobes]
        pairs = [(check, one) for check in checks for one in subjects if check.holds_for(one.wardrobe)]
        result.tallies.extend(_run_checks(options, pairs, seconds * (1 - _SOAK_SHARE * has_soak), progress=progress))
        for subject in subjects if has_soak else ():
            share = _SOAK_SHARE if checks else 1.0
            with tqdm(total=options.n_frames, unit="frame", disable=not progress, leave=False, mininterval=1) as bar:
                done = soak(
                    subject.pipeline,
                    mode=f"{subject.wardrobe.mode} {', '.join(subject.wardrobe.garments)}",
                    frames=options.n_frames,
                    persons=options.persons,
                    seconds=share * seconds / len(wardrobes) if options.hours is not None else math.inf,
                    seed=options.seed,
                    tick=bar.update,
                )
            result.soaks.append(done)
    if options.output is not None:
        result.files.extend(_save_worst(result.tallies, options.output))
    return result


def _wardrobes(options: StressOptions) -> tuple[list[Wardrobe], list[str]]:
    """A wardrobe for each mode and body; and the garments that are left out for lack of weights."""
    worn: dict[tuple[str, str, str], list[str]] = {}
    left_out = []
    for backbone, sdf in options.modes:
        for name in dict.fromkeys(options.garments):
            body, folder = load_garment(name).body, None if options.weights is None else options.weights / name
            try:
                stem = backbone_stem(backbone, name, mode=sdf, folder=folder)
                if stem is not None:
                    load_card(stem)  # the weights themselves are opened by the pipelines
            except WeightsError as error:
                left_out.append(f"{name}: no weights of {backbone} {sdf} ({error})")
            else:
                worn.setdefault((backbone, sdf, body), []).append(name)
    if not worn:
        raise StressError(f"nothing to try: {'; '.join(left_out) or 'no garment was named'}")
    found = [Wardrobe(garments=tuple(names), backbone=b, sdf=sdf) for (b, sdf, _), names in worn.items()]
    return found, left_out


def _run_checks(
    options: StressOptions, pairs: Sequence[tuple[Check, Subject]], seconds: float, *, progress: bool
) -> list[Tally]:
    """Runs `n_rounds` whole rounds, then goes on until the time is over; one tally a check and mode, in their order.

    What is drawn depends only on the seed, the check, its garments and the round.
    """
    tallies: dict[tuple[str, str], Tally] = {}
    total = options.n_rounds * len(pairs) if options.hours is None else None
    start = time.monotonic()
    with tqdm(total=total, unit="check", disable=not progress, leave=False) as bar:
        for round_, (check, subject) in ((n, pair) for n in count() for pair in pairs) if pairs else ():
            if round_ >= options.n_rounds and time.monotonic() - start >= seconds:
                break
            wardrobe = subject.wardrobe
            tally = tallies.setdefault((check.name, wardrobe.mode), Tally(check.name, wardrobe.mode))
            key = zlib.crc32(f"{check.name} {wardrobe.garments}".encode())
            rng = np.random.default_rng((options.seed, key, round_))
            for _ in range(check.trials):
                trial = check.trial(rng)
                tally.add(wardrobe, trial, check.run(subject, trial))
            bar.update()
    return list(tallies.values())


def _save_worst(tallies: Sequence[Tally], folder: Path) -> list[Path]:
    written = []
    for tally in tallies:
        if tally.worst_trial is not None and tally.worst_trial[1].frames:
            name = "".join(c if c.isalnum() else "-" for c in f"{tally.case} {tally.mode}".replace(": ", "-"))
            written.append(save_trial(folder / f"{name}.npz", tally.case, *tally.worst_trial))
    return written


def replay_trial(path: Path, *, weights: Path | None = None, collider: bool = True) -> Tally:
    """Runs a trial again that `refu stress` has saved.

    Raises `StressError`: the file can't be read, or its check doesn't exist; `RefuError`: as `GarmentPipeline.load`.
    """
    name, wardrobe, trial = load_trial(path)
    if name not in CHECKS:
        raise StressError(f"{path}: of the check {name!r}, which this version doesn't have")
    tally = Tally(name, wardrobe.mode)
    with one_thread():
        tally.add(wardrobe, trial, CHECKS[name].run(Subject(wardrobe, weights=weights, collider=collider), trial))
    return tally


def stress_table(result: StressResult) -> str:
    """What `refu stress` prints: all rows, the faults, and where the worst cases are."""
    lines, rows = list[str](), list[tuple[str, ...]]()
    if result.tallies:
        for tally in result.tallies:
            worst = tally.worst or Measurement()
            counts = (tally.runs, tally.failures, tally.nan, tally.refused)
            rows.append((tally.case, tally.mode, *map(str, counts), length(worst.deviation), length(worst.limit)))
        header: tuple[str, ...] = ("case", "mode", "runs", "failures", "NaN", "refused", "deviation", "limit")
        note = "(deviation and limit are those of the worst trial; a few limits depend on the frame)"
        lines += [format_table(header, rows), note, ""]
    if result.soaks:
        header = ("soak", "frames", "NaN", "memory MB", "", "p99 ms", "", "wall p99 ms", "machine")
        rows = []
        for one in result.soaks:
            mb, ms, wall = (
                f"{one.tenths[name][0]:.{digits}f} → {one.tenths[name][-1]:.{digits}f}"
                for name, digits in (("mb", 0), ("ms", 1), ("wall_ms", 1))
            )
            more, slower, machine = (f"{100 * one.growth(name):+.1f} %" for name in ("mb", "ms", "yardstick_ms"))
            frames = f"{one.frames} by {one.persons}"
            rows.append((one.mode, frames, str(one.nan), mb, more, ms, slower, wall, machine))
        note = "(first tenth → last tenth; machine: of the processor time of a fixed piece of work)"
        lines += [format_table(header, rows), note, ""]
    lines += [f"{tally.case} ({tally.mode}): {fault}" for tally in result.tallies for fault in tally.faults]
    lines += [f"left out: {text}" for text in result.left_out]
    if result.files:
        lines.append(f"worst cases: {result.files[0].parent}/*.npz, to be tried again with refu stress --replay FILE")
    lines.append("nothing failed" if not result.failures else f"{result.failures} FAILED")
    return "\n".join(lines)


def length(metres: float) -> str:
    """A length as text, in a unit that suits it."""
    if not math.isfinite(metres):
        return "-"
    for scale, unit in ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm")):
        if metres >= scale:
            return f"{metres / scale:.3g} {unit}"
    return "0" if metres < 1e-12 else f"{metres / 1e-12:.3g} pm"
