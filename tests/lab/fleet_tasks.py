"""Functions that workers run in the tests of fleets: little is imported for them."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any


def square(number: int) -> int:
    """Of a number."""
    return number * number


def square_unless_first(number: int) -> int:
    """As `square`; whoever gets 3 first is killed by it."""
    if number == 3 and not Path(os.environ["REFU_TEST_MARK"]).exists():
        Path(os.environ["REFU_TEST_MARK"]).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def die(_: int) -> None:
    """Kills whoever calls it."""
    os.kill(os.getpid(), signal.SIGKILL)


def dying(make: Callable[[], Any], mark: Path) -> Callable[[Any], Any]:
    """The function that `make` makes, of a worker that is killed after its first task, once among all workers."""
    function = make()

    def work(task: Any) -> Any:
        done = function(task)
        with suppress(FileExistsError):
            mark.mkdir()
            os.kill(os.getpid(), signal.SIGKILL)
        return done

    return work


def allow_no_failure(dask_scheduler: Any) -> None:
    """On a scheduler: a task that ended one worker is given up."""
    dask_scheduler.allowed_failures = 0
