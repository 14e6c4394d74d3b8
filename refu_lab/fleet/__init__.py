"""Many inputs, many processes, many machines: what is found, who does it, where it is kept, what it comes to.

A scheduler and workers import this package for what runs there, so what needs torch is imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from refu_lab.fleet._engine import FleetError, open_engine, run_function
from refu_lab.fleet._inputs import Input, find_data_sets, find_recordings, is_plain
from refu_lab.fleet._storage import Folder, fetched, is_url
from refu_lab.fleet._summary import FleetResult, fleet_table

if TYPE_CHECKING:
    from refu_lab.fleet._replay import FleetOptions, pipeline_for, replay_fleet

__all__ = [
    "FleetError",
    "FleetOptions",
    "FleetResult",
    "Folder",
    "Input",
    "fetched",
    "find_data_sets",
    "find_recordings",
    "fleet_table",
    "is_plain",
    "is_url",
    "open_engine",
    "pipeline_for",
    "replay_fleet",
    "run_function",
]


def __getattr__(name: str) -> Any:
    if name not in ("FleetOptions", "pipeline_for", "replay_fleet"):
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    return getattr(import_module(f"{__name__}._replay"), name)
