"""Simulate samples with two workers that are killed at random, and in one process: are the bytes the same?

    python benchmarks/fleet_kills.py GARMENT --folder DIR [--count 1000] [--every 60] [--scheduler-every 600]

`refu simulate` runs twice at the same time: alone, and with `--scheduler` on a cluster on this machine. Its workers get
SIGKILL at random, on average every `--every` seconds. Now and then the scheduler does too, and the same command is
given again. Prints how many were killed, and whether all rows are the same. Run again, this script goes on with what
is in DIR; a small garment makes it cheap (docs/guide/fleets.md).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

ROWS = "shard-0-of-1"
REFU = [sys.executable, "-m", "refu_lab"]


class Cluster:
    """A scheduler and two workers as processes on this machine."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "scheduler.json"
        self._folder = folder
        self.file.unlink(missing_ok=True)
        options = ["--no-dashboard", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(self.file)]
        self.scheduler = self._start("scheduler", *options)
        while not self.file.exists():
            time.sleep(0.1)
        self.address = json.loads(self.file.read_text())["address"]
        self.workers = [self._worker() for _ in range(2)]

    def _worker(self) -> subprocess.Popen[bytes]:
        return self._start("worker", self.address, "--nworkers", "1", "--nthreads", "1", "--no-nanny", "--no-dashboard")

    def _start(self, kind: str, *options: str) -> subprocess.Popen[bytes]:
        with (self._folder / f"{kind}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options],
                stdout=log,
                stderr=log,
                cwd=self._folder,
            )

    def kill_a_worker(self) -> None:
        """Kill one of the two; a new one takes its place."""
        k = random.randrange(2)
        self.workers[k].kill()
        self.workers[k].wait()
        self.workers[k] = self._worker()

    def kill(self) -> None:
        for process in (self.scheduler, *self.workers):
            process.kill()
            process.wait()


def _same(first: Path, second: Path) -> tuple[int, bool]:
    """How many rows both sets have, and whether these agree in everything but the seconds they took."""
    names = sorted(path.name for path in (first / ROWS).glob("*.npy") if path.name != "seconds.npy")
    sets = [{name: np.load(folder / ROWS / name, mmap_mode="r") for name in names} for folder in (first, second)]
    both = np.flatnonzero((sets[0]["state.npy"] > 0) & (sets[1]["state.npy"] > 0))
    return len(both), all(sets[0][name][both].tobytes() == sets[1][name][both].tobytes() for name in names)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garment")
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--every", type=float, default=60.0, help="seconds between kills of a worker, on average")
    parser.add_argument("--scheduler-every", type=float, default=600.0, help="and of the scheduler")
    args = parser.parse_args()
    args.folder = args.folder.resolve()
    args.folder.mkdir(parents=True, exist_ok=True)
    command = [*REFU, "simulate", str(Path(args.garment).resolve() if Path(args.garment).exists() else args.garment)]
    command += ["--count", str(args.count), "--quiet", "--output"]
    alone = subprocess.Popen([*command, str(args.folder / "alone")], stdout=subprocess.DEVNULL)
    killed = {"workers": 0, "schedulers": 0}
    code = -1
    while code != 0:
        cluster = Cluster(args.folder)
        run = subprocess.Popen(
            [*command, str(args.folder / "killed"), "--scheduler", cluster.address], stdout=subprocess.DEVNULL
        )
        end = time.monotonic() + random.expovariate(1 / args.scheduler_every)
        while run.poll() is None and time.monotonic() < end:
            time.sleep(min(random.expovariate(1 / args.every), max(1.0, end - time.monotonic())))
            if run.poll() is None and time.monotonic() < end:
                cluster.kill_a_worker()
                killed["workers"] += 1
                print(f"{time.strftime('%H:%M:%S')} killed {killed}", flush=True)
        if run.poll() is None:
            cluster.scheduler.kill()
            killed["schedulers"] += 1
            print(f"{time.strftime('%H:%M:%S')} killed {killed}", flush=True)
        code = run.wait()
        cluster.kill()
    alone.wait()
    n, same = _same(args.folder / "alone", args.folder / "killed")
    print(f"{n} rows in both sets, killed {killed}, same bytes: {same}")
    sys.exit(os.EX_OK if same and n == args.count else 1)


if __name__ == "__main__":
    main()
