"""Loads pipelines beside the running one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from refu_ros._settings import PipelineKey

if TYPE_CHECKING:
    from refu_core import GarmentPipeline


class PipelineLoader:
    """A thread that loads the pipeline asked for last; requests it has been too slow for are forgotten."""

    def __init__(
        self, use: Callable[[GarmentPipeline, PipelineKey], None], fail: Callable[[Exception, PipelineKey], None]
    ) -> None:
        self._use, self._fail = use, fail
        self._wanted: PipelineKey | None = None
        self._pool = ThreadPoolExecutor(1, "loader")

    def request(self, key: PipelineKey) -> None:
        """Asks for a pipeline; returns at once."""
        self._wanted = key
        self._pool.submit(self._load, key)

    def close(self) -> None:
        """Ends the thread, after the load under way."""
        self._wanted = None
        self._pool.shutdown()

    def _load(self, key: PipelineKey) -> None:
        if key is not self._wanted:
            return
        try:
            pipeline = key.load()
        except Exception as error:  # missing weights, no CUDA: the running pipeline stays
            self._fail(error, key)
            return
        if key is self._wanted:
            self._use(pipeline, key)
