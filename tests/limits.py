"""Runs a reader on hostile input in a process of its own, where it may hang, crash or take all memory."""

from __future__ import annotations

import os
import pickle
import resource
import select
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from refu_core import RefuError

SECONDS = 2.0
"""Processor time that any reader may take to refuse a file [s]."""
MEGABYTES = 600
"""Memory that it may take for that [MB]."""
_HANGS = 120.0
"""Time after which a call isn't waited for any longer, however busy the machine is [s]."""


@dataclass(frozen=True)
class Ending:
    """How a call ended."""

    error: str
    """The message of the project's error; empty where the call returned."""
    seconds: float
    """Processor time."""
    megabytes: float
    """Memory taken at most, above what the process had before."""


def run_limited(call: Callable[[], Any]) -> Ending:
    """What became of `call`; fails where it hangs, crashes, raises anything but the project's errors, or takes more."""
    receive, send = os.pipe()
    child = os.fork()
    if not child:
        try:
            before = time.process_time(), _peak_kb()
            ending = said(call), time.process_time() - before[0], (_peak_kb() - before[1]) / 1e3
            os.write(send, pickle.dumps(ending))
        finally:
            os._exit(0)
    os.close(send)
    try:
        is_done = select.select([receive], [], [], _HANGS)[0]
        if not is_done:
            os.kill(child, signal.SIGKILL)
        data = os.read(receive, 1 << 16) if is_done else b""
    finally:
        os.close(receive)
        status = os.waitpid(child, 0)[1]
    assert is_done, f"hangs: not done after {_HANGS:g} s"
    assert data, f"crashes: ended with the status {status}"
    (error, message), seconds, megabytes = pickle.loads(data)
    assert not error, f"{error}: {message}"
    assert seconds <= SECONDS, f"takes {seconds:.1f} s"
    assert megabytes <= MEGABYTES, f"takes {megabytes:.0f} MB"
    return Ending(message, seconds, megabytes)


def refusal(call: Callable[[], Any]) -> str:
    """The message that `call` is refused with; fails as `run_limited` does, and where it isn't refused."""
    message = run_limited(call).error
    assert message, "isn't refused"
    return message


def said(call: Callable[[], Any]) -> tuple[str, str]:
    """What `call` fails with that isn't the project's error, empty for none, and the message of either."""
    try:
        call()
    except RefuError as error:
        return "", str(error)
    except BaseException as error:
        return type(error).__name__, str(error)[:2000]
    return "", ""


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
