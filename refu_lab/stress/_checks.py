"""The table of checks: what each one draws and measures, how often, and which modes promise it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import FrameError
from refu_core.frames import N_BETAS, N_STYLES
from refu_lab.stress import _guarantees as guarantees
from refu_lab.stress import _invariance as invariance
from refu_lab.stress import _numbers as numbers
from refu_lab.stress._frames import FRAMES, Draw, between, everyday, everyday_pose, frame_of, promised
from refu_lab.stress._trial import Check, Trial

DrawTrial = Callable[[np.random.Generator], Trial]

_FRAMES = 64
"""Frames in a trial of numbers, and persons in a batch."""
_STEPS = 24
"""Frames of a motion."""


def _many(draw: Draw) -> DrawTrial:
    """Draws trials of 64 frames; the pipeline never sees those that `SmplFrame` itself refuses."""

    def trial(rng: np.random.Generator) -> Trial:
        frames = []
        for _ in range(_FRAMES):
            with contextlib.suppress(FrameError):
                frames.append(draw(rng))
        return Trial(tuple(frames), refused=_FRAMES - len(frames))

    return trial


def _calm(share: float, *, in_room: bool = False) -> DrawTrial:
    """Draws scaled-down everyday poses, in which most bodies don't touch themselves, at the origin or in a room."""

    def trial(rng: np.random.Generator) -> Trial:
        pose, betas = share * everyday_pose(rng), rng.normal(0, 1, N_BETAS)
        transl = rng.normal(0, 3, 3) if in_room else np.zeros(3)
        return Trial((frame_of(pose, betas, transl),), int(rng.integers(2**31)))

    return trial


_calm_day = _calm(0.6, in_room=True)


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
    return Trial(tuple(frame_of(pose, betas, style=style) for pose in between(poses, _STEPS)))


def _folding(rng: np.random.Generator) -> Trial:
    """Motion from an everyday pose to one with limbs through the trunk."""
    last = FRAMES["limbs through the trunk"](rng)
    poses: list[NDArray[np.floating]] = [0.7 * everyday_pose(rng), last.pose]
    return Trial(tuple(frame_of(pose, last.betas) for pose in between(poses, _STEPS)))


def _teleport(rng: np.random.Generator) -> Trial:
    """Frames each of which is far from the one before."""
    names = ("everyday", "any rotation of any joint", "limbs through the trunk", "betas of 5", "angles beyond a turn")
    return Trial((*(FRAMES[name](rng) for name in rng.permutation(names)), everyday(rng)))


def _crowd(rng: np.random.Generator) -> Trial:
    return Trial(tuple(_calm(0.6)(rng).frames[0] for _ in range(_FRAMES)))


CHECKS: dict[str, Check] = {
    check.name: check
    for check in (
        *(Check(f"numbers: {name}", _many(draw), numbers.against_float64) for name, draw in FRAMES.items()),
        Check(
            "numbers: collider, everyday", _many(FRAMES["everyday"]), partial(numbers.against_float64, on_collider=True)
        ),
        *(
            Check(f"numbers: distance, {name}", _calm(0.5), numbers.distances(place))
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
        Check("invariance: the person turned", _calm(0.6), invariance.turned, trials=2, repeats=1),
        Check("invariance: the person 100 km away", _calm(0.6), invariance.moved, trials=2, repeats=1),
        Check("invariance: left and right exchanged", _calm(0.6), invariance.mirrored, repeats=1),
        Check("invariance: what came before", _teleport, invariance.history, repeats=2),
        Check("invariance: a batch of 64, predicted", _crowd, invariance.batch, repeats=invariance.ALONE),
        Check("invariance: a batch of 64, resolved", _crowd, invariance.batch_resolved, repeats=invariance.ALONE),
    )
}
"""All checks by name; each round runs them in this order."""
