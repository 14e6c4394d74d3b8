"""What a process of its own needs: time until its first garments, and memory.

`refu benchmark` runs this file as a script, so that nothing is counted but what a user imports. It prints a line of
JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

FRAMES = 30
"""Frames after the first, until memory is looked at."""


def memory_mb() -> tuple[float, float] | tuple[None, None]:
    """Resident memory of this process, now and at most [MB]; None where the system doesn't say."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None, None
    fields = dict(line.split(":", 1) for line in status.read_text(encoding="ascii").splitlines() if ":" in line)
    now, peak = (float(fields[key].split()[0]) * 1024e-6 for key in ("VmRSS", "VmHWM"))
    return now, peak


def main() -> None:
    """Loads, dresses one body, and goes on for a while."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garments", required=True)
    parser.add_argument("--sdf", required=True)
    parser.add_argument("--backbone", required=True)
    parser.add_argument("--weights")
    parser.add_argument("--body")
    parser.add_argument("--no-collider", dest="collider", action="store_false")
    parser.add_argument("--started", type=float, required=True, help="when the process was started (Unix time)")
    args = parser.parse_args()

    import numpy as np
    import torch

    from refu_core import GarmentPipeline, SmplFrame

    torch.set_num_threads(1)
    imported = time.time()
    pipeline = GarmentPipeline.load(
        args.garments.split(","),
        sdf=args.sdf,
        backbone=args.backbone,
        weights=args.weights,
        body=args.body,
        collider=args.collider,
    )
    loaded = time.time()
    pose = np.zeros((24, 3), np.float32)
    pipeline(SmplFrame(pose=pose))
    first, cpu = time.time(), time.process_time()
    for i in range(FRAMES):
        pose = pose.copy()
        pose[16:18, 2] = -0.03 * i, 0.03 * i
        pipeline(SmplFrame(pose=pose))
    resident, peak = memory_mb()
    seconds = {"import_s": imported - args.started, "load_s": loaded - imported, "first_mesh_s": first - args.started}
    print(json.dumps({**seconds, "first_mesh_cpu_s": cpu, "resident_mb": resident, "peak_mb": peak}))


if __name__ == "__main__":
    main()
