"""`garment_node`: dresses the persons whose SMPL parameters arrive, until it is told to stop."""

from __future__ import annotations

import signal
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

EXIT_BAD_PARAMETERS, EXIT_DEVICE_LOST = 2, 3
_LOOK_UP_S = 0.25
"""How often the main thread looks for a signal when nothing happens."""
_LAST_WORDS_S = 0.2
"""Time for the answer to a shutdown request to leave."""


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node; returns the exit status. SIGINT and SIGTERM end it after all files are closed."""
    # rclpy's handlers raise in the middle of whatever runs, a second SIGINT even in the middle of closing a file.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())

    import rclpy
    from rclpy.exceptions import ParameterException
    from rclpy.signals import SignalHandlerOptions

    from refu_core import RefuError
    from refu_ros._node import GarmentNode
    from refu_ros._transport import make_room

    make_room()
    rclpy.init(args=None if args is None else list(args), signal_handler_options=SignalHandlerOptions.NO)
    try:
        try:
            node = GarmentNode()
        except (RefuError, ParameterException) as error:
            sys.stderr.write(f"garment_node: {error}\n")
            return EXIT_BAD_PARAMETERS
        try:
            if node.settings.autostart and not _started(node):
                return EXIT_BAD_PARAMETERS
            executor = _executor()
            executor.add_node(node)
            while not (stop.is_set() or node.finalized):
                executor.spin_once(timeout_sec=_LOOK_UP_S)
            end = time.monotonic() + _LAST_WORDS_S
            while node.finalized and time.monotonic() < end:
                executor.spin_once(timeout_sec=0.05)
            return EXIT_DEVICE_LOST if node.failed else 0
        finally:
            node.close()
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def _executor() -> Any:
    """What waits for messages, requests and timers."""
    try:
        # Waits in C++ for events: the other one tells the middleware anew, in Python, what it waits for after each.
        from rclpy.experimental import EventsExecutor
    except ImportError:  # an older rclpy
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def _started(node: object) -> bool:
    """Configures and activates; what was wrong has been logged."""
    from rclpy.lifecycle import TransitionCallbackReturn

    done = TransitionCallbackReturn.SUCCESS
    return bool(node.trigger_configure() == done and node.trigger_activate() == done)  # type: ignore[attr-defined]


if __name__ == "__main__":
    sys.exit(main())
