"""Ground truth: simulated garments for any body, pose, shape and style, checked to be free of collisions."""

from refu_core.errors import SimulationError as SimulationError
from refu_core.simulation._cloth import ClothSettings as ClothSettings
from refu_core.simulation._dataset import GarmentDataset as GarmentDataset
from refu_core.simulation._dataset import GarmentSample as GarmentSample
from refu_core.simulation._dataset import GarmentSequence as GarmentSequence
from refu_core.simulation._dataset import GarmentSequences as GarmentSequences
from refu_core.simulation._dataset import open_dataset as open_dataset
from refu_core.simulation._drape import Draper as Draper
from refu_core.simulation._drape import DrapeSettings as DrapeSettings
from refu_core.simulation._drape import SettledDrape as SettledDrape
from refu_core.simulation._drape import canonical_pose as canonical_pose
from refu_core.simulation._drape import colliders as colliders
from refu_core.simulation._plan import SamplePlan as SamplePlan
from refu_core.simulation._poses import Clip as Clip
from refu_core.simulation._poses import load_clips as load_clips
from refu_core.simulation._poses import random_pose as random_pose
from refu_core.simulation._poses import split_clips as split_clips
from refu_core.simulation._produce import Progress as Progress
from refu_core.simulation._produce import simulate_dataset as simulate_dataset
from refu_core.simulation._selection import CAUSES as CAUSES
from refu_core.simulation._selection import SelectionSettings as SelectionSettings
from refu_core.simulation._sequences import SequencePlan as SequencePlan
from refu_core.simulation._sequences import SequenceSettings as SequenceSettings
from refu_core.simulation._sequences import simulate_sequences as simulate_sequences
from refu_core.simulation._summary import summarise as summarise
from refu_core.simulation._worker import SimulationSettings as SimulationSettings
