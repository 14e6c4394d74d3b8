"""Exact collisions, the body's self-contact, and the paper's metrics.

Pictures are in `refu_core.evaluation.render`, the paper's tables in `refu_core.evaluation.reproduction`.
"""

from refu_core.evaluation.collisions import CollisionChecker as CollisionChecker
from refu_core.evaluation.collisions import Collisions as Collisions
from refu_core.evaluation.jitter import temporal_jitter as temporal_jitter
from refu_core.evaluation.metrics import Figures as Figures
from refu_core.evaluation.metrics import FrameMetrics as FrameMetrics
from refu_core.evaluation.metrics import GarmentMetrics as GarmentMetrics
from refu_core.evaluation.metrics import MetricsSummary as MetricsSummary
from refu_core.evaluation.sdf_errors import SdfErrors as SdfErrors
from refu_core.evaluation.self_contact import DEFAULT_NEAR as DEFAULT_NEAR
from refu_core.evaluation.self_contact import SelfContact as SelfContact
from refu_core.evaluation.self_contact import SelfContactDetector as SelfContactDetector
