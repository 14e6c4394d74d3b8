"""Dask as the engine: processes of this machine, or the workers of a scheduler, wherever they are.

Dask is imported by who asks for more than one process. A task that is lost with its worker is given to another one, and
gives the same there: its result is a function of its content.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from importlib.util import find_spec
from itertools import islice
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from refu_core import RefuError, __version__
from refu_core._engine import Engine, InProcess, Lost, Result, Task

if TYPE_CHECKING:
    from distributed import Client, Future

IN_FLIGHT = 4
"""Tasks that a process has waiting: enough that it never waits itself, few enough that results don't pile up."""
CONNECT_S = 20.0
"""How long a scheduler is looked for [s]."""
ALLOWED_FAILURES = 5
"""Workers that may die with a task before it is given up: a task that takes all memory ends each worker that tries."""


class FleetError(RefuError):
    """Workers that can't be had, or can't be reached any more."""


@contextmanager
def open_engine(jobs: int | None = None, scheduler: str | None = None) -> Iterator[Engine]:
    """The engine for `jobs` processes of this machine (None or 1: this one alone), or for a Dask scheduler's address.

    Raises:
        FleetError: Dask isn't installed, both were asked for, or there is no scheduler at the address.
    """
    if jobs is not None and scheduler is not None:
        msg = "wanted either processes of this machine (--jobs) or a cluster (--scheduler), got both"
        raise FleetError(msg)
    if scheduler is None and (jobs is None or jobs == 1):
        yield InProcess()
        return
    if find_spec("distributed") is None:
        msg = 'several processes are run by Dask, which isn\'t installed: pip install "refu-ros[cluster]"'
        raise FleetError(msg)
    import dask
    from distributed import Client

    settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.admin.log-format": "%(message)s",
    }
    # What goes wrong is said in one line by who gave the command; a scheduler that is gone would be a traceback.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set(settings), ExitStack() as stack:
        cluster: Any = stack.enter_context(_own_cluster(jobs)) if scheduler is None else scheduler
        try:
            client = Client(cluster, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            msg = f"no Dask scheduler at {scheduler}: {error or type(error).__name__}; start one with `dask scheduler`"
            raise FleetError(msg) from error
        yield DaskEngine(stack.enter_context(client))


@contextmanager
def _own_cluster(jobs: int | None) -> Iterator[Any]:
    """Processes of this machine, which end with the block.

    Ctrl-C is for this process alone, which ends them: they, and whoever takes their place, inherit that it's blocked.
    While they start and end it has to wait.
    """
    from distributed import LocalCluster

    resource_tracker.ensure_running()  # else the first process to be started would start it, and unblock Ctrl-C
    with _ctrl_c_waits():
        cluster: Any = LocalCluster(
            n_workers=jobs,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",  # of bokeh, or (without it) a few pages of text
            silence_logs=logging.CRITICAL,
        )
    try:
        yield cluster
    finally:
        with _ctrl_c_waits():
            cluster.close()


@contextmanager
def _ctrl_c_waits() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class DaskEngine:
    """Runs tasks on a client's workers."""

    def __init__(self, client: Client) -> None:
        self.client = client
        """Whose workers run them."""

    def run(
        self, make: Callable[[], Callable[[Task], Result]], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Lost]]:
        """Yields each task's number and result as they come, each once."""
        from distributed import as_completed

        packed = pickle.dumps(make)
        digest = hashlib.sha256(packed).hexdigest()[:16]
        # A task like any other: whoever loses it gets it again, where scattered data would be gone with its worker.
        shared = self.client.submit(bytes, packed, key=f"refu-make-{digest}", pure=False)
        numbers: dict[Future[Any], int] = {}
        folder = os.getcwd()  # noqa: PTH109

        def submit(index: int) -> Future[Any]:
            # Packed: a scheduler reads what it passes on, and would import torch for it.
            task = pickle.dumps(tasks[index])
            key = f"refu-task-{digest}-{index}-{hashlib.sha256(task).hexdigest()[:16]}"
            future = self.client.submit(_work, shared, digest, task, __version__, folder, key=key, pure=False)
            numbers[future] = index
            return future

        waiting = iter(range(len(tasks)))
        window = IN_FLIGHT * max(1, sum(self.client.nthreads().values()))
        done = as_completed([submit(index) for index in islice(waiting, window)], loop=self.client.loop)
        for future in done:
            index = numbers.pop(future)
            result = self._result(future)
            future.release()
            following = next(waiting, None)
            if following is not None:
                done.add(submit(following))
            yield index, result

    def _result(self, future: Future[Any]) -> Any:
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        try:
            return future.result()  # where that was on a worker that has died since, the task is done again
        except (CancelledError, CommClosedError) as error:
            msg = "the Dask scheduler is gone; what is finished is kept: give the same command again to go on"
            raise FleetError(msg) from error
        except KilledWorker:
            return Lost("one worker after another died with it (out of memory?)")
        except ImportError as error:
            msg = f"the workers can't import {error.name}: install refu-ros {__version__} where they run"
            raise FleetError(msg) from error


_made: dict[str, Callable[[Any], Any]] = {}
"""This process's function, by what it was made of; the last one alone, as it may hold networks."""


def _work(packed: bytes, digest: str, task: bytes, version: str, folder: str) -> Any:
    """On a worker: makes the function, unless it has it, and calls it where the command was given.

    A relative path is the command's then, wherever the disk is the same.
    """
    with contextlib.suppress(OSError):
        os.chdir(folder)
    if version != __version__:
        msg = f"a worker has refu-ros {__version__}, this is {version}: install one version everywhere"
        raise FleetError(msg)
    if digest not in _made:
        _made.clear()
        make = pickle.loads(packed)
        if "torch" in sys.modules:  # it takes seconds to import; what needs it has done so by now
            import torch

            torch.set_num_threads(1)  # processes are the parallelism, whoever started the worker
        _made[digest] = make()
    return _made[digest](pickle.loads(task))


def run_function(function: Callable[[Task], Result]) -> Callable[[], Callable[[Task], Result]]:
    """`make` of an engine for a function that needs nothing made."""
    return partial(_itself, function)


def _itself(function: Callable[[Task], Result]) -> Callable[[Task], Result]:
    return function
