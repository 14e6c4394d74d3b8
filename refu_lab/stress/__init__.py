"""Measures numerical stability: everyday and hostile frames, what collision handling promises, and endurance."""

from refu_lab.stress._rounds import StressResult as StressResult
from refu_lab.stress._rounds import replay_trial as replay_trial
from refu_lab.stress._rounds import run_stress as run_stress
from refu_lab.stress._rounds import stress_table as stress_table
from refu_lab.stress._soak import resident_mb as resident_mb
