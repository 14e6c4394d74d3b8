"""Checks of what the outputs are given."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from refu_core.errors import MeshError, require_type


def require_worn(output: object, known: Collection[str]) -> None:
    """Raises `MeshError` for anything but a pipeline's output, and for a garment that isn't `known`."""
    require_type(output, Mapping, "a pipeline's output of one person", error=MeshError)
    assert isinstance(output, Mapping)
    for name in output:
        require_known(name, known)


def require_known(name: str, known: Collection[str]) -> None:
    """Raises `MeshError` for a garment that isn't `known`."""
    if name not in known:
        raise MeshError(f"no garment {name!r} here: wanted one of {', '.join(known)}")
