"""What every reader owes: it returns or refuses with one of the project's errors, soon, in bounded memory, and does
nothing else."""

from __future__ import annotations

import contextlib
import faulthandler
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refu_core import RefuError
from tests.limits import MEGABYTES, SECONDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

LONGEST_LINE = 500
"""Of a message [characters]."""
_SILENT_S = 300.0
"""Longer, and a reader hangs where Python can't interrupt it: the process ends."""

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = tuple(str(_ROOT / name) for name in ("refu_core", "msg_adapters", "refu_ros"))
_FORBIDDEN = frozenset(
    {
        *(
            "os.system",
            "os.exec",
            "os.fork",
            "os.forkpty",
            "os.posix_spawn",
            "os.spawn",
            "subprocess.Popen",
            "pty.spawn",
        ),
        *("socket.connect", "socket.bind", "socket.getaddrinfo", "socket.sendto", "ctypes.dlopen", "pickle.find_class"),
        *("os.remove", "os.rename", "os.chmod", "shutil.rmtree"),
    }
)
"""Audit events that no reader raises: a process, a connection, a library, code, another file gone."""


_at_rest = False


@contextlib.contextmanager
def own_work() -> Iterator[None]:
    """What is done in here is the harness's, which puts an input where the reader will look for it."""
    global _at_rest
    _at_rest = True
    try:
        yield
    finally:
        _at_rest = False


class BrokenError(AssertionError):
    """A reader did what none may: a finding."""

    def __init__(self, where: str, what: str, detail: str) -> None:
        self.signature = f"{what}: {where}"
        """Equal for what is probably the same cause."""
        super().__init__(f"{self.signature}\n{detail}")


class _TimeUpError(BaseException):
    """Raised where the reader is; no `except Exception` keeps it."""


class Contract:
    """Holds readers to it, one input after another, in this process; and keeps the worst figures."""

    def __init__(self, *, seconds: float = SECONDS, megabytes: float = MEGABYTES) -> None:
        self._seconds, self._megabytes = seconds, megabytes
        self._is_armed, self._forbidden = False, ""
        self.executions = self.refused = 0
        self.slowest_s = self.peak_mb = 0.0
        self._has_timer = threading.current_thread() is threading.main_thread()
        tempfile.gettempdir()  # tries a folder the first time, with a file that it removes
        sys.addaudithook(self._audit)  # stays as long as the process; it sleeps outside of `hold`

    def hold(self, read: Callable[[Any], None], value: Any) -> bool:
        """Whether the input was read; False if it was refused.

        Raises:
            BrokenError: neither; or it took too much, or did what no reader has a reason for.
        """
        self.executions += 1
        self._forbidden, refusal = "", None
        given = f"\ninput: {repr(value)[:500]}"
        before = _memory_mb(reset=True)
        faulthandler.dump_traceback_later(_SILENT_S, exit=True)
        started = time.process_time()
        try:
            self._within_time(read, value)
        except RefuError as error:
            refusal = error
        except (KeyboardInterrupt, GeneratorExit):
            raise
        except _TimeUpError as error:
            raise BrokenError(_place(error), "hang", traceback.format_exc(limit=-8) + given) from None
        except BaseException as error:
            raise BrokenError(
                _place(error), type(error).__name__, traceback.format_exc(limit=-8)[-5000:] + given
            ) from None
        finally:
            faulthandler.cancel_dump_traceback_later()
        seconds, megabytes = time.process_time() - started, _memory_mb() - before
        self.slowest_s, self.peak_mb = max(self.slowest_s, seconds), max(self.peak_mb, megabytes)
        end = "read" if refusal is None else f"{type(refusal).__name__} at {_place(refusal)}"
        if self._forbidden:
            raise BrokenError(self._forbidden.split()[0], "forbidden", self._forbidden + given)
        if seconds > self._seconds:
            raise BrokenError(end, "slow, then", f"{seconds:.1f} s{given}")
        if megabytes > self._megabytes:
            raise BrokenError(end, "memory, then", f"{megabytes:.0f} MB{given}")
        if refusal is not None:
            self.refused += 1
            check_line(str(refusal), end)
        return refusal is None

    def _within_time(self, read: Callable[[Any], None], value: Any) -> None:
        old = signal.signal(signal.SIGPROF, self._time_is_up) if self._has_timer else None
        compiles, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # modules of a command, at its first call
        self._is_armed = True
        try:
            if self._has_timer:
                signal.setitimer(signal.ITIMER_PROF, 2 * self._seconds)
            read(value)
        finally:
            self._is_armed = False
            sys.dont_write_bytecode = compiles
            if self._has_timer:
                signal.setitimer(signal.ITIMER_PROF, 0)
                signal.signal(signal.SIGPROF, old or signal.SIG_DFL)

    def _time_is_up(self, *_: Any) -> None:
        if self._is_armed:
            raise _TimeUpError

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if (
            self._is_armed
            and not _at_rest
            and (event in _FORBIDDEN or (event == "open" and _writes_elsewhere(arguments)))
        ):
            self._forbidden = f"{event} {arguments!r:.300}"


def check_line(message: str, where: str) -> None:
    """A message is short, and prints as it is: no terminal obeys it."""
    text = message.replace("\n", " ")
    if not text or len(text) > LONGEST_LINE or not text.isprintable():
        raise BrokenError(where, "message", f"{len(text)} characters: {text[:300]!r}")


def _memory_mb(*, reset: bool = False) -> float:
    """Memory of the process; with `reset` as it is now, otherwise at most since then."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmRSS:" if reset else "VmHWM:")[1].split()[0]) / 1e3
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def _writes_elsewhere(arguments: tuple[Any, ...]) -> bool:
    """Whether an `open` event is of a file to be written outside of the folders for temporary files."""
    path, mode = arguments[0], arguments[1]
    if not isinstance(mode, str) or not set(mode) & set("wxa+") or not isinstance(path, str) or "\0" in path:
        return False
    return not str(Path(path).resolve()).startswith((tempfile.gettempdir(), "/dev/shm", "/dev/null"))


def _frames(error: BaseException) -> Iterator[traceback.FrameSummary]:
    yield from reversed(traceback.extract_tb(error.__traceback__))


def _place(error: BaseException) -> str:
    """The innermost line of the project."""
    for frame in _frames(error):
        if frame.filename.startswith(_PACKAGES):
            return f"{Path(frame.filename).relative_to(_ROOT)}:{frame.lineno}"
    last = next(_frames(error), None)
    return f"{last.filename}:{last.lineno}" if last else "?"
