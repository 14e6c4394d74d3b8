"""Networks that predict a garment's displacement in the unposed space; `skinned` is the one without a network."""

from refu_core.backbones._controls import Controls
from refu_core.backbones._decoder import BasisDecoder, Decoder, DenseDecoder
from refu_core.backbones._features import (
    ENCODINGS,
    N_STYLE_SHAPE,
    PoseFeatures,
    style_shape,
    tilt_rotvec,
    up_in_root,
)
from refu_core.backbones._files import (
    backbone_from_weights,
    backbone_weights,
    load_backbone,
    load_basis,
    save_backbone,
    save_basis,
)
from refu_core.backbones._frequency import LaplacianSmoothing
from refu_core.backbones._gcnn import Gcnn, GcnnConfig
from refu_core.backbones._mlp import Mlp, MlpConfig
from refu_core.backbones._presets import (
    PRESETS,
    TRAINABLE,
    BackboneConfig,
    Network,
    backbone_config,
    build_backbone,
    uses_basis,
)
from refu_core.backbones._protocol import MAX_OFFSET, Backbone, Prediction, Skinned, WithoutWearerCode
from refu_core.backbones._tailornet import TailorNet, TailorNetConfig, kernel_weights

__all__ = [
    "ENCODINGS",
    "MAX_OFFSET",
    "N_STYLE_SHAPE",
    "PRESETS",
    "TRAINABLE",
    "Backbone",
    "BackboneConfig",
    "BasisDecoder",
    "Controls",
    "Decoder",
    "DenseDecoder",
    "Gcnn",
    "GcnnConfig",
    "LaplacianSmoothing",
    "Mlp",
    "MlpConfig",
    "Network",
    "PoseFeatures",
    "Prediction",
    "Skinned",
    "TailorNet",
    "TailorNetConfig",
    "WithoutWearerCode",
    "backbone_config",
    "backbone_from_weights",
    "backbone_weights",
    "build_backbone",
    "kernel_weights",
    "load_backbone",
    "load_basis",
    "save_backbone",
    "save_basis",
    "style_shape",
    "tilt_rotvec",
    "up_in_root",
    "uses_basis",
]
