"""No kernel reads or writes beyond an array: run once with Warp's own checks compiled in, which end the process."""

from __future__ import annotations

import subprocess
import sys
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


def test_kernels_stay_in_bounds_on_bodies_in_a_tangle(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _RUN, str(tmp_path)], capture_output=True, text=True, timeout=1800, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.endswith("in bounds\n")
