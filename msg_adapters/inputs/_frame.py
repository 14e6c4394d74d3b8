"""What the input types share: turning what a message holds into a frame, and errors that name the message."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.cdr import NS_PER_S
from msg_adapters.errors import DecodeError
from refu_core.errors import FrameError
from refu_core.frames import SmplFrame


@contextmanager
def decoding(message_type: str) -> Iterator[None]:
    """Every error of a message's content becomes a `DecodeError` that names the message's type."""
    try:
        with np.errstate(invalid="ignore"):  # signalling NaNs warn when they are cast; the frame refuses all NaNs
            yield
    except (DecodeError, FrameError) as error:
        msg = f"{message_type}: {error}"
        raise DecodeError(msg) from None


@contextmanager
def reading_fields(message: object) -> Iterator[None]:
    """An object without the fields, or with fields of another kind, is a `DecodeError` too."""
    try:
        yield
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, DecodeError):
            raise
        got = f"{type(message).__module__}.{type(message).__qualname__}"
        msg = f"wanted a message object of this type, got {got}: {error}"
        raise DecodeError(msg) from None


def stamp_ns_of(header: Any) -> int:
    """Stamp of a message object's header [ns]."""
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)


def smpl_frame(
    pose: NDArray[Any],
    betas: NDArray[Any] | None,
    transl: NDArray[Any] | None,
    *,
    style: NDArray[Any] | None = None,
    stamp_ns: int = 0,
) -> SmplFrame:
    """The validated frame; what a message leaves out is zero."""
    given = {"betas": betas, "transl": transl, "style": style}
    return SmplFrame(
        pose=pose, stamp_ns=stamp_ns, **{name: value for name, value in given.items() if value is not None}
    )
