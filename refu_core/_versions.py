"""Versions of this project and of what it runs with, for the cards of weights and data sets, and for pages."""

from __future__ import annotations

from importlib import metadata

VERSION = "0.2.0"


def installed(distribution: str) -> str:
    """The version of a distribution, or "not installed": a source tree on the path has no metadata."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


def versions(*distributions: str) -> dict[str, str]:
    """The versions of this project and of these distributions, by name."""
    return {"refu-ros": VERSION, **{name: installed(name) for name in distributions}}
