"""An engine that simulates the samples of a set on a GPU, many at a time, and leaves all else to the processor's cores.

Bodies, cuts and checks of a sample are those of `SlotSimulator`, in processes of their own; its cloth is in a lane of
`ClothLanes`. A lane whose cloth has come to rest gets the next sample's at once.
"""

from __future__ import annotations

import os
import pickle
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from refu_core._device import checked_device
from refu_core.errors import SimulationError
from refu_core.frames import N_BETAS
from refu_core.simulation._cloth import F32, ClothCut, CourseStep
from refu_core.simulation._drape import CANONICAL_POSE, Course, sent
from refu_core.simulation._lanes import ClothLanes
from refu_core.simulation._store import CAUSES, GIVEN_UP
from refu_core.simulation._worker import SlotSimulator

_Attempt = tuple[int, int]
"""A slot, and which of its poses is tried."""


@dataclass(frozen=True, eq=False)
class _Courses:
    """What the attempts at slots of one pair need before they are simulated."""

    cut: ClothCut
    courses: list[Course]
    first: tuple[F32, Course] | None
    """For the first attempts, the garment as it is put on, and the way to the canonical drape."""


_AHEAD = 2
"""Attempts for each lane that are prepared ahead: lanes are full while blocks wait for their canonical drapes."""

_simulator: SlotSimulator
"""A helping process's own."""


def _begin(make: Path) -> None:
    global _simulator
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the command, which ends its helpers
    torch.set_num_threads(1)
    _simulator = pickle.loads(make.read_bytes())()


def _prepare(attempts: list[_Attempt], is_first: bool) -> _Courses:
    draper, plan = _simulator.draper, _simulator.plan
    betas, style = plan.style_shape(plan.pair_of(attempts[0][0]))
    canonical = draper.canonical_course(betas) if is_first else None
    body = draper.bodies(CANONICAL_POSE[None], betas)[0]
    cut = draper.cut(betas, style)
    courses = [draper.course(_simulator.tried(*attempt)[0], betas, body) for attempt in attempts]
    return _Courses(cut, courses, None if canonical is None else (draper.dressed(betas, style, canonical), canonical))


def _judge(attempt: _Attempt, cut: ClothCut, positions: F32, speed: float) -> tuple[str | None, dict[str, Any]]:
    row, (pose, clip, frame) = _simulator.begun(attempt[0]), _simulator.tried(*attempt)
    upright = pose.copy()
    upright[0] = 0
    body = _simulator.draper.bodies(upright[None], row["betas"])[0]
    drape = _simulator.draper.settled(positions, body, cut, pose, row["betas"], speed=speed)
    cause, taken = _simulator.judged(drape, pose, row["betas"])
    return cause, row | taken | {"pose": pose, "clip": clip, "frame": frame}


@dataclass(eq=False)
class _Block:
    """Slots of one pair that are simulated from one canonical drape."""

    index: int
    slots: list[int]
    drape: F32 | None = None
    """The canonical drape, once it has settled."""
    waiting: list[tuple[ClothCut, Course, _Attempt]] = field(default_factory=list)
    """What waits for it."""
    rows: dict[int, dict[str, Any]] = field(default_factory=dict)
    dropped: dict[int, Any] = field(default_factory=dict)


@dataclass(eq=False)
class _Job:
    """A course of a block's cloth: to its canonical drape, or an attempt at a slot."""

    block: _Block
    cut: ClothCut
    course: Course
    attempt: _Attempt | None
    speed: float = np.inf

    def __post_init__(self) -> None:
        self.steps = self.course.steps()
        self.step: CourseStep | None = next(self.steps)


