"""Training of backbones, SDF networks and ReFU; needs the extra `train`."""

from refu_core.training._beyond import BeyondSettings as BeyondSettings
from refu_core.training._beyond import train_beyond as train_beyond
from refu_core.training._carry import CarrySettings as CarrySettings
from refu_core.training._carry import carry_over as carry_over
from refu_core.training._dresser import collision_loss as collision_loss
from refu_core.training._dresser import reconstruction_loss as reconstruction_loss
from refu_core.training._dresser import refu_loss as refu_loss
from refu_core.training._dynamics import DynamicsSettings as DynamicsSettings
from refu_core.training._dynamics import train_dynamics as train_dynamics
from refu_core.training._finetune import FinetuneSettings as FinetuneSettings
from refu_core.training._finetune import finetune as finetune
from refu_core.training._loop import LoopSettings as LoopSettings
from refu_core.training._pretrain import PretrainSettings as PretrainSettings
from refu_core.training._pretrain import pretrain as pretrain
from refu_core.training._record import TrainingLog as TrainingLog
from refu_core.training._record import load_checkpoint as load_checkpoint
from refu_core.training._rehearsal import Rehearsal as Rehearsal
from refu_core.training._sdf import SdfSettings as SdfSettings
from refu_core.training._sdf import train_sdf as train_sdf
