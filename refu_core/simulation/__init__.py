"""Ground truth: simulated garments for any body, pose, shape and style, checked to be free of collisions."""

from refu_core.simulation._cloth import ClothSettings
from refu_core.simulation._dataset import GarmentDataset, GarmentSample
from refu_core.simulation._drape import Drape, Draper, DrapeSettings, canonical_pose
from refu_core.simulation._errors import SimulationError
from refu_core.simulation._open import open_dataset
from refu_core.simulation._plan import Plan
from refu_core.simulation._poses import Clip, RoomSettings, load_clips, split_clips
from refu_core.simulation._produce import Progress
from refu_core.simulation._run import simulate_dataset
from refu_core.simulation._selection import CAUSES, SelectionSettings
from refu_core.simulation._sequence_data import GarmentSequence, GarmentSequences
from refu_core.simulation._sequences import (
    SequencePlan,
    SequenceSettings,
    simulate_sequences,
    summarise_sequences,
)
from refu_core.simulation._sheet import contact_sheet
from refu_core.simulation._styles import StyleBasis, Tailoring, build_styles, tailoring_of
from refu_core.simulation._summary import summarise
from refu_core.simulation._worker import SimulationSettings

__all__ = [
    "CAUSES",
    "Clip",
    "ClothSettings",
    "Drape",
    "DrapeSettings",
    "Draper",
    "GarmentDataset",
    "GarmentSample",
    "GarmentSequence",
    "GarmentSequences",
    "Plan",
    "Progress",
    "RoomSettings",
    "SelectionSettings",
    "SequencePlan",
    "SequenceSettings",
    "SimulationError",
    "SimulationSettings",
    "StyleBasis",
    "Tailoring",
    "build_styles",
    "canonical_pose",
    "contact_sheet",
    "load_clips",
    "open_dataset",
    "simulate_dataset",
    "simulate_sequences",
    "split_clips",
    "summarise",
    "summarise_sequences",
    "tailoring_of",
]
