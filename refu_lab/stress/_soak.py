"""Soak: whether the pipeline's memory grows, or it slows down, as frames go by."""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import SmplFrame
from refu_core.realtime import GarmentPipeline
from refu_lab.stress._frames import between, everyday_pose, frame_of
from refu_lab.stress._numbers import n_not_finite
from refu_lab.stress._trial import StressError

TOLERANCE = 0.05
"""Share by which the last tenth may exceed the first one."""
JUDGED_FROM = 20_000
"""Calls from which on 99th percentiles are judged: with fewer, those of a tenth depend on the luck of a few frames."""
_POSES = 8
_STEPS = 25
_FEWEST = 10
_YARDSTICK = 192
"""Size of the matrix that the yardstick multiplies, which takes a fifth of a millisecond."""


@dataclass(frozen=True, kw_only=True)
class SoakResult:
    """The tenths of a long run, of which the last is compared with the first."""

    mode: str
    frames: int
    """Persons dressed."""
    persons: int
    """Persons in one call."""
    nan: int
    """Numbers in the output that aren't finite."""
    seconds: float
    tenths: Mapping[str, tuple[float, ...]]
    """In each tenth: the largest resident memory (`mb`), and 99th percentiles of a call's processor time (`ms`), of its
    wall time, which other processes lengthen (`wall_ms`), and of the yardstick's processor time (`yardstick_ms`)."""

    def growth(self, what: str) -> float:
        """Growth from the first to the last tenth of one of `tenths`, as a share of the first."""
        return self.tenths[what][-1] / self.tenths[what][0] - 1

    @property
    def failures(self) -> int:
        """How many of these failed: memory, latency (given enough calls, by clock and by yardstick), numbers."""
        times, is_judged = 1 + self.growth("ms"), self.frames >= JUDGED_FROM * self.persons
        slower = is_judged and is_slower(times, times, 1 + self.growth("yardstick_ms"))
        return (self.growth("mb") > TOLERANCE) + slower + (self.nan > 0)

    def as_dict(self) -> dict[str, Any]:
        row: dict[str, Any] = {"case": "soak: pipeline", "runs": self.frames, "max_deviation_m": 0.0}
        row |= {name: getattr(self, name) for name in ("mode", "persons", "nan", "seconds", "failures")}
        row |= {f"tenths_{name}": values for name, values in self.tenths.items()}
        growths = (("growth", "mb"), ("slowdown", "ms"), ("machine_slowdown", "yardstick_ms"))
        return row | {name: self.growth(what) for name, what in growths}


def soak_frames(rng: np.random.Generator) -> list[SmplFrame]:
    """A motion of 200 frames that can be looped, on one body."""
    poses: list[NDArray[np.floating]] = [everyday_pose(rng) for _ in range(_POSES)]
    betas = rng.normal(0, 1, 10)
    return [frame_of(pose, betas=betas) for pose in between([*poses, poses[0]], _STEPS)]


def soak(
    pipeline: GarmentPipeline,
    *,
    mode: str,
    frames: int,
    persons: int = 1,
    seconds: float = math.inf,
    seed: int = 0,
    tick: Callable[[int], object] = int,
) -> SoakResult:
    """Runs the same motions over and over, until `frames` or `seconds` are reached, and measures each tenth of the run.

    Each of the `persons` in a call has their own motion and counts as a frame; `tick` is called with the number of
    frames after each call. After an interrupt (Ctrl-C) the tenths are those of the run so far; it is raised where fewer
    than ten calls have been made, which have none. Raises `StressError`: `frames` give fewer than ten calls.
    """
    calls = -(-frames // persons)
    if calls < _FEWEST:
        raise StressError(f"a soak needs {_FEWEST} frames or more of each person, got {calls}")
    steps = list(zip(*(soak_frames(np.random.default_rng(seed + i)) for i in range(persons)), strict=True))
    for step in steps:  # what the very first frames allocate isn't growth
        pipeline(step)
    log = np.ones((4, calls), np.float32)  # ones, so that its memory is touched now and doesn't look like growth
    yardstick, nan, n = Yardstick(), 0, 0
    start = time.perf_counter()
    try:
        while n < calls and (n < _FEWEST or time.perf_counter() - start < seconds):
            cpu, wall = time.thread_time(), time.perf_counter()
            outs = pipeline(steps[n % len(steps)])
            wall, cpu = 1e3 * (time.perf_counter() - wall), 1e3 * (time.thread_time() - cpu)
            same = yardstick.measure()
            nan += n_not_finite(*(mesh.local for out in outs for mesh in out.values()))
            log[:, n] = resident_mb(), cpu, wall, same
            n += 1
            tick(persons)
    except KeyboardInterrupt:
        if n < _FEWEST:
            raise
    tenths = {
        name: tuple(float(np.percentile(tenth, share)) for tenth in np.array_split(row[:n], 10))
        for (name, share), row in zip(
            (("mb", 100), ("ms", 99), ("wall_ms", 99), ("yardstick_ms", 99)), log, strict=True
        )
    }
    seconds = time.perf_counter() - start
    return SoakResult(mode=mode, frames=n * persons, persons=persons, nan=nan, seconds=seconds, tenths=tenths)


class Yardstick:
    """Work that is always the same: it takes longer when the machine slows down, but not when something leaks."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self._matrix = rng.normal(size=(_YARDSTICK, _YARDSTICK)).astype(np.float32)
        self._rows = rng.integers(_YARDSTICK, size=8 * _YARDSTICK)

    def measure(self) -> float:
        """Does the work once; returns its processor time [ms]."""
        before = time.thread_time()
        (self._matrix @ self._matrix)[self._rows].sum()
        return 1e3 * (time.thread_time() - before)


def resident_mb(process: int | str = "self") -> float:
    """Resident memory of a process [MB]; raises `OSError` if there is no such process."""
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6


def is_slower(later: float, longer: float, machine: float) -> bool:
    """Whether answers that come `later` times as late, and take `longer` times as long to compute, are too slow.

    `machine` is how many times as long the yardstick takes: a slower machine isn't held against the pipeline. Nor is
    lateness alone, which any other process that needs the processor can cause.
    """
    return min(later, longer / machine) > 1 + TOLERANCE
