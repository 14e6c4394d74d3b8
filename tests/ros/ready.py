"""Programs that begin at once: a process that has imported what they import, and forks one for each that asks.

To import torch takes seconds, to load kernels one more, and some forty programs are started by the tests. Nothing but
modules and kernels is shared: rclpy is started by each for itself. And they say five times a second how they are, not
once: tests wait for that.
"""

from __future__ import annotations

import atexit
import functools
import gc
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType


class Forked:
    """A process of another's; as far as it goes, a `subprocess.Popen`."""

    def __init__(self, pid: int, status: Path) -> None:
        self.pid, self._status = pid, status

    def poll(self) -> int | None:
        """The exit status, negative for a signal; None while it runs."""
        return int(self._status.read_text()) if self._status.exists() else None

    def wait(self, timeout: float | None = None) -> int:
        """The exit status. Raises `subprocess.TimeoutExpired`."""
        end = time.monotonic() + (1e9 if timeout is None else timeout)
        while (status := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired([], timeout or 0.0)
            time.sleep(0.01)
        return status

    def send_signal(self, number: int) -> None:
        """To it, if it still runs."""
        if self.poll() is None:
            with suppress(ProcessLookupError):  # it has just ended
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """Asks it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Ends it."""
        self.send_signal(signal.SIGKILL)


@functools.cache
def _parent() -> subprocess.Popen[str]:
    path = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    parent = subprocess.Popen(
        [sys.executable, __file__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": ":".join(path)},
    )
    atexit.register(lambda: (parent.kill(), parent.wait()))
    return parent


def run_program(
    name: str, arguments: list[str], *, log: Path, cwd: Path | None = None, path: Sequence[str] = (), first: str = ""
) -> Forked:
    """`garment_node` or `smpl_publisher` in this environment; writes to `log`, and finds modules in `path` first.

    What is in `first`, in Python, is done before the program begins.
    """
    log.write_bytes(b"")
    status = log.with_name(f"{log.name}.status-{time.monotonic_ns()}")
    order = {
        "program": [name, *arguments],
        "log": str(log),
        "cwd": str(cwd or Path.cwd()),
        "path": [*path],
        "first": first,
    }
    parent = _parent()
    assert parent.stdin is not None
    assert parent.stdout is not None
    parent.stdin.write(json.dumps({**order, "environment": dict(os.environ), "status": str(status)}) + "\n")
    parent.stdin.flush()
    return Forked(int(parent.stdout.readline()), status)


def _serve() -> None:
    """Forks until there is nobody to ask any more."""
    from refu_ros import _beside, _node, _worker, garment_node, smpl_publisher  # noqa: F401  (and all that they import)
    from refu_ros._settings import NodeSettings

    _node._BEAT_S = 0.2
    _beside.load(NodeSettings(garments=("tshirt-male",)))  # with most kernels of most nodes
    gc.freeze()  # a collector that goes through all of it would copy it, too
    running: dict[int, Path] = {}

    def bury(_number: int, _frame: FrameType | None) -> None:
        for pid in [*running]:
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                told = running.pop(pid)
                part = told.with_name(f"{told.name}.part")
                part.write_text(str(os.waitstatus_to_exitcode(status)))
                part.rename(told)

    signal.signal(signal.SIGCHLD, bury)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal, which is for who runs the tests
    for line in iter(sys.stdin.readline, ""):
        order: dict[str, Any] = json.loads(line)
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])  # it is known before it can have ended
        pid = os.fork()
        if pid == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also where `nohup` runs the tests
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
            file = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for stream in (1, 2):
                os.dup2(file, stream)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.chdir(order["cwd"])
            os.environ.update(order["environment"])
            sys.path[:0] = order["path"]
            sys.argv = order["program"]
            gc.freeze = lambda: None  # a node that is out of the collector's sight would be on the graph for 20 s more
            exec(order["first"], {})
            code = sys.modules[f"refu_ros.{sys.argv[0]}"].main()
            atexit._run_exitfuncs()
            gc.collect()  # what leaves the graph with its end
            os._exit(code)  # to take its modules apart would copy the memory that it shares
        running[pid] = Path(order["status"])
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGCHLD])
        print(pid, flush=True)


if __name__ == "__main__":
    _serve()
