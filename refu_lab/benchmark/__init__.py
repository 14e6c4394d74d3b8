"""What `refu benchmark` does: measures run time and error of every mode and signed distance side by side in one run."""

from refu_lab.benchmark._benchmark import benchmark as benchmark
from refu_lab.benchmark._measure import measure as measure
from refu_lab.benchmark._measure import one_core as one_core
from refu_lab.benchmark._sdfs import SdfFrame as SdfFrame
from refu_lab.benchmark._sdfs import sdf_methods as sdf_methods
from refu_lab.benchmark._tables import benchmark_text as benchmark_text
from refu_lab.benchmark._tables import write_results as write_results
