"""rclpy for the tests that need it: on this machine only, in a domain of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture(scope="session")
def ros() -> Iterator[None]:
    """rclpy, started once; the tests' own signal handling stays as it is."""
    from harness import isolate

    isolate()
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    yield
    rclpy.try_shutdown()
