"""Fuzzing: all that reads what somebody else wrote is given damaged, absurd and hostile input, in great number."""

from refu_ros.fuzz._guard import Guard, Outcome
from refu_ros.fuzz._run import Finding, FuzzOptions, FuzzRow, fuzz, fuzz_dict, fuzz_progress, fuzz_table, fuzz_target
from refu_ros.fuzz._target import Target
from refu_ros.fuzz._targets import TARGETS

__all__ = [
    "TARGETS",
    "Finding",
    "FuzzOptions",
    "FuzzRow",
    "Guard",
    "Outcome",
    "Target",
    "fuzz",
    "fuzz_dict",
    "fuzz_progress",
    "fuzz_table",
    "fuzz_target",
]
