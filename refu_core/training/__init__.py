"""Training of backbones, SDF networks and ReFU; needs the extra `train`."""

from refu_core.training._carry import CarrySettings, carry_over
from refu_core.training._checkpoint import load_checkpoint, save_checkpoint
from refu_core.training._data import TrainingSamples, output_basis, read_samples, split_validation
from refu_core.training._figures import backbone_figures, displacements, posed_errors
from refu_core.training._finetune import FINETUNE_MODES, FinetuneSettings, finetune
from refu_core.training._loop import LoopSettings
from refu_core.training._losses import Losses, collision_loss, reconstruction_loss, refu_loss
from refu_core.training._mirror import Mirror, mirror_pose
from refu_core.training._pretrain import PretrainSettings, pretrain
from refu_core.training._progress import TrainingLog
from refu_core.training._sdf import SdfSettings, train_sdf
from refu_core.training._sharpen import in_new_codes, next_gains, orthonormal, sharpened

__all__ = [
    "FINETUNE_MODES",
    "CarrySettings",
    "FinetuneSettings",
    "LoopSettings",
    "Losses",
    "Mirror",
    "PretrainSettings",
    "SdfSettings",
    "TrainingLog",
    "TrainingSamples",
    "backbone_figures",
    "carry_over",
    "collision_loss",
    "displacements",
    "finetune",
    "in_new_codes",
    "load_checkpoint",
    "mirror_pose",
    "next_gains",
    "orthonormal",
    "output_basis",
    "posed_errors",
    "pretrain",
    "read_samples",
    "reconstruction_loss",
    "refu_loss",
    "save_checkpoint",
    "sharpened",
    "split_validation",
    "train_sdf",
]
