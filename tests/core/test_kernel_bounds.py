"""No kernel reads or writes beyond an array: run once with Warp's own checks compiled in, which end the process."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

_RUN = """
import sys
import warp as wp

wp.config.mode = "debug"
wp.config.kernel_cache_dir = sys.argv[1]
import numpy as np
import torch

from refu_core import GarmentPipeline, SmplFrame

torch.set_num_threads(1)
rng = np.random.default_rng(0)
spreads = (0.1, 0.8)  # who hardly moves, and limbs through each other and the trunk
frames = [SmplFrame(pose=rng.normal(0, spread, (24, 3)), betas=rng.normal(size=10)) for spread in spreads]
for sdf in ("accurate", "hybrid"):
    pipeline = GarmentPipeline.load(["tshirt-male", "short-pant-male"], sdf=sdf, backbone="tailornet")
    for frame in frames:
        pipeline(frame)
print("in bounds")
"""


def test_kernels_stay_in_bounds_on_bodies_in_a_tangle() -> None:
    # Kept from run to run, apart from the others': Warp compiles what has changed, and all takes half a minute.
    kept = Path(tempfile.gettempdir(), f"refu-kernels-{os.getuid()}")
    command = [sys.executable, "-c", _RUN, str(kept)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.endswith("in bounds\n")
