"""Checks of what the outputs are given."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from refu_core.body import SmplBody
from refu_core.errors import MeshError, require_type
from refu_core.garments import GarmentTemplate


def require_outfit(body: object, garments: object) -> None:
    """Raises `MeshError` for anything but a body and garments by name."""
    require_type(body, SmplBody, "a SmplBody, as load_body gives", error=MeshError)
    require_type(garments, Mapping, "garments by name", error=MeshError)
    assert isinstance(garments, Mapping)
    for garment in garments.values():
        require_garment(garment)


def require_garment(garment: object) -> None:
    """Raises `MeshError` for anything but a garment."""
    require_type(garment, GarmentTemplate, "a garment, as pipeline.garments[name]", error=MeshError)


def require_worn(output: object, known: Collection[str]) -> None:
    """Raises `MeshError` for anything but a pipeline's output, and for a garment that isn't `known`."""
    if not (isinstance(output, Mapping) and hasattr(output, "body")):
        raise MeshError(f"wanted a pipeline's output of one person, got {type(output).__name__}")
    for name in output:
        require_known(name, known)


def require_known(name: str, known: Collection[str]) -> None:
    """Raises `MeshError` for a garment that isn't `known`."""
    if not isinstance(name, str) or name not in known:
        raise MeshError(f"no garment {name!r} here: wanted one of {', '.join(known)}")
