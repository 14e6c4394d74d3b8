"""Loads pipelines beside the running one."""

from __future__ import annotations

import threading
from collections.abc import Callable

from refu_core import GarmentPipeline
from refu_ros._settings import PipelineKey


class PipelineLoader:
    """A thread that loads the pipeline asked for last; requests it has been too slow for are forgotten."""

    def __init__(
        self, use: Callable[[GarmentPipeline, PipelineKey], None], fail: Callable[[Exception, PipelineKey], None]
    ) -> None:
        self._use = use
        self._fail = fail
        self._changed = threading.Condition()
        self._wanted: PipelineKey | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="loader")
        self._thread.start()

    def request(self, key: PipelineKey) -> None:
        """Asks for a pipeline; returns at once."""
        with self._changed:
            self._wanted = key
            self._changed.notify()

    def close(self) -> None:
        """Ends the thread, after the load under way."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._wanted is None and not self._closed:
                    self._changed.wait()
                if self._closed or self._wanted is None:
                    return
                key, self._wanted = self._wanted, None
            try:
                pipeline = key.load()
            except Exception as error:  # missing weights, no CUDA: the running pipeline stays
                self._fail(error, key)
                continue
            with self._changed:
                current = self._wanted is None and not self._closed
            if current:
                self._use(pipeline, key)
