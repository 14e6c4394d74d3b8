"""From a frame of body parameters to garments: what the node, the replay and a Python user call."""

from refu_core.realtime._outputs import SDF_MODES, SKIPS, FrameStats, GarmentMesh, GarmentStats, PipelineOutput
from refu_core.realtime._pipeline import GarmentPipeline

__all__ = [
    "SDF_MODES",
    "SKIPS",
    "FrameStats",
    "GarmentMesh",
    "GarmentPipeline",
    "GarmentStats",
    "PipelineOutput",
]
