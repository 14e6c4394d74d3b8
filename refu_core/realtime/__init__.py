"""From a frame of body parameters to garments: what the node, the replay and a Python user call."""

from refu_core.realtime._contact import ContactStage
from refu_core.realtime._dress import Drape, Dressed, dress
from refu_core.realtime._frame import Adjust
from refu_core.realtime._load import wearable_of
from refu_core.realtime._outputs import SKIPS, FrameStats, GarmentMesh, GarmentStats, PipelineOutput, SkinShift
from refu_core.realtime._pipeline import GarmentPipeline
from refu_core.realtime._promise import PROMISED_BEND, PROMISED_POSES, PROMISED_SIZE, SPINE, spine_bend, within_promise
from refu_core.realtime._turn import RootTurn
from refu_core.realtime._wearer import Outfit, Wearable, Wearer

__all__ = [
    "PROMISED_BEND",
    "PROMISED_POSES",
    "PROMISED_SIZE",
    "SKIPS",
    "SPINE",
    "Adjust",
    "ContactStage",
    "Drape",
    "Dressed",
    "FrameStats",
    "GarmentMesh",
    "GarmentPipeline",
    "GarmentStats",
    "Outfit",
    "PipelineOutput",
    "RootTurn",
    "SkinShift",
    "Wearable",
    "Wearer",
    "dress",
    "spine_bend",
    "wearable_of",
    "within_promise",
]
