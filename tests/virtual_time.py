"""Time that only the test moves: what waits or sleeps by it takes exactly as long as it may, however busy the machine.

A thread under test runs in the test's own, from one wait to the next; whatever others do to it meanwhile is an event
of its own, at a moment that the test names.
"""

from __future__ import annotations

import heapq
import itertools
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest


class VirtualTime:
    """Stands for the modules `time` and `threading`, where these are used for a clock, pauses and a single thread."""

    def __init__(self) -> None:
        self.now = 0.0
        self._order = itertools.count()
        self._due: list[tuple[float, int, Callable[[], object]]] = []
        self._targets: list[Callable[[], object]] = []

    def rules(self, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """From now on, in a module that says `import time` and perhaps `import threading`."""
        monkeypatch.setattr(f"{module}.time", self)
        monkeypatch.setattr(f"{module}.threading", self, raising=False)

    def at(self, moment: float, call: Callable[[], object]) -> None:
        """What another thread, or another process, does then."""
        heapq.heappush(self._due, (moment, next(self._order), call))

    def run(self) -> None:
        """Runs the threads that were started, one after the other, to their ends; and what is due afterwards."""
        while self._targets:
            self._targets.pop(0)()
        while self._due:
            self._step()

    def _step(self) -> None:
        moment, _, call = heapq.heappop(self._due)
        self.now = max(self.now, moment)
        call()

    # What `time` has ------------------------------------------------------------------------------

    def monotonic(self) -> float:
        """The moment."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Works, or waits for a disk, for so long: others do theirs meanwhile."""
        end = self.now + seconds
        while self._due and self._due[0][0] <= end:
            self._step()
        self.now = end

    # What `threading` has -------------------------------------------------------------------------

    def Thread(self, *, target: Callable[[], object], name: str, daemon: bool) -> _Thread:  # noqa: N802, ARG002
        """Runs in `run`."""
        return _Thread(self._targets, target)

    def Condition(self) -> Condition:  # noqa: N802
        """Nobody else holds it, ever."""
        return Condition(self)

    def wait(self, is_over: Callable[[], bool], seconds: float | None) -> bool:
        """Until it is over, or for so long; fails where nothing can end it."""
        end = math.inf if seconds is None else self.now + seconds
        while not is_over():
            if not self._due or self._due[0][0] > end:
                assert end < math.inf, "waits for what never comes"
                self.now = max(math.nextafter(self.now, math.inf), end)  # it always goes on
                return False
            self._step()
        return True


class _Thread:
    ident = 1

    def __init__(self, targets: list[Callable[[], object]], target: Callable[[], object]) -> None:
        self._targets, self._target = targets, target

    def start(self) -> None:
        self._targets.append(self._target)

    def join(self) -> None:
        assert self._target not in self._targets, "joined before it has run"

    def is_alive(self) -> bool:
        return self._target in self._targets


class Condition:
    """A condition variable in virtual time."""

    def __init__(self, time: VirtualTime) -> None:
        self._time, self._notified = time, False

    def __enter__(self) -> Condition:
        return self

    def __exit__(self, *_: Any) -> None:
        pass

    def notify(self) -> None:
        """Ends a wait under way."""
        self._notified = True

    notify_all = notify

    def wait(self, seconds: float | None = None) -> bool:
        """Until it is notified, or for so long."""
        self._notified = False
        return self._time.wait(lambda: self._notified, seconds)
