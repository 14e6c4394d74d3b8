"""Networks that predict a garment's displacement in the unposed space; `skinned` is the one without a network."""

from refu_core.backbones._decoder import BasisDecoder, Decoder, DenseDecoder
from refu_core.backbones._features import (
    ENCODINGS,
    GARMENT_JOINTS,
    N_STYLE_SHAPE,
    PoseFeatures,
    style_shape,
    tilt_rotvec,
    up_in_root,
)
from refu_core.backbones._files import (
    BACKBONES,
    MODES,
    load_backbone,
    load_basis,
    read_backbone,
    save_backbone,
    save_basis,
)
from refu_core.backbones._frequency import LaplacianSmoothing
from refu_core.backbones._gcnn import Gcnn, GcnnConfig
from refu_core.backbones._mlp import Mlp, MlpConfig
from refu_core.backbones._presets import PRESETS, TRAINABLE, BackboneConfig, backbone_config, build_backbone, uses_basis
from refu_core.backbones._protocol import Backbone, Prediction, Skinned
from refu_core.backbones._tailornet import (
    TailorNet,
    TailorNetConfig,
    kernel_weights,
    non_negligible,
    without_negligible,
)

__all__ = [
    "BACKBONES",
    "ENCODINGS",
    "GARMENT_JOINTS",
    "MODES",
    "N_STYLE_SHAPE",
    "PRESETS",
    "TRAINABLE",
    "Backbone",
    "BackboneConfig",
    "BasisDecoder",
    "Decoder",
    "DenseDecoder",
    "Gcnn",
    "GcnnConfig",
    "LaplacianSmoothing",
    "Mlp",
    "MlpConfig",
    "PoseFeatures",
    "Prediction",
    "Skinned",
    "TailorNet",
    "TailorNetConfig",
    "backbone_config",
    "build_backbone",
    "kernel_weights",
    "load_backbone",
    "load_basis",
    "non_negligible",
    "read_backbone",
    "save_backbone",
    "save_basis",
    "style_shape",
    "tilt_rotvec",
    "up_in_root",
    "uses_basis",
    "without_negligible",
]
