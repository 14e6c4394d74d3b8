"""The frame steps that a pipeline's calls compute with, so that several calls may run at the same time."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cached_property, partial
from queue import Empty, LifoQueue

import torch

from refu_core.errors import RefuError
from refu_core.frames import SmplFrame
from refu_core.realtime._frame import FrameStep, shares
from refu_core.realtime._outputs import PipelineOutput

Work = Callable[[FrameStep, Sequence[SmplFrame]], list[PipelineOutput]]
_ON_GPU = threading.Lock()
"""Shared by all pipelines on a GPU: the stream that Warp works on is the device's, not the thread's."""


class Crew:
    """Frame steps, each with memory of its own: every call takes one, and free ones help with a batch."""

    def __init__(self, steps: Sequence[FrameStep], *, on_gpu: bool) -> None:
        self._n_steps = len(steps)
        self._process, self._free = os.getpid(), LifoQueue[FrameStep]()  # the one used last has its memory in the cache
        for step in steps:
            self._free.put(step)
        self._device: contextlib.AbstractContextManager[object] = _ON_GPU if on_gpu else contextlib.nullcontext()

    @contextlib.contextmanager
    def turn(self) -> Iterator[FrameStep]:
        """The step that one call computes with, as soon as one is free. Raises `RefuError` if none ever will be."""
        try:
            step = self._free.get(block=os.getpid() == self._process)  # after a fork no other thread will free one
        except Empty as error:
            msg = "this pipeline was busy when its process was forked: load one in each process, after the fork"
            raise RefuError(msg) from error
        try:
            with self._device:
                yield step
        finally:
            self._free.put(step)

    def share(self, step: FrameStep, work: Work, frames: Sequence[SmplFrame]) -> list[PipelineOutput]:
        """Does `work` on frames, which are shared out among `step` and all steps that are free."""
        steps = [step]
        with contextlib.suppress(Empty):
            while len(steps) < len(frames) and os.getpid() == self._process:
                steps.append(self._free.get_nowait())
        own, *others = (frames[part] for part in shares(len(frames), len(steps)))
        started: list[Future[list[PipelineOutput]]] = []
        try:
            started += (self._pool.submit(work, *pair) for pair in zip(steps[1:], others, strict=True))
            done = work(step, own)
        finally:
            wait(started)  # before that nobody else may take a step
            for other in steps[1:]:
                self._free.put(other)
        return [*done, *(one for part in started for one in part.result())]

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self._n_steps - 1, "dress", initializer=partial(torch.set_num_threads, 1))
