"""Garments on SMPL bodies in real time, free of body-garment collisions.

Start with `GarmentPipeline.load(["tshirt-male"])` and call it with a `SmplFrame`. Each part can also be used alone,
from its own package: `keypoints` and `recordings` (the input), `body`, `garments`, `backbones`, `sdf`, `refu` (the
paper's layer), `contact` (brings a garment off the body), `realtime`, `outputs` (what robots ask about dressed people),
`observation` (fitting to a camera's points), `metrics`, `simulation`, `training`. The most used names are here, too.

Most names are imported on first use, so that code that only needs `SmplFrame` doesn't wait for torch and warp.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any

from refu_core._collector import paused
from refu_core._versions import VERSION
from refu_core.errors import BodyError, FrameError, GarmentError, MeshError, RefuError, WeightsError
from refu_core.frames import SmplFrame
from refu_core.modes import BackboneName, SdfMode

if TYPE_CHECKING:
    from refu_core.body import SmplBody, load_body
    from refu_core.contact import Resolver
    from refu_core.garments import GarmentTemplate, load_garment
    from refu_core.history import PoseHistory
    from refu_core.realtime import GarmentPipeline, PipelineOutput, Wearer, dress
    from refu_core.refu import Refu
    from refu_core.sdf import ApproxSdf, BandSdf, BodySdf, ExactSdf, SdfSample

__version__ = VERSION
__all__ = [
    "ApproxSdf",
    "BackboneName",
    "BandSdf",
    "BodyError",
    "BodySdf",
    "ExactSdf",
    "FrameError",
    "GarmentError",
    "GarmentPipeline",
    "GarmentTemplate",
    "MeshError",
    "PipelineOutput",
    "PoseHistory",
    "Refu",
    "RefuError",
    "Resolver",
    "SdfMode",
    "SdfSample",
    "SmplBody",
    "SmplFrame",
    "Wearer",
    "WeightsError",
    "dress",
    "load_body",
    "load_garment",
]

_LAZY = {
    name: package
    for package, names in {
        "body": ("SmplBody", "load_body"),
        "contact": ("Resolver",),
        "garments": ("GarmentTemplate", "load_garment"),
        "history": ("PoseHistory",),
        "realtime": ("GarmentPipeline", "PipelineOutput", "Wearer", "dress"),
        "refu": ("Refu",),
        "sdf": ("ApproxSdf", "BandSdf", "BodySdf", "ExactSdf", "SdfSample"),
    }.items()
    for name in names
}
"""The package that each name is imported from on first use."""


def _packages() -> set[str]:
    """The names of its packages and modules that others may use."""
    return {module.name for module in iter_modules(__path__) if not module.name.startswith("_")}


def __getattr__(name: str) -> Any:
    with paused():
        if name in _LAZY:
            return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
        if name in _packages():
            return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_packages(), *(name for name in globals() if name.startswith("__"))})
