"""Interrupts: none is lost in a destructor, and whoever uses alarms keeps them."""

from __future__ import annotations

import signal
import threading
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest

from refu_core.simulation._solver import find_candidates
from refu_lab.interrupts import handled, interruptible, undisturbed

if TYPE_CHECKING:
    from collections.abc import Iterator


class Interrupting:
    """What is interrupted while it goes: an array of Warp's, for instance."""

    def __init__(self, number: signal.Signals = signal.SIGINT) -> None:
        self._number = number

    def __del__(self) -> None:
        signal.raise_signal(self._number)


@pytest.fixture(autouse=True)
def _alarm_is_as_before() -> Iterator[None]:
    before = signal.getsignal(signal.SIGALRM), signal.getitimer(signal.ITIMER_REAL)
    yield
    assert (signal.getsignal(signal.SIGALRM), signal.getitimer(signal.ITIMER_REAL)) == before


@interruptible()
def work(number: signal.Signals = signal.SIGINT) -> None:
    """Is interrupted in a destructor, and goes on for a minute."""
    Interrupting(number)
    time.sleep(60)


def test_it_comes_again_while_the_work_goes_on() -> None:
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        work()
    assert time.monotonic() < start + 30


def test_it_comes_at_the_end_where_the_work_ends_first() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible(), interruptible():
        Interrupting()


def test_it_waits_for_the_end_of_a_message() -> None:
    written = []

    @interruptible()
    def write() -> None:
        Interrupting()
        with undisturbed():
            time.sleep(0.1)
            written.append("whole")
        time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        write()
    assert written == ["whole"]


def test_where_ctrl_c_is_ignored_it_comes_as_what_interrupts() -> None:
    """As in a program that a script starts in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with handled({signal.SIGTERM: signal.default_int_handler}), pytest.raises(KeyboardInterrupt):
            work(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, before)


def test_it_comes_during_what_numba_has_compiled() -> None:
    """Simulated cloth spends its time there; Python made a SystemError of it, and the command called that a bug."""
    x, faces = np.random.default_rng(0).random((20_000, 3), np.float32), np.arange(3000).reshape(-1, 3)
    find_candidates(x, faces, x, np.float32(0.01), np.float32(0.05))  # compiles it

    @interruptible()
    def simulate() -> None:
        while True:
            find_candidates(x, faces, x, np.float32(0.01), np.float32(0.05))

    threading.Timer(0.5, signal.raise_signal, (signal.SIGINT,)).start()
    with pytest.raises(KeyboardInterrupt):
        simulate()


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_it_may_be_the_cause_of_an_error_of_an_error(depth: int) -> None:
    """Numba makes arrays in a function of its own: an interrupt there is two errors deep."""
    error: BaseException = KeyboardInterrupt()
    for _ in range(depth):
        last, error = error, SystemError("returned a result with an exception set")
        error.__cause__ = last
    with pytest.raises(KeyboardInterrupt), interruptible():
        raise error


def test_an_alarm_of_the_program_stays() -> None:
    rung: list[int] = []
    with handled({signal.SIGALRM: lambda number, _: rung.append(number)}):
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with interruptible():
            pass
        time.sleep(0.2)
    assert rung == [signal.SIGALRM]
