"""Interrupts (Ctrl-C): none is lost, and none comes in the middle of a message."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

_INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
_AGAIN_S = 0.01
"""After so long an interrupt comes again that was raised in a destructor, where Python only prints it [s]."""


@contextmanager
def handled(handlers: Mapping[signal.Signals, Callable[[int, FrameType | None], Any]]) -> Iterator[None]:
    """Sets the handlers of some signals for the time of the block; for the main thread alone."""
    before = {kind: signal.signal(kind, handler) for kind, handler in handlers.items()}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, signal.SIG_DFL if handler is None else handler)


@contextmanager
def interruptible() -> Iterator[None]:
    """In the block no interrupt is lost: one that is raised in a destructor comes again, at the latest at the end.

    It comes as a signal that interrupts this program, so whatever makes interrupts wait makes it wait, too.
    """
    if threading.current_thread() is not threading.main_thread():  # which alone is interrupted
        yield
        return
    hook, alarm = sys.unraisablehook, signal.getsignal(signal.SIGALRM)

    def unraised(what: Any) -> None:
        if what.exc_type is KeyboardInterrupt:
            signal.signal(signal.SIGALRM, _come_again)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        else:
            hook(what)

    sys.unraisablehook = unraised
    try:
        yield
    except SystemError as error:  # an interrupt in what Numba has compiled is only its cause, or the cause of its cause
        cause = error.__cause__
        while isinstance(cause, SystemError):
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            raise cause from None
        raise
    finally:
        sys.unraisablehook = hook
        if signal.getsignal(signal.SIGALRM) is not alarm:
            left, _ = signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL if alarm is None else alarm)
            if left:
                _come_again()


def _come_again(*_: object) -> None:
    for kind in (kind for kind in _INTERRUPTS if callable(signal.getsignal(kind))):
        signal.raise_signal(kind)  # what has no handler would end the program, or be ignored
        return


@contextmanager
def undisturbed() -> Iterator[None]:
    """Delays interrupts until the block ends: a bag that breaks off in the middle of a message can't be read."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    try:
        with handled(dict.fromkeys(_INTERRUPTS, lambda kind, _: came.append(kind))):
            yield
    finally:
        for kind in dict.fromkeys(came):
            signal.raise_signal(kind)
