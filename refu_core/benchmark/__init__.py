"""What a frame costs, and what it could cost: contenders measured in turn, the paper's structure, the machine's limits.

The command `refu benchmark` is made of these parts. Nothing in the library imports them.
"""

from refu_core.benchmark._machine import Rates as Rates
from refu_core.benchmark._machine import load_average as load_average
from refu_core.benchmark._machine import machine_facts as machine_facts
from refu_core.benchmark._machine import measure_rates as measure_rates
from refu_core.benchmark._measure import Timing as Timing
from refu_core.benchmark._measure import measure as measure
from refu_core.benchmark._measure import one_core as one_core
from refu_core.benchmark._measure import processor_clock as processor_clock
from refu_core.benchmark._paper import PaperSettings as PaperSettings
from refu_core.benchmark._paper import PaperStructure as PaperStructure
from refu_core.benchmark._sdfs import PLAIN_QUERY as PLAIN_QUERY
from refu_core.benchmark._sdfs import SdfFrame as SdfFrame
from refu_core.benchmark._sdfs import SdfMethod as SdfMethod
from refu_core.benchmark._sdfs import sdf_methods as sdf_methods
from refu_core.benchmark._work import StageWork as StageWork
from refu_core.benchmark._work import least_work as least_work
