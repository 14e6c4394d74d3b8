"""The frame steps that a pipeline's calls compute with, so that several calls may run at the same time."""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property, partial
from itertools import islice
from queue import Empty, SimpleQueue
from typing import TypeVar
from weakref import WeakSet

import torch

from refu_core.errors import RefuError
from refu_core.frames import SmplFrame
from refu_core.realtime._frame import FrameStep, shares
from refu_core.realtime._outputs import PipelineOutput

T = TypeVar("T")
Work = Callable[[FrameStep, Sequence[SmplFrame]], list[PipelineOutput]]
_ENDING = threading.Event()
"""Set once Python ends: daemon threads are then stopped before they call a pipeline."""
_ON_GPU = threading.Lock()
"""Shared by all pipelines on a GPU: the stream that Warp works on is the device's, not the thread's."""


class Crew:
    """Frame steps, each with memory of its own: every call takes one, and free ones help with a batch."""

    def __init__(self, steps: Sequence[FrameStep], *, on_gpu: bool) -> None:
        self._n_steps = len(steps)
        _CREWS.add(self)
        self._process, self._free = os.getpid(), SimpleQueue[FrameStep]()
        for step in steps:
            self._free.put(step)
        self._device: contextlib.AbstractContextManager[object] = _ON_GPU if on_gpu else contextlib.nullcontext()

    def call(self, work: Callable[[FrameStep], T]) -> T:
        """Does `work` with a step, as soon as one is free. Raises `RefuError` if none ever will be."""
        if _ENDING.is_set() and threading.current_thread().daemon:
            threading.Event().wait()  # for ever, as from Python 3.14 on
        try:
            return self._with_step(work, wait=os.getpid() == self._process)  # after a fork no other thread frees one
        except Empty as error:
            msg = "this pipeline was busy when its process was forked: load one in each process, after the fork"
            raise RefuError(msg) from error

    def _with_step(self, work: Callable[[FrameStep], T], *, wait: bool) -> T:
        """Raises `Empty` where no step is free and it doesn't `wait` for one.

        Every later call would wait for a step that is lost. Ctrl-C comes between two instructions of Python, so a step
        is taken, and given back, in one.
        """
        held: list[FrameStep] = []
        take, give_back = islice(iter(partial(self._free.get, wait), None), 1), map(self._free.put, held)
        try:
            held.extend(take)
            with self._device:
                return work(held[0])
        finally:
            any(give_back)

    def share(self, step: FrameStep, work: Work, frames: Sequence[SmplFrame]) -> list[PipelineOutput]:
        """Does `work` on frames, which are shared out among `step` and all steps that are free."""
        if len(frames) == 1:
            return work(step, frames)
        n_free = self._free.qsize() if os.getpid() == self._process else 0
        own, *others = (frames[part] for part in shares(len(frames), min(len(frames), 1 + n_free)))
        started: list[Future[list[PipelineOutput] | None]] = []
        with contextlib.suppress(RuntimeError):  # while Python ends it starts no thread
            started.extend(self._pool.submit(self._help, work, part) for part in others)
        done = list(work(step, own))
        for k, part in enumerate(others):
            made = started[k].result() if k < len(started) and not started[k].cancel() else None
            done += work(step, part) if made is None else made
        return done

    def _help(self, work: Work, frames: Sequence[SmplFrame]) -> list[PipelineOutput] | None:
        """Does `work` in a thread of the pool; None if another call has taken the last free step meanwhile."""
        with contextlib.suppress(Empty):
            return self._with_step(lambda step: work(step, frames), wait=False)
        return None

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._n_steps - 1, "dress", initializer=partial(torch.set_num_threads, 1))

    def come_to_rest(self) -> None:
        """Waits until no call is going on, for a second at most."""
        steps: list[FrameStep] = []
        with contextlib.suppress(Empty):
            steps.extend(self._free.get(timeout=1.0) for _ in range(self._n_steps))
        any(map(self._free.put, steps))


_CREWS = WeakSet[Crew]()


@atexit.register
def _end() -> None:
    """Lets daemon threads finish their frames: Python kills them as native code returns, and the process aborts."""
    _ENDING.set()
    for crew in [*_CREWS]:
        crew.come_to_rest()
