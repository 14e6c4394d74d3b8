"""Garments on SMPL bodies, free of body-garment collisions: body, garments, signed distance, repulsion, real-time path.

The names below are imported on first use, so that code which only needs the frame type (bag readers, message
adapters) doesn't pay for torch and warp.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from refu_core.errors import BodyError, FrameError, GarmentError, MeshError, RefuError, WeightsError
from refu_core.frames import SmplFrame

if TYPE_CHECKING:
    from refu_core.body import SmplBody, load_body
    from refu_core.garments import GarmentTemplate, load_garment
    from refu_core.realtime import GarmentPipeline

__version__ = "0.1.0"
__all__ = [
    "BodyError",
    "FrameError",
    "GarmentError",
    "GarmentPipeline",
    "GarmentTemplate",
    "MeshError",
    "RefuError",
    "SmplBody",
    "SmplFrame",
    "WeightsError",
    "load_body",
    "load_garment",
]

_LAZY = {
    "GarmentPipeline": "refu_core.realtime",
    "GarmentTemplate": "refu_core.garments",
    "SmplBody": "refu_core.body",
    "load_body": "refu_core.body",
    "load_garment": "refu_core.garments",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    return getattr(import_module(_LAZY[name]), name)
