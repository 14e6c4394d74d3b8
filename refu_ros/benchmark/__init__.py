"""What `refu benchmark` does: run time against error of every mode and signed distance, side by side in one run."""

from refu_ros.benchmark._options import OUTPUT as OUTPUT
from refu_ros.benchmark._options import BenchmarkOptions as BenchmarkOptions
from refu_ros.benchmark._pages import benchmark_text as benchmark_text
from refu_ros.benchmark._pages import write_results as write_results
from refu_ros.benchmark._rows import BenchmarkResult as BenchmarkResult
from refu_ros.benchmark._rows import Row as Row
from refu_ros.benchmark._run import benchmark as benchmark
