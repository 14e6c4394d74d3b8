"""Engines for independent tasks: the one here runs them in this process, that of `refu_lab.fleet` in several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Lost:
    """Takes the place of a task's result: says what became of the processes that tried it."""

    reason: str


class Engine(Protocol):
    """Runs tasks that depend on nothing but their content: run again, or elsewhere, a task gives the same result."""

    def run(
        self, make: Callable[[], Callable[[Task], Result]], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Lost]]:
        """Yields each task's number and result once, in the order in which they come.

        `make` is sent to each process, as tasks and results are, and makes the function for all of its tasks. A task is
        taken from `tasks` only when its turn comes. Raises what a task raises; `RefuError` if no process is in reach.
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
