"""Networks that predict a garment's displacement in the unposed space; `skinned` is the one without a network."""

from refu_core.backbones._protocol import BACKBONES, Backbone, Prediction, Skinned, load_backbone

__all__ = ["BACKBONES", "Backbone", "Prediction", "Skinned", "load_backbone"]
