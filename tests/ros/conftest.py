"""rclpy for the tests that need it: on this machine only, in a domain of its own."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

SCRIPTS = Path(__file__).parents[2] / "scripts"


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


@pytest.fixture(scope="session")
def messages() -> Iterator[Path]:
    """The folder of `refu_msgs`, built of its definitions by rosidl and a compiler, once for each version of them."""
    sys.path.insert(0, str(SCRIPTS))
    import build_msgs

    folder = Path(tempfile.gettempdir(), f"refu-msgs-{os.getuid()}-{build_msgs.key()}")
    if not (folder / build_msgs.PACKAGE).is_dir():
        try:
            build_msgs.build(folder)
        except build_msgs.MissingError as error:
            pytest.skip(f"refu_msgs can't be built: {error}")
    sys.path.insert(0, str(folder))
    for name in [name for name in sys.modules if name.partition(".")[0] == build_msgs.PACKAGE]:
        del sys.modules[name]  # the definitions' folder, taken for a package
    yield folder
    sys.path.remove(str(folder))
    sys.path.remove(str(SCRIPTS))
