"""The garbage collector of a process in which torch and Warp keep 340,000 objects for good."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


def collect_rarely() -> None:
    """Has the collector of a program run a hundredth as often: with Python's thresholds it is a quarter of the start.

    To be called before torch is imported.
    """
    gc.set_threshold(50_000, 20, 20)


def keep_what_is_loaded() -> None:
    """Takes all that there is out of the collector's sight: to go through it would stop every thread for 0.4 s."""
    gc.freeze()


@contextmanager
def paused() -> Iterator[None]:
    """Without the collector, as long as modules are imported."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
