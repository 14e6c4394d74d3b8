"""Many inputs, many processes, many machines: what is found, who does it, where it is kept, what it comes to."""

from refu_lab.fleet._engine import FleetError, open_engine, run_function
from refu_lab.fleet._inputs import Input, find_data_sets, find_recordings, is_plain
from refu_lab.fleet._replay import FleetOptions, replay_fleet
from refu_lab.fleet._storage import Folder, fetched, is_url
from refu_lab.fleet._summary import FleetResult, fleet_table

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
    "replay_fleet",
    "run_function",
]
