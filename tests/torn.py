"""Interrupts at each line of a call, one after the other."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any


def interrupts(call: Callable[[], object], within: str) -> Iterator[int]:
    """Calls and interrupts at a line of the package's files whose path contains `within`: a number for each line.

    Ends when the call isn't interrupted any more, since it has no more lines.
    """
    at, before = 1, sys.gettrace()
    while True:
        left = at

        def look(frame: FrameType, event: str, _: object) -> Any:
            nonlocal left
            if f"refu_core/{within}" not in frame.f_code.co_filename.replace("\\", "/"):
                return None
            left -= event == "line"
            if not left and event == "line":
                sys.settrace(None)
                raise KeyboardInterrupt
            return look

        sys.settrace(look)
        try:
            call()
        except KeyboardInterrupt:
            yield at
        else:
            return
        finally:
            sys.settrace(before)
        at += 1