class LaneEngine:
    """Runs blocks of a `SlotSimulator`'s slots; an `Engine` for `simulate_dataset`."""

    def __init__(self, device: str = "cuda", *, lanes: int = 256, jobs: int | None = None) -> None:
        """For this many samples at a time on a device, with `jobs` processes beside, by default one a core but one.

        Raises `RefuError` for no such device.
        """
        self._device, self._lanes = checked_device(device), lanes
        self._jobs = jobs or max((os.cpu_count() or 2) - 1, 1)

    def run(self, make: Callable[[], Callable[[Any], Any]], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        """Yields each block's number and rows. `make` must make a `SlotSimulator`.

        Raises `SimulationError` when a helping process is killed, or `make` makes something else.
        """
        simulator = make()
        if not isinstance(simulator, SlotSimulator):
            raise SimulationError(f"a GPU simulates garments at rest, got {type(simulator).__name__}: take the cpu")
        spawning = get_context("spawn")  # a fork of a process that has a GPU can't use torch
        with TemporaryDirectory() as folder:
            # In a file: what doesn't fit into a pipe would keep each process from being started beside the last.
            made = Path(folder) / "make.pickle"
            made.write_bytes(pickle.dumps(make))
            with ProcessPoolExecutor(self._jobs, spawning, _begin, (made,)) as pool:
                try:
                    yield from _Run(simulator, pool, tasks, self._lanes, self._device).blocks()
                except BrokenProcessPool as error:
                    msg = "a helping process was killed (out of memory?): run the same again"
                    raise SimulationError(msg) from error
                finally:
                    pool.shutdown(wait=False, cancel_futures=True)


class _Run:
    """The work on some blocks: what is prepared, what is in lanes, what is judged."""

    def __init__(
        self,
        simulator: SlotSimulator,
        pool: ProcessPoolExecutor,
        tasks: Sequence[list[int]],
        lanes: int,
        device: torch.device,
    ) -> None:
        draper, how = simulator.draper, simulator.settings.drape
        self._simulator, self._pool, self._tasks = simulator, pool, tasks
        self._lanes = ClothLanes(
            draper.topology,
            draper.body.rest_vertices(torch.zeros(1, N_BETAS))[0].numpy(),
            draper.body.faces.numpy(),
            anchored=draper.waist.astype(np.int32),
            lanes=lanes,
            most_bodies=1 + max(how.lower_frames, how.move_frames[1]),
            device=device,
            settings=how.cloth,
        )
        self._jobs: list[_Job | None] = [None] * lanes
        self._ready: deque[_Job] = deque()
        self._asked: dict[Future[Any], Callable[[Any], None]] = {}
        self._done: deque[_Block] = deque()
        self._next, self._left = 0, len(tasks)
        self._ahead = 0  # attempts that no lane has yet
        self._since = time.perf_counter()

    def blocks(self) -> Iterator[tuple[int, list[dict[str, Any]]]]:
        """Each block's number and rows, as they are finished."""
        while self._left:
            self._prepare_ahead()
            self._fill()
            is_idle = all(job is None for job in self._jobs)
            self._collect(None if is_idle else 0.0)
            if not is_idle:
                self._frame()
            while self._done:
                block = self._done.popleft()
                self._left -= 1
                yield block.index, [block.rows[slot] for slot in block.slots]

    def _prepare_ahead(self) -> None:
        """Has blocks prepared, so that no lane is ever without an attempt."""
        while self._next < len(self._tasks) and self._ahead < _AHEAD * len(self._jobs):
            block = _Block(self._next, list(self._tasks[self._next]))
            self._next += 1
            self._ask_for(block, [(slot, 0) for slot in block.slots], is_first=True)

    def _ask_for(self, block: _Block, attempts: list[_Attempt], *, is_first: bool = False) -> None:
        def take(prepared: _Courses) -> None:
            block.waiting += [(prepared.cut, *one) for one in zip(prepared.courses, attempts, strict=True)]
            if prepared.first is None:
                self._release(block)
            else:
                block.drape, canonical = prepared.first
                self._ready.append(_Job(block, prepared.cut, canonical, None))

        self._ahead += len(attempts)
        self._asked[self._pool.submit(_prepare, attempts, is_first)] = take

    def _release(self, block: _Block) -> None:
        """Attempts that waited for the block's canonical drape are ready."""
        self._ready.extend(_Job(block, *waiting) for waiting in block.waiting)
        block.waiting = []

    def _fill(self) -> None:
        """Puts what is ready into empty lanes."""
        for lane, job in enumerate(self._jobs):
            if job is None and self._ready:
                self._jobs[lane] = job = self._ready.popleft()
                assert job.block.drape is not None
                self._ahead -= job.attempt is not None
                self._lanes.load(lane, job.cut, job.block.drape, job.course.bodies)

    def _frame(self) -> None:
        """Takes all lanes a frame further, and empties those that have come to their end."""
        speeds = self._lanes.frame([None if job is None else job.step for job in self._jobs])
        for lane, job in enumerate(self._jobs):
            if job is None:
                continue
            job.speed = float(speeds[lane])
            job.step = sent(job.steps, job.speed)
            if job.step is None:
                self._jobs[lane] = None
                positions = self._lanes.positions(lane)
                if job.attempt is None:
                    job.block.drape = positions
                    self._release(job.block)
                else:
                    self._ask_of(job, positions)

    def _ask_of(self, job: _Job, positions: F32) -> None:
        assert job.attempt is not None
        block, (slot, attempt) = job.block, job.attempt

        def take(judged: tuple[str | None, dict[str, Any]]) -> None:
            cause, row = judged
            dropped = block.dropped.setdefault(slot, np.zeros(len(CAUSES), np.uint8))
            if cause is not None:
                dropped[CAUSES.index(cause)] += 1
                if attempt + 1 < self._simulator.settings.attempts:
                    self._ask_for(block, [(slot, attempt + 1)])
                    return
                row = self._simulator.begun(slot) | {"state": GIVEN_UP}
            now = time.perf_counter()
            block.rows[slot] = row | {"dropped": dropped, "seconds": now - self._since}
            self._since = now
            if len(block.rows) == len(block.slots):
                self._done.append(block)

        self._asked[self._pool.submit(_judge, job.attempt, job.cut, positions, job.speed)] = take

    def _collect(self, timeout: float | None) -> None:
        """Takes what helping processes have done; without a timeout, waits for something."""
        done, _ = wait(self._asked, timeout=timeout, return_when=FIRST_COMPLETED)
        for future in done:
            self._asked.pop(future)(future.result())
