"""Errors of `msg_adapters`: each message says what was wanted, what came, and what to do next."""

from __future__ import annotations

from refu_core.errors import RefuError


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
