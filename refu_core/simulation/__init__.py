"""Ground truth: simulated garments for any body, pose, shape and style, checked to be free of collisions."""

from refu_core.simulation._cloth import ClothSettings
from refu_core.simulation._dataset import (
    GarmentDataset,
    GarmentSample,
    GarmentSequence,
    GarmentSequences,
    open_dataset,
)
from refu_core.simulation._drape import Draper, DrapeSettings, SettledDrape, canonical_pose, colliders
from refu_core.simulation._errors import SimulationError
from refu_core.simulation._plan import SamplePlan
from refu_core.simulation._poses import Clip, load_clips, random_pose, split_clips
from refu_core.simulation._produce import Progress
from refu_core.simulation._selection import CAUSES, SelectionSettings
from refu_core.simulation._sequences import SequencePlan, SequenceSettings, simulate_sequences
from refu_core.simulation._simulate import simulate_dataset
from refu_core.simulation._styles import StyleBasis, build_styles
from refu_core.simulation._summary import summarise, summarise_sequences
from refu_core.simulation._worker import SimulationSettings

__all__ = [
    "CAUSES",
    "Clip",
    "ClothSettings",
    "DrapeSettings",
    "Draper",
    "GarmentDataset",
    "GarmentSample",
    "GarmentSequence",
    "GarmentSequences",
    "Progress",
    "SamplePlan",
    "SelectionSettings",
    "SequencePlan",
    "SequenceSettings",
    "SettledDrape",
    "SimulationError",
    "SimulationSettings",
    "StyleBasis",
    "build_styles",
    "canonical_pose",
    "colliders",
    "load_clips",
    "open_dataset",
    "random_pose",
    "simulate_dataset",
    "simulate_sequences",
    "split_clips",
    "summarise",
    "summarise_sequences",
]
