"""What spreads independent tasks over processes; the core has the one that doesn't, `refu_lab.fleet` one that does."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Lost:
    """In the place of a task's result: what became of the processes that tried it."""

    reason: str


class Engine(Protocol):
    """Runs tasks, each a function of its own content: done again, or elsewhere, it gives the same."""

    def run(
        self, make: Callable[[], Callable[[Task], Result]], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Lost]]:
        """Yields each task's number and result as they come, each once.

        `make` makes a process's function, once for all its tasks; it is sent to each process, as tasks and results are.
        A task is asked for when its time has come. Raises what a task raises; `RefuError` without processes in reach.
        """


class InProcess:
    """One task after another, in this process."""

    def run(
        self, make: Callable[[], Callable[[Task], Result]], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Lost]]:
        """Yields each task's number and result, in order."""
        function = make()
        for index in range(len(tasks)):
            yield index, function(tasks[index])
