"""What a fresh process needs: time until its first garments, and memory.

`refu benchmark` runs this file as a script, so that only what a user would import counts. Its arguments are the time it
was started (Unix time) and, as JSON, the arguments of `GarmentPipeline.load`; it prints one line of JSON.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

FRAMES = 30
"""Frames after the first, before memory is measured."""


def memory_mb() -> tuple[float, float]:
    """Resident memory of this process, current and peak [MB]."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    fields = dict(line.split(":", 1) for line in lines if ":" in line)
    now, peak = (float(fields[key].split()[0]) * 1024e-6 for key in ("VmRSS", "VmHWM"))
    return now, peak


def main() -> None:
    """Loads a pipeline, dresses one body, and goes on for some frames."""
    started, asked = float(sys.argv[1]), json.loads(sys.argv[2])

    import numpy as np
    import torch

    from refu_core import GarmentPipeline, SmplFrame

    torch.set_num_threads(1)
    imported = time.time()
    pipeline = GarmentPipeline.load(**asked)
    loaded = time.time()
    pose = np.zeros((24, 3), np.float32)
    pipeline(SmplFrame(pose=pose))
    first, cpu = time.time(), time.process_time()
    for i in range(FRAMES):
        pose = pose.copy()
        pose[16:18, 2] = -0.03 * i, 0.03 * i
        pipeline(SmplFrame(pose=pose))
    resident, peak = memory_mb()
    seconds = {"import_s": imported - started, "load_s": loaded - imported, "first_mesh_s": first - started}
    print(json.dumps({**seconds, "first_mesh_cpu_s": cpu, "resident_mb": resident, "peak_mb": peak}))


if __name__ == "__main__":
    main()
