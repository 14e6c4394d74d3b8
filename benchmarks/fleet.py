"""What a fleet costs, on a quiet machine: two workers against one, conversion against the pipeline, memory over time.

    python benchmarks/fleet.py [--only convert | workers | long] [--bags 20] [--frames 60] [--long 108000]

Prints the share of the pipeline's speed that conversion reaches on the cores that it is given (taskset -c 0 for one);
seconds per recording with one worker and with two, and whether the results are bit-identical; and, with `--only long`,
the memory of a conversion over time.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import msg_adapters as adapters
from refu_core import SmplFrame
from refu_lab.commands.replay import ReplayOptions
from refu_lab.fleet import find_recordings, open_engine
from refu_lab.fleet.replay import FleetOptions, replay_fleet
from refu_lab.replay import replay
from refu_lab.sources import open_source
from refu_lab.stress import resident_mb

ROOT = Path(__file__).parents[1]


def _frames() -> list[SmplFrame]:
    records = adapters.iter_smpl_frames(ROOT / "bags" / "walk")
    return [record.frame for record in records if record.frame is not None]


def _write(path: Path, frames: list[SmplFrame], count: int, first: int) -> None:
    encode = adapters.encoder_for("multiarray")
    with adapters.BagWriter(path, overwrite=True) as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        for i, frame in enumerate(itertools.islice(itertools.cycle(frames), first, first + count)):
            writer.write("/smpl_params", encode(frame), log_time_ns=10**18 + i * 33_333_333)


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.mcap")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _workers(folder: Path, jobs: int) -> tuple[float, str]:
    """Seconds that `jobs` workers, already started, take for a run, and a digest of the bags."""
    recordings, out = find_recordings([str(folder / "bags")]), folder / f"out-{jobs}"
    options = FleetOptions(replay=ReplayOptions(input=Path()), output=str(out))
    with open_engine(jobs) as engine:
        warm = FleetOptions(replay=options.replay, output=str(folder / f"warm-{jobs}"))
        replay_fleet(recordings[: 2 * jobs], warm, engine=engine)
        start = time.perf_counter()
        replay_fleet(recordings, options, engine=engine)
        return time.perf_counter() - start, _digest(out)


def _convert(folder: Path, frames: list[SmplFrame], rounds: int) -> None:
    """Time the pipeline alone and a conversion of the same frames in turn, so that both see the same machine load."""
    options = ReplayOptions(input=folder / "part.mcap", output=folder / "out.mcap", evaluate=False, overwrite=True)
    pipeline = options.load_pipeline()
    part = frames[:150]
    _write(options.input, part, len(part), 0)
    clocks = {"wall": time.perf_counter, "all threads' CPU": time.process_time, "this thread's CPU": time.thread_time}
    seconds = []
    for _ in range(rounds + 1):
        before = [clock() for clock in clocks.values()]
        for frame in part:
            pipeline(frame)
        between = [clock() for clock in clocks.values()]
        replay(options, source=open_source(options, pipeline))
        after = [clock() for clock in clocks.values()]
        seconds.append((np.subtract(between, before), np.subtract(after, between)))
    ms = 1e3 / len(part) * np.array(seconds[1:])  # the first round warms up kernels and caches
    print(f"{len(os.sched_getaffinity(0))} cores, ms a frame, medians of {rounds} rounds (smallest share, largest)")
    for i, name in enumerate(clocks):
        alone, converted = ms[:, 0, i], ms[:, 1, i]
        share = 100 * alone / converted
        print(
            f"{name:18} pipeline {np.median(alone):5.1f}  conversion {np.median(converted):5.1f}  "
            f"{np.median(share):.0f} % of its speed ({share.min():.0f}, {share.max():.0f})"
        )


def _long(folder: Path, frames: list[SmplFrame], count: int, garments: tuple[str, ...], *, with_body: bool) -> None:
    """Converts a recording of `count` frames; the log memory.txt gets a line every half minute."""
    log, out = folder / "memory.txt", folder / "long-out.mcap"
    options = ReplayOptions(
        input=folder / "long.mcap",
        output=out,
        garments=garments,
        evaluate=False,
        overwrite=True,
        with_body=with_body,
    )
    _write(options.input, frames, count, 0)
    start, done = time.perf_counter(), threading.Event()

    def watch() -> None:
        while not done.wait(30):
            size = out.stat().st_size / 1e6 if out.exists() else 0.0
            with log.open("a") as file:
                file.write(f"{time.perf_counter() - start:.0f} s, bag {size:.0f} MB, memory {resident_mb():.1f} MB\n")

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    result = replay(options)
    done.set()
    watcher.join()
    took = time.perf_counter() - start
    with log.open("a") as file:
        file.write(f"{len(result.latencies_ms)} frames in {took:.0f} s, memory {resident_mb():.1f} MB at the end\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bags", type=int, default=20)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--long", type=int, default=108_000)
    parser.add_argument("--garments", default="tshirt-male", help="of the long recording")
    parser.add_argument("--no-body", action="store_true", help="the long recording's output has garments alone")
    parser.add_argument("--folder", type=Path, help="of the long recording, and its log memory.txt (a temporary one)")
    parser.add_argument("--only", choices=("workers", "convert", "long"))
    args = parser.parse_args()
    frames = _frames()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if args.only in (None, "convert"):
            _convert(folder, frames, args.rounds)
        if args.only == "long":
            place = args.folder or folder
            place.mkdir(parents=True, exist_ok=True)
            _long(place, frames, args.long, tuple(args.garments.split(",")), with_body=not args.no_body)
            print((place / "memory.txt").read_text())
        if args.only in (None, "workers"):
            (folder / "bags").mkdir()
            for i in range(args.bags):
                _write(
                    folder / "bags" / f"bag{i:03}.mcap", frames, args.frames, int(np.random.default_rng(i).integers(99))
                )
            (one, first), (two, second) = (_workers(folder, jobs) for jobs in (1, 2))
            print(f"one worker          {one / args.bags:8.2f} s a recording of {args.frames} frames")
            print(f"two workers         {two / args.bags:8.2f} s, {one / two:.2f} times as fast")
            print(f"same bytes          {first == second}")


if __name__ == "__main__":
    main()
