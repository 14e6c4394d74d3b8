"""Errors of `msg_adapters`: each message says what was wanted, what came, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from refu_core.errors import FrameError, RefuError


class AdapterError(RefuError, ValueError):
    """Base of everything that can go wrong between messages, bags, files and frames."""


class DecodeError(AdapterError):
    """A message that can't be turned into a frame: damaged bytes, an undeclared layout, values that aren't finite."""


class EncodeError(AdapterError):
    """Values that can't be put into a message: wrong shapes, not finite, times outside a message's range."""


class BagError(AdapterError):
    """A bag that can't be read or written, or that doesn't hold what was asked for."""


class MotionFileError(AdapterError):
    """A file of motion that can't be read."""


class TransformError(AdapterError):
    """No transform leads from one frame to another, or none at the time asked for."""


@contextmanager
def decoding(message_type: str) -> Iterator[None]:
    """Every error of a message's content becomes a `DecodeError` that names the message's type."""
    try:
        with np.errstate(invalid="ignore"):  # signalling NaNs warn when they are cast; the frame refuses all NaNs
            yield
    except (DecodeError, FrameError) as error:
        raise DecodeError(f"{message_type}: {error}") from None
