"""Soak: whether the pipeline grows or slows down as frames go by."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import SmplFrame
from refu_core.realtime import GarmentPipeline
from refu_core.stress._frames import between, everyday_pose, frame_of
from refu_core.stress._numbers import n_not_finite
from refu_core.stress._trial import StressError

TOLERANCE = 0.05
"""By how much the last tenth may exceed the first one."""
JUDGED_FROM = 20_000
"""Frames from which the 99th percentiles of a tenth are judged: of less they are the luck of a few frames."""
_POSES = 8
_STEPS = 25
_FEWEST = 10


@dataclass(frozen=True, kw_only=True)
class SoakResult:
    """The first tenth of many frames against the last one."""

    mode: str
    frames: int
    nan: int
    """Numbers that came out and aren't finite."""
    seconds: float
    memory_mb: tuple[float, float]
    """Largest resident memory of the first and the last tenth."""
    p99_ms: tuple[float, float]
    """99th percentile of a frame's processor time in the first and the last tenth [ms]."""
    wall_p99_ms: tuple[float, float]
    """The same of its wall time, which other processes lengthen [ms]."""

    @property
    def growth(self) -> float:
        """Of the memory, as a share of the first tenth's."""
        return self.memory_mb[1] / self.memory_mb[0] - 1

    @property
    def slowdown(self) -> float:
        """Of the processor time's 99th percentile, as a share of the first tenth's."""
        return self.p99_ms[1] / self.p99_ms[0] - 1

    @property
    def failures(self) -> int:
        """How many of memory and latency have grown too much; latencies of few frames aren't judged."""
        is_slow = self.slowdown > TOLERANCE and self.frames >= JUDGED_FROM
        return (self.growth > TOLERANCE) + is_slow + (self.nan > 0)

    def as_dict(self) -> dict[str, Any]:
        """A row of the results, ready for JSON."""
        return {
            "case": "soak: pipeline",
            "mode": self.mode,
            "runs": self.frames,
            "failures": self.failures,
            "nan": self.nan,
            "max_deviation_m": 0.0,
            "seconds": self.seconds,
            "memory_mb": self.memory_mb,
            "p99_ms": self.p99_ms,
            "wall_p99_ms": self.wall_p99_ms,
            "growth": self.growth,
            "slowdown": self.slowdown,
        }


def soak_frames(rng: np.random.Generator) -> list[SmplFrame]:
    """A motion of 200 frames whose end joins its beginning, on one body."""
    poses: list[NDArray[np.floating]] = [everyday_pose(rng) for _ in range(_POSES)]
    betas = rng.normal(0, 1, 10)
    return [frame_of(pose, betas=betas) for pose in between([*poses, poses[0]], _STEPS)]


def soak(
    pipeline: GarmentPipeline,
    *,
    mode: str,
    frames: int,
    seconds: float = math.inf,
    seed: int = 0,
    tick: Callable[[int], object] = int,
) -> SoakResult:
    """Runs the same motion over and over, until `frames` or `seconds` are over, and compares the tenths.

    `tick` is called with a number of frames that are done.

    Raises:
        StressError: fewer than ten frames, which have no tenths.
    """
    if frames < _FEWEST:
        msg = f"a soak needs {_FEWEST} frames or more, got {frames}"
        raise StressError(msg)
    motion = soak_frames(np.random.default_rng(seed))
    for frame in motion:  # what is made in the first frames of all is no growth
        pipeline(frame)
    # Room for all figures, touched now: it mustn't look like the pipeline's growth.
    cpu, wall, memory = np.zeros((3, frames), np.float32) + 1
    start, n, nan = time.perf_counter(), 0, 0
    while n < frames and (n < _FEWEST or time.perf_counter() - start < seconds):
        cpu_before, before = time.thread_time(), time.perf_counter()
        out = pipeline(motion[n % len(motion)])
        wall[n] = 1e3 * (time.perf_counter() - before)
        cpu[n] = 1e3 * (time.thread_time() - cpu_before)
        nan += n_not_finite(*(mesh.local for mesh in out.values()))
        memory[n] = resident_mb()
        n += 1
        tick(1)
    first, last = slice(0, n // 10), slice(n - n // 10, n)
    return SoakResult(
        mode=mode,
        frames=n,
        nan=nan,
        seconds=time.perf_counter() - start,
        memory_mb=(float(memory[first].max()), float(memory[last].max())),
        p99_ms=(_p99(cpu[first]), _p99(cpu[last])),
        wall_p99_ms=(_p99(wall[first]), _p99(wall[last])),
    )


def resident_mb(process: int | str = "self") -> float:
    """Resident memory of a process [MB]; raises `OSError` where there is none of that number."""
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * _PAGE_MB


def _page_mb() -> float:
    import resource

    return resource.getpagesize() / 1e6


_PAGE_MB = _page_mb()


def _p99(values: NDArray[np.float32]) -> float:
    return float(np.percentile(values, 99))
