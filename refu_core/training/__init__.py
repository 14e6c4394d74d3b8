"""Training of backbones, SDF networks and ReFU; needs the extra `train`."""

from refu_core.training._carry import CarrySettings as CarrySettings
from refu_core.training._carry import carry_over as carry_over
from refu_core.training._checkpoint import load_checkpoint as load_checkpoint
from refu_core.training._checkpoint import save_checkpoint as save_checkpoint
from refu_core.training._data import TrainingSamples as TrainingSamples
from refu_core.training._data import output_basis as output_basis
from refu_core.training._data import read_samples as read_samples
from refu_core.training._data import split_validation as split_validation
from refu_core.training._figures import backbone_figures as backbone_figures
from refu_core.training._figures import displacements as displacements
from refu_core.training._figures import posed_errors as posed_errors
from refu_core.training._finetune import FINETUNE_MODES as FINETUNE_MODES
from refu_core.training._finetune import FinetuneSettings as FinetuneSettings
from refu_core.training._finetune import finetune as finetune
from refu_core.training._loop import LoopSettings as LoopSettings
from refu_core.training._losses import Losses as Losses
from refu_core.training._losses import collision_loss as collision_loss
from refu_core.training._losses import reconstruction_loss as reconstruction_loss
from refu_core.training._losses import refu_loss as refu_loss
from refu_core.training._mirror import Mirror as Mirror
from refu_core.training._mirror import mirror_pose as mirror_pose
from refu_core.training._pretrain import PretrainSettings as PretrainSettings
from refu_core.training._pretrain import pretrain as pretrain
from refu_core.training._progress import TrainingLog as TrainingLog
from refu_core.training._sdf import SdfSettings as SdfSettings
from refu_core.training._sdf import train_sdf as train_sdf
