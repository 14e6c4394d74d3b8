"""Dresses single frames beside the stream: in a thread of its own, with pipelines of its own."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters.axes import SMPL_COLUMNS
from refu_core import RefuError, SmplFrame
from refu_ros._settings import NodeSettings, PipelineKey

if TYPE_CHECKING:
    from refu_core import GarmentPipeline
    from refu_core.realtime import PipelineOutput

Then = Callable[["PipelineOutput", dict[str, NDArray[np.float64]]], object]

_MOST_WAITING = 8
"""Requests that may wait: who asks more often than frames can be dressed is told so."""
_MOST_PIPELINES = 2
NICE = 10
"""Who asks for a frame waits for those whose garments are to be there 30 times a second."""


class Dresser:
    """`ask` belongs to one thread. What it makes doesn't depend on who is on the node's topics, or was."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._waiting = threading.BoundedSemaphore(_MOST_WAITING)
        self._pipelines: OrderedDict[PipelineKey, GarmentPipeline] = OrderedDict()

    def ask(self, frame: SmplFrame, settings: NodeSettings, then: Then) -> Future[object]:
        """What `then` makes of the output, and of each garment's vertices in the frame of the messages [m], (V, 3).

        Raises `RefuError` where too many wait.
        """
        if not self._waiting.acquire(blocking=False):
            msg = f"{_MOST_WAITING} requests wait already: ask again when one has been answered"
            raise RefuError(msg)
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "dresser", initializer=_give_way)
        asked = self._pool.submit(self._dress, frame, settings, then)
        asked.add_done_callback(lambda _: self._waiting.release())
        return asked

    def close(self) -> None:
        """Waits for the frame that is being dressed."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        self._pool = None
        self._pipelines.clear()

    def _dress(self, frame: SmplFrame, settings: NodeSettings, then: Then) -> object:
        pipeline = self._pipeline(settings)
        from refu_ros._worker import with_settings  # loads torch

        frame = with_settings(frame, settings)
        output = pipeline(frame)
        rotation = np.eye(3)[list(SMPL_COLUMNS[settings.axes])]
        placed = {name: (mesh.local + frame.transl) @ rotation.T for name, mesh in output.items()}
        if not all(np.isfinite(points).all() for points in placed.values()):
            msg = "a garment isn't finite in this pose"
            raise RefuError(msg)
        return then(output, placed)

    def _pipeline(self, settings: NodeSettings) -> GarmentPipeline:
        key = replace(settings.pipeline, threads=1)
        pipeline = self._pipelines.pop(key, None) or key.load()
        pipeline.margin = settings.margin
        self._pipelines[key] = pipeline
        while len(self._pipelines) > _MOST_PIPELINES:
            self._pipelines.popitem(last=False)
        return pipeline


def _give_way() -> None:
    import torch

    torch.set_num_threads(1)
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)  # to Linux a thread is a process
