"""The judge of one execution: how it ended, what it reached, and whether it took too much or did what no reader may."""

from __future__ import annotations

import re
import resource
import signal
import sys
import tempfile
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refu_core import RefuError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType

_PACKAGES = tuple(str(Path(__file__).resolve().parents[2] / name) for name in ("refu_core", "msg_adapters", "refu_ros"))
_OWN = str(Path(__file__).resolve().parent)
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
_DIGITS = re.compile(r"[0-9a-fA-F]{6,}|[-+]?[0-9][0-9.e+-]*|'[^']*'|\"[^\"]*\"|\(.*\)")


class _TimeUpError(BaseException):
    """Raised where the reader is; no `except Exception` keeps it."""


@dataclass(frozen=True)
class Outcome:
    """How an execution ended."""

    kind: str
    """`ok`, `refused` (a `RefuError`), or what is wrong: `crash`, `hang`, `memory`, `forbidden`."""
    signature: str
    """Equal for what is probably the same cause."""
    detail: str = ""
    """The traceback of a finding."""
    is_new: bool = False
    """Whether it reached lines, or ended in a way, that none did before: its input is worth building on."""

    @property
    def is_finding(self) -> bool:
        """Whether it should not have ended like this."""
        return self.kind not in ("ok", "refused")


class Guard:
    """Runs a reader on one input after another.

    Processor time is limited by a timer (main thread of a POSIX system only), memory by the high-water mark of the
    process. Lines that are reached are seen in every `trace_every`-th execution, for tracing costs tenfold.
    """

    def __init__(self, *, seconds: float, memory_mb: int, trace_every: int = 16) -> None:
        self._seconds = seconds
        self._memory_kb = memory_mb * 1024
        self._trace_every = trace_every
        self._count = 0
        self._lines: set[tuple[str, int]] = set()
        self._signatures: set[str] = set()
        self._is_armed = False
        self._forbidden = ""
        self._base_kb = 0
        self.slowest_ms = 0.0
        """The most processor time that an input has taken."""
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGPROF, self._time_is_up)
        sys.addaudithook(self._audit)  # stays as long as the process; it sleeps outside of `run`

    def start(self) -> None:
        """From here on memory counts: what valid input takes has been taken."""
        self._base_kb = _peak_kb()

    @property
    def peak_mb(self) -> float:
        """Memory taken since `start`, at most [MiB]."""
        return max(0, _peak_kb() - self._base_kb) / 1024

    def run(self, execute: Callable[[bytes], None], data: bytes) -> Outcome:
        """One execution; never raises but for an interrupt."""
        self._count += 1
        before = len(self._lines)
        tracing = self._trace_every > 0 and self._count % self._trace_every == 0
        kind, signature, detail = self._judge(execute, data, tracing=tracing)
        is_new = len(self._lines) > before or signature not in self._signatures
        self._signatures.add(signature)
        return Outcome(kind, signature, detail, is_new)

    def _judge(self, execute: Callable[[bytes], None], data: bytes, *, tracing: bool) -> tuple[str, str, str]:
        self._forbidden = ""
        started = resource.getrusage(resource.RUSAGE_SELF)
        # Tracing takes its own time.
        signal.setitimer(signal.ITIMER_PROF, self._seconds * (10 if tracing else 1))
        self._is_armed = True
        try:
            if tracing:
                sys.settrace(self._trace)
            try:
                execute(data)
            finally:
                sys.settrace(None)
                self._is_armed = False
                signal.setitimer(signal.ITIMER_PROF, 0)
        except RefuError as error:
            result = "refused", f"{type(error).__name__}: {_shape(str(error))}", ""
        except (KeyboardInterrupt, GeneratorExit):
            raise
        except _TimeUpError as error:
            result = "hang", f"hang at {_place(error)}", traceback.format_exc()
        except BaseException as error:
            result = "crash", f"{type(error).__name__} at {_place(error)}", traceback.format_exc()
        else:
            result = "ok", "ok", ""
        ended = resource.getrusage(resource.RUSAGE_SELF)
        if not tracing:
            self.slowest_ms = max(
                self.slowest_ms, 1e3 * (ended.ru_utime + ended.ru_stime - started.ru_utime - started.ru_stime)
            )
        if self._forbidden:
            return "forbidden", f"forbidden {self._forbidden.split()[0]}", self._forbidden
        grown = ended.ru_maxrss - self._base_kb
        if self._base_kb and grown > self._memory_kb and result[0] in ("ok", "refused"):
            self._base_kb = ended.ru_maxrss  # the next one is judged by what it adds
            return "memory", f"memory, then {result[1]}", f"{grown >> 10} MiB more than valid input takes"
        return result

    def _time_is_up(self, _signal: int, _frame: FrameType | None) -> None:
        if self._is_armed:
            raise _TimeUpError

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._is_armed:
            return
        if event in _FORBIDDEN or (event == "open" and _writes_elsewhere(arguments)):
            self._forbidden = f"{event} {arguments!r:.300}"

    def _trace(self, frame: FrameType, _event: str, _argument: Any) -> Any:
        path = frame.f_code.co_filename
        return self._trace_line if path.startswith(_PACKAGES) and not path.startswith(_OWN) else None

    def _trace_line(self, frame: FrameType, event: str, _argument: Any) -> Any:
        if event == "line":
            self._lines.add((frame.f_code.co_filename, frame.f_lineno))
        return self._trace_line


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _writes_elsewhere(arguments: tuple[Any, ...]) -> bool:
    """Whether an `open` event is of a file to be written outside of the folders for temporary files."""
    path, mode = arguments[0], arguments[1]
    if not isinstance(mode, str) or not set(mode) & set("wxa+") or not isinstance(path, str):
        return False
    return not str(Path(path).resolve()).startswith((tempfile.gettempdir(), "/dev/shm", "/dev/null"))


def _frames(error: BaseException) -> Iterator[traceback.FrameSummary]:
    yield from reversed(traceback.extract_tb(error.__traceback__))


def _place(error: BaseException) -> str:
    """The innermost line of the project."""
    for frame in _frames(error):
        if frame.filename.startswith(_PACKAGES) and not frame.filename.startswith(_OWN):
            return f"{Path(frame.filename).relative_to(Path(_PACKAGES[0]).parent)}:{frame.lineno}"
    last = next(_frames(error), None)
    return f"{last.filename}:{last.lineno}" if last else "?"


def _shape(text: str) -> str:
    """A message without the numbers and names that differ from input to input."""
    return _DIGITS.sub("#", text[:400])[:160]
