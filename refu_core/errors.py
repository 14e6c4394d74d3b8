"""Errors of `refu_core`: each message says what was wanted, what came, and what to do next."""

from __future__ import annotations


class RefuError(Exception):
    """Base of every error this project raises on purpose; the commands turn it into one line and exit code 2."""


class FrameError(RefuError, ValueError):
    """Body parameters of a wrong shape, or not finite."""


class BodyError(RefuError, ValueError):
    """A body model file that can't be read, isn't an SMPL-layout model, or a body name that doesn't exist."""


class GarmentError(RefuError, ValueError):
    """An unknown garment, or garments that can't be worn together."""


class MeshError(RefuError, ValueError):
    """Vertices or faces of a wrong shape, not finite, or not watertight where that is needed."""


class WeightsError(RefuError, ValueError):
    """Weights that are missing, damaged, or trained for another garment or body."""
