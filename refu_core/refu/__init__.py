"""The paper's layer: the Repulsive Force Unit, its scale networks, and their weights."""

from refu_core.refu._files import refu_from_weights as refu_from_weights
from refu_core.refu._files import refu_tensors as refu_tensors
from refu_core.refu._files import trained_from_weights as trained_from_weights
from refu_core.refu._layer import Refu as Refu
from refu_core.refu._scale import PAPER as PAPER
from refu_core.refu._scale import REALTIME as REALTIME
from refu_core.refu._scale import SCALE_PRESETS as SCALE_PRESETS
from refu_core.refu._scale import ScaleKind as ScaleKind
from refu_core.refu._scale import ScaleNet as ScaleNet
from refu_core.refu._scale import ScaleSettings as ScaleSettings
from refu_core.refu._scale import VertexScale as VertexScale
from refu_core.refu._unit import MAX_DISPLACEMENT as MAX_DISPLACEMENT
from refu_core.refu._unit import repulse as repulse
from refu_core.refu._unit import require_margin as require_margin
from refu_core.refu._unit import unit_direction as unit_direction
