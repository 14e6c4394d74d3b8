"""Garments on SMPL bodies in real time, free of body-garment collisions.

Start with `GarmentPipeline.load(["tshirt-male"])` and call it with a `SmplFrame`. Each part can also be used alone,
from its own package: `keypoints` and `recordings` (the input), `body`, `garments`, `backbones`, `sdf`, `refu` (the
paper's layer), `contact` (brings a garment off the body), `realtime`, `outputs` (what robots ask about dressed people),
`observation` (fitting to a camera's points), `metrics`, `simulation`, `training`. The most used names are here, too.

Names are imported on first use, so that code that only needs `SmplFrame` doesn't wait for torch and warp.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any

from refu_core._collector import paused
from refu_core._versions import VERSION

if TYPE_CHECKING:
    from refu_core.body import SmplBody as SmplBody
    from refu_core.body import load_body as load_body
    from refu_core.contact import Resolver as Resolver
    from refu_core.errors import BodyError as BodyError
    from refu_core.errors import FrameError as FrameError
    from refu_core.errors import GarmentError as GarmentError
    from refu_core.errors import MeshError as MeshError
    from refu_core.errors import RefuError as RefuError
    from refu_core.errors import WeightsError as WeightsError
    from refu_core.frames import SmplFrame as SmplFrame
    from refu_core.garments import GarmentTemplate as GarmentTemplate
    from refu_core.garments import load_garment as load_garment
    from refu_core.history import PoseHistory as PoseHistory
    from refu_core.modes import BackboneName as BackboneName
    from refu_core.modes import SdfMode as SdfMode
    from refu_core.realtime import GarmentPipeline as GarmentPipeline
    from refu_core.realtime import PipelineOutput as PipelineOutput
    from refu_core.realtime import Wearer as Wearer
    from refu_core.realtime import dress as dress
    from refu_core.refu import Refu as Refu
    from refu_core.sdf import ApproxSdf as ApproxSdf
    from refu_core.sdf import BandSdf as BandSdf
    from refu_core.sdf import BodySdf as BodySdf
    from refu_core.sdf import ExactSdf as ExactSdf
    from refu_core.sdf import SdfSample as SdfSample

__version__ = VERSION
_LAZY = {
    name: package
    for package, names in {
        "body": ("SmplBody", "load_body"),
        "contact": ("Resolver",),
        "errors": ("BodyError", "FrameError", "GarmentError", "MeshError", "RefuError", "WeightsError"),
        "frames": ("SmplFrame",),
        "garments": ("GarmentTemplate", "load_garment"),
        "history": ("PoseHistory",),
        "modes": ("BackboneName", "SdfMode"),
        "realtime": ("GarmentPipeline", "PipelineOutput", "Wearer", "dress"),
        "refu": ("Refu",),
        "sdf": ("ApproxSdf", "BandSdf", "BodySdf", "ExactSdf", "SdfSample"),
    }.items()
    for name in names
}
"""The package that each name is imported from on first use."""
__all__ = sorted(_LAZY)


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
