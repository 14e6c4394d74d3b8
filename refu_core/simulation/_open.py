"""Opening a simulated set, of whichever kind it is."""

from __future__ import annotations

import json
from pathlib import Path

from refu_core.simulation._dataset import GarmentDataset
from refu_core.simulation._sequence_data import GarmentSequences
from refu_core.simulation._store import SEQUENCES


def open_dataset(path: str | Path) -> GarmentDataset | GarmentSequences:
    """Opens the set in the directory `path`: garments at rest, or sequences.

    Raises:
        SimulationError: there is no set, no shard, or a damaged one.
    """
    path = Path(path)
    try:
        kind = json.loads((path / "card.json").read_bytes())["format"]
    except (OSError, ValueError, KeyError, TypeError):
        kind = None  # the reader of sets of garments says what is wrong
    return GarmentSequences(path) if kind == SEQUENCES else GarmentDataset(path)
