"""The Repulsive Force Unit: penetrating garment vertices leave the body along the gradient of its signed distance."""

from refu_core.repulsion._blend import Blend as Blend
from refu_core.repulsion._files import read_refu as read_refu
from refu_core.repulsion._files import refu_tensors as refu_tensors
from refu_core.repulsion._layers import LAYER_GAP as LAYER_GAP
from refu_core.repulsion._layers import LAYER_REACH as LAYER_REACH
from refu_core.repulsion._layers import Layer as Layer
from refu_core.repulsion._limbs import Limbs as Limbs
from refu_core.repulsion._postprocess import PostProcess as PostProcess
from refu_core.repulsion._postprocess import push_naively as push_naively
from refu_core.repulsion._refu import Refu as Refu
from refu_core.repulsion._resolve import Resolution as Resolution
from refu_core.repulsion._resolve import resolve as resolve
from refu_core.repulsion._resolver import Resolver as Resolver
from refu_core.repulsion._scale import PAPER as PAPER
from refu_core.repulsion._scale import REALTIME as REALTIME
from refu_core.repulsion._scale import SCALE_PRESETS as SCALE_PRESETS
from refu_core.repulsion._scale import ScaleKind as ScaleKind
from refu_core.repulsion._scale import ScaleNet as ScaleNet
from refu_core.repulsion._scale import ScaleSettings as ScaleSettings
from refu_core.repulsion._scale import VertexScale as VertexScale
from refu_core.repulsion._unit import DEFAULT_MARGIN as DEFAULT_MARGIN
from refu_core.repulsion._unit import MAX_DISPLACEMENT as MAX_DISPLACEMENT
from refu_core.repulsion._unit import repulse as repulse
