"""What the programs share: their command line, signals, the executor, errors as one line, and shared memory."""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from refu_core._collector import collect_rarely, keep_what_is_loaded
from refu_core._files import keep_streams
from refu_core.errors import printable

EXIT_BAD_INPUT = 2
_LOOK_UP_S = 0.25
"""How often the main thread looks for a signal when nothing happens."""
_BREATH_S = 0.05
"""Pause after the executor has failed: one that always does mustn't take a whole core."""


def run(
    program: str,
    arguments: Sequence[str] | None,
    *,
    description: str | None,
    listing: Callable[[], str],
    live: Callable[[], int],
) -> int:
    """Answers --help with a `listing` of parameters and topics, or starts rclpy and runs `live`; returns the status."""
    keep_streams()
    _on_signals(signal.SIG_DFL)  # while it loads, nothing is open that would have to be closed
    collect_rarely()
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
        from rclpy.utilities import remove_ros_args
    except ImportError as error:
        return _refuse(program, f'source a ROS 2 installation, or pip install "refu-ros[ros]" ({error})')
    given = sys.argv if arguments is None else [program, *arguments]
    try:
        if own := remove_ros_args(given)[1:]:
            argparse.ArgumentParser(
                prog=program,
                usage=f"{program} [--help] [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]",
                description=description,
                epilog=listing(),
                formatter_class=argparse.RawDescriptionHelpFormatter,
            ).parse_args(own)
        # rclpy's handlers raise in the middle of whatever runs, a second SIGINT even in the middle of closing a file.
        rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
        return live()
    except Exception as error:
        is_bare = "UnknownROSArgs" in type(error).__name__  # rclpy's: nothing but a list
        return _refuse(program, f"no such arguments after --ros-args: {error}" if is_bare else str(error))
    finally:
        rclpy.try_shutdown()
        _on_signals(signal.SIG_IGN)  # an impatient second Ctrl-C mustn't change the exit status


def _refuse(program: str, text: str) -> int:
    sys.stderr.write(f"{program}: error: {printable(text)}\n")
    return EXIT_BAD_INPUT


def _on_signals(handler: Any) -> None:
    """Sets the handler of signals that end a program. SIGHUP (a lost terminal) stays ignored under `nohup`."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, handler)


def hear(told: list[bool]) -> None:
    """Has these signals append to `told` from now on: an Event could deadlock, as handlers interrupt each other."""
    _on_signals(lambda *_: told.append(True))


def make_executor() -> Any:
    """An executor, which waits for messages, requests and timers."""
    try:
        # This one waits for events in C++; the other one, after each event, rebuilds in Python what it waits for.
        from rclpy.experimental import EventsExecutor as Executor
    except ImportError:  # an older rclpy
        from rclpy.executors import SingleThreadedExecutor as Executor
    return Executor()


def spin(node: Any, *, until: Callable[[], object]) -> None:
    """Lets a `GuardedNode` answer what comes. Callbacks are guarded; what rclpy itself raises mustn't end it either."""
    executor = make_executor()
    executor.add_node(node)
    keep_what_is_loaded()
    spin_once = node.guarded("executor", executor.spin_once, lambda *_, **__: time.sleep(_BREATH_S))
    while not until():
        spin_once(timeout_sec=_LOOK_UP_S)


PROFILES = Path(__file__).with_name("fastdds.xml")
SEGMENT_BYTES = 40_000_000
"""The segment of `fastdds.xml`: 512 pieces of 65,500 bytes, and some."""
_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


def make_room() -> bool:
    """Has Fast DDS use `fastdds.xml`, in this process, before `rclpy.init`; returns whether it will.

    Its default shared memory, half a megabyte, holds less than one message of garments. A subscriber that stands still
    (in a debugger, or swapping) occupies what it hasn't read, at most the 512 pieces of 64 kB that its queue holds.
    Once that fills the segment, nobody else gets anything either, often not even after the subscriber has gone. 40 MB
    can't be filled.

    If the user has configured Fast DDS in any of its ways, that stays. If there is too little shared memory (as in some
    containers), Fast DDS keeps its defaults. Other middleware doesn't read the variable.
    """
    chosen = any(os.environ.get(name) for name in _VARIABLES) or Path("DEFAULT_FASTRTPS_PROFILES.xml").exists()
    with suppress(OSError):  # there is no such memory
        if not chosen and shutil.disk_usage("/dev/shm").free > SEGMENT_BYTES:
            os.environ[_VARIABLES[0]] = str(PROFILES)
            return True
    return False
