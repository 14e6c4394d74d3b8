"""Comparable times: contenders take turns in one process on one core, measured in processor time; and their rows."""

from __future__ import annotations

import contextlib
import gc
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter, process_time
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core._device import one_thread

Input = TypeVar("Input")


@dataclass(frozen=True, eq=False)
class Timing:
    """How long one contender took, call by call."""

    cpu_ms: NDArray[np.float64]
    """Processor time of each call, all threads of the process together [ms], shape (n,)."""
    wall_ms: NDArray[np.float64]
    """Wall time of each call [ms], shape (n,)."""
    on_gpu: bool = False
    """Whether the work was done on a GPU, so that only wall time measures it."""

    @property
    def ms(self) -> NDArray[np.float64]:
        """The times to compare [ms], shape (n,): processor time undisturbed by other processes; on a GPU, wall time."""
        return self.wall_ms if self.on_gpu else self.cpu_ms

    @property
    def median(self) -> float:
        """[ms]."""
        return float(np.median(self.ms))


@contextlib.contextmanager
def one_core() -> Iterator[int]:
    """Keeps the block to one thread on one core; yields the core's number."""
    allowed = os.sched_getaffinity(0)
    core = max(allowed)
    os.sched_setaffinity(0, {core})
    try:
        with one_thread():
            yield core
    finally:
        os.sched_setaffinity(0, allowed)


@contextlib.contextmanager
def processor_clock() -> Iterator[None]:
    """Inside the block, `time.perf_counter` gives processor time.

    A pipeline measures its stages in wall time, which is what its user wants to know. On a shared machine that says
    more about the other users.
    """
    clock = time.perf_counter
    vars(time)["perf_counter"] = time.process_time
    try:
        yield
    finally:
        vars(time)["perf_counter"] = clock


def measure(
    contenders: Mapping[str, Callable[[Input], object]],
    windows: Sequence[Sequence[Input]],
    *,
    rounds: int,
    slow: Collection[str] = (),
    on_gpu: bool = False,
    progress: Callable[[], object] = lambda: None,
) -> dict[str, Timing]:
    """Times contenders on the same inputs, in turn, so that a machine that gets slower gets slower for all of them.

    Args:
        contenders: What is timed, by name. Their order rotates by one with each window.
        windows: Inputs in sequence, at least two a window. The first of a window is a jump for contenders that
            remember the last input; it warms them up and isn't counted.
        rounds: How often every window is run.
        slow: Contenders that are timed on one input of each of the first two windows only, in the first round.
        on_gpu: Wait for the GPU before and after each call.
        progress: Called after every window of a contender.
    """
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in contenders}
    finish: Callable[[], object] = torch.cuda.synchronize if on_gpu else lambda: None
    names = list(contenders)
    gc.collect()
    gc.disable()  # a collection would charge one contender for the garbage of all
    try:
        for turn in range(rounds * len(windows)):
            window = windows[turn % len(windows)]
            start = turn % len(names)
            for name in (*names[start:], *names[:start]):
                if name in slow and turn >= min(2, len(windows)):
                    continue
                run = contenders[name]
                if name not in slow:
                    run(window[0])
                for given in window[1:2] if name in slow else window[1:]:
                    finish()
                    wall, cpu = perf_counter(), process_time()
                    run(given)
                    finish()
                    times[name].append((1e3 * (process_time() - cpu), 1e3 * (perf_counter() - wall)))
                progress()
    finally:
        gc.enable()
    found = {name: np.array(pairs) for name, pairs in times.items()}
    return {name: Timing(pairs[:, 0], pairs[:, 1], on_gpu=on_gpu) for name, pairs in found.items()}


@dataclass(frozen=True, kw_only=True)
class BenchmarkRow:
    stage: str
    """What was measured: `sdf`, `frame`, `frame.<stage>`, `persons`, `unchanged` or `start`."""
    mode: str
    """The pipeline's mode, or `plain`, `paper` or `other`."""
    garment: str
    ms_median: float
    """Median processor time; on a GPU, wall time [ms]."""
    ratio: float
    """Ratio of this time to that of the plain query (`PLAIN_QUERY`), measured in turn with it."""
    ms_q1: float | None = None
    ms_q3: float | None = None
    wall_ms_median: float | None = None
    samples: int = 1
    device: str = "cpu"
    method: str | None = None
    backbone: str | None = None
    persons: int | None = None
    vertices: int | None = None
    figures: Mapping[str, float] = field(default_factory=dict)
    """Further figures, by name with unit."""

    @classmethod
    def of(cls, timing: Timing, plain: Timing, **facts: Any) -> BenchmarkRow:
        """A row from a timing, and from that of the plain query measured in turn with it."""
        low, high = map(float, np.percentile(timing.ms, (25, 75)))
        spread: dict[str, Any] = {"ms_q1": low, "ms_q3": high, "wall_ms_median": float(np.median(timing.wall_ms))}
        ratio = timing.median / plain.median
        return cls(ms_median=timing.median, ratio=ratio, samples=len(timing.ms), **spread, **facts)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; what doesn't apply is left out."""
        values = {key: value for key, value in vars(self).items() if value is not None and key != "figures"}
        return {**values, **self.figures}


@dataclass(eq=False)
class BenchmarkResult:
    """Everything that the tables, the plot and the JSON file need."""

    command: str
    quick: bool
    machine: dict[str, Any] = field(default_factory=dict)
    rows: list[BenchmarkRow] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    """What wasn't measured, and what is needed to measure it."""

    def of(self, stage: str, **facts: Any) -> list[BenchmarkRow]:
        """The rows of a stage whose fields have the values in `facts`."""
        return [
            row
            for row in self.rows
            if row.stage == stage and all(getattr(row, key) == value for key, value in facts.items())
        ]

    def as_dict(self) -> dict[str, Any]:
        return vars(self) | {"rows": [row.as_dict() for row in self.rows]}
