"""From a frame of body parameters to garments: what the node, the replay and a Python user call."""

from refu_core.realtime._pipeline import (
    SDF_MODES,
    FrameStats,
    GarmentMesh,
    GarmentPipeline,
    GarmentStats,
    PipelineOutput,
)

__all__ = ["SDF_MODES", "FrameStats", "GarmentMesh", "GarmentPipeline", "GarmentStats", "PipelineOutput"]
