"""The Repulsive Force Unit: penetrating garment vertices leave the body along the gradient of its signed distance."""

from refu_core.repulsion._limbs import Limbs as Limbs
from refu_core.repulsion._resolve import Resolution as Resolution
from refu_core.repulsion._resolve import resolve as resolve
from refu_core.repulsion._unit import DEFAULT_MARGIN as DEFAULT_MARGIN
from refu_core.repulsion._unit import MAX_DISPLACEMENT as MAX_DISPLACEMENT
from refu_core.repulsion._unit import repulse as repulse
