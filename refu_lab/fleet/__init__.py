"""Many inputs on many processes or machines: finding the inputs, running the tasks, storing and summing up results.

A scheduler and workers import this package for what runs there, so whatever needs torch is in `refu_lab.fleet.replay`.
"""

from refu_lab.fleet._engine import open_engine as open_engine
from refu_lab.fleet._inputs import find_data_sets as find_data_sets
from refu_lab.fleet._inputs import find_recordings as find_recordings
from refu_lab.fleet._inputs import is_plain as is_plain
from refu_lab.fleet._summary import fleet_table as fleet_table
