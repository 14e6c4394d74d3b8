"""Exact collisions of garments with bodies, themselves and each other, self-contact of bodies, the paper's metrics."""

from refu_core.metrics._collisions import CollisionChecker as CollisionChecker
from refu_core.metrics._collisions import Collisions as Collisions
from refu_core.metrics._collisions import SheetChecker as SheetChecker
from refu_core.metrics._garment import Figures as Figures
from refu_core.metrics._garment import FoldBands as FoldBands
from refu_core.metrics._garment import FrameMetrics as FrameMetrics
from refu_core.metrics._garment import GarmentMetrics as GarmentMetrics
from refu_core.metrics._self_contact import SelfContact as SelfContact
from refu_core.metrics._self_contact import SelfContactDetector as SelfContactDetector
