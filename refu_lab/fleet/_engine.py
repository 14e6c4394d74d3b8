"""Dask as the engine: processes of this machine, or the workers of a scheduler, wherever they are.

Dask is imported only if more than one process is asked for. A task that is lost with its worker is given to another
one and gives the same result there, which depends only on the task's content.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib.util import find_spec
from itertools import islice
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from refu_core import RefuError, __version__
from refu_core._engine import Engine, InProcess, Lost, Result, Task
from refu_lab.interrupts import interruptible

if TYPE_CHECKING:
    from distributed import Client, Future

MOST_JOBS = 1024
"""Processes on this machine. Each takes a core and half a gigabyte, and no Ctrl-C comes through while they start."""
IN_FLIGHT = 4
"""Tasks submitted at a time for each process: enough that it never idles, few enough that results don't pile up."""
CONNECT_S = 20.0
"""How long to try to reach a scheduler [s]."""
ALLOWED_FAILURES = 5
"""Workers that may die before a task is given up: a task that takes all memory kills each worker that tries it."""


class FleetError(RefuError):
    """Workers can't be started, or can't be reached any more."""


_LAST_WORDS_S = 1.0
"""How long a process may go on when it is ended [s]: by default Dask waits 4 s for a task that takes minutes."""


@contextmanager
def open_engine(jobs: int | None = None, scheduler: str | None = None) -> Iterator[Engine]:
    """The engine for `jobs` processes on this machine (None or 1: this one alone), or for a Dask scheduler's address.

    Raises `FleetError`: Dask isn't installed, both or too many processes were asked for, or there is no scheduler at
    the address.
    """
    if jobs is not None and scheduler is not None:
        raise FleetError("wanted either processes of this machine (--jobs) or a cluster (--scheduler), got both")
    if jobs is not None and jobs > MOST_JOBS:
        raise FleetError(f"wanted at most {MOST_JOBS} processes of this machine (--jobs), got {jobs}")
    if scheduler is None and (jobs is None or jobs == 1):
        yield InProcess()
        return
    if find_spec("distributed") is None:
        raise FleetError('several processes are run by Dask, which isn\'t installed: pip install "refu-ros[cluster]"')
    import dask
    from distributed import Client

    settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_FAILURES,
        "distributed.admin.log-format": "%(message)s",
    }
    # Errors are reported in one line by the command; Dask would log a traceback for a scheduler that is gone.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set(settings), interruptible(), ExitStack() as stack:
        cluster: Any = stack.enter_context(_own_cluster(jobs)) if scheduler is None else scheduler
        try:
            client = Client(cluster, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            msg = f"no Dask scheduler at {scheduler}: {error or type(error).__name__}; start one with `dask scheduler`"
            raise FleetError(msg) from error
        yield DaskEngine(stack.enter_context(client))


@contextmanager
def _own_cluster(jobs: int | None) -> Iterator[Any]:
    """Processes on this machine, which end with the block.

    Only this process handles Ctrl-C, and then ends the others: they and their replacements inherit that it's blocked.
    While they start and end, it is held back here, too.
    """
    from distributed import LocalCluster

    resource_tracker.ensure_running()  # else the first process would start it, which unblocks Ctrl-C
    with _ctrl_c_waits():
        cluster: Any = LocalCluster(
            n_workers=jobs,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",  # drawn by bokeh, or without it a few pages of text
            silence_logs=logging.CRITICAL,
        )

    async def end() -> None:
        ends = (one.close(timeout=_LAST_WORDS_S) for one in cluster.workers.values())
        await asyncio.gather(*ends, return_exceptions=True)  # the cluster waits for who takes longer

    try:
        yield cluster
    finally:
        with _ctrl_c_waits():
            cluster.sync(end)
            cluster.close()


@contextmanager
def _ctrl_c_waits() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class DaskEngine:
    def __init__(self, client: Client) -> None:
        self.client = client

    def run(
        self, make: Callable[[], Callable[[Task], Result]], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Lost]]:
        """Yields each task's number and result as they come, each once."""
        from distributed import as_completed

        packed = pickle.dumps(make)
        digest = hashlib.sha256(packed).hexdigest()[:16]
        # A task like any other: it is run again if its worker dies, whereas scattered data would be lost.
        shared = self.client.submit(bytes, packed, key=f"refu-make-{digest}", pure=False)
        numbers: dict[Future[Any], int] = {}
        folder = os.getcwd()  # noqa: PTH109

        def submit(index: int) -> Future[Any]:
            # Packed: a scheduler unpickles what it passes on, and would have to import torch.
            task = pickle.dumps(tasks[index])
            key = f"refu-task-{digest}-{index}-{hashlib.sha256(task).hexdigest()[:16]}"
            future = self.client.submit(_work, shared, digest, task, __version__, folder, key=key, pure=False)
            numbers[future] = index
            return future

        waiting = iter(range(len(tasks)))
        window = IN_FLIGHT * max(1, sum(self.client.nthreads().values()))
        done = as_completed([submit(index) for index in islice(waiting, window)], loop=self.client.loop)
        while numbers:
            future = next(done)
            result = self._result(future)
            index = numbers.pop(future)
            future.release()
            del future
            following = next(waiting, None)
            if following is not None:
                done.add(submit(following))
            yield index, result

    def _result(self, future: Future[Any]) -> Any:
        from distributed import CancelledError, KilledWorker
        from distributed.comm import CommClosedError

        try:
            return future.result()  # if its worker has died since, the task is run again
        except (CancelledError, CommClosedError) as error:
            raise FleetError("the Dask scheduler is gone, what is done is kept: give the same command again") from error
        except KilledWorker:
            return Lost("one worker after another died with it (out of memory?)")
        except ImportError as error:
            raise FleetError(f"the workers can't import {error.name}: install refu-ros {__version__} there") from error


_made: dict[str, Callable[[Any], Any]] = {}
"""This process's function by the digest of its maker; only the last one, as it may hold networks."""


def _work(packed: bytes, digest: str, task: bytes, version: str, folder: str) -> Any:
    """Runs on a worker: makes the function unless it has it, and calls it in the command's working folder.

    So relative paths mean the same as for the command, wherever the disk is shared.
    """
    with suppress(OSError):
        os.chdir(folder)
    if version != __version__:
        raise FleetError(f"a worker has refu-ros {__version__}, this is {version}: install one version everywhere")
    if digest not in _made:
        _made.clear()
        make = pickle.loads(packed)
        if "torch" in sys.modules:  # importing it takes seconds; if it's needed, it's imported by now
            import torch

            torch.set_num_threads(1)  # parallelism is by processes, however the worker was started
        _made[digest] = make()
    return _made[digest](pickle.loads(task))


def run_function(function: Callable[[Task], Result]) -> Callable[[], Callable[[Task], Result]]:
    """The argument `make` of an engine, for a function that needs no preparation."""
    return partial(partial, function)  # gives the function when it is called
