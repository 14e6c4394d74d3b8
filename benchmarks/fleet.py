"""What a fleet costs, on a quiet machine: two workers beside one, conversion beside the pipeline, memory over time.

    python benchmarks/fleet.py [--bags 20] [--frames 60] [--long 3000]

Prints seconds a recording with one worker and with two, whether results are the same bit for bit, the share of the
pipeline's speed that conversion reaches, and the largest memory after a tenth and after all of a long recording.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

import msg_adapters as adapters
from refu_core import SmplFrame
from refu_lab.fleet import FleetOptions, find_recordings, open_engine, replay_fleet
from refu_lab.replay import ReplayOptions, replay

ROOT = Path(__file__).parents[1]


def _frames() -> list[SmplFrame]:
    with adapters.open_smpl_bag(ROOT / "bags" / "walk") as bag:
        return [record.frame for record in bag if record.frame is not None]


def _write(path: Path, frames: list[SmplFrame], count: int, first: int) -> None:
    encode = adapters.encoder_for("multiarray")
    with adapters.BagWriter(path) as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        for i, frame in enumerate(itertools.islice(itertools.cycle(frames), first, first + count)):
            writer.write("/smpl_params", encode(frame), log_time_ns=10**18 + i * 33_333_333)


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(folder.rglob("*.mcap")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _workers(folder: Path, jobs: int) -> tuple[float, str]:
    """Seconds of a run by so many workers that are up already, and a digest of the bags."""
    recordings, out = find_recordings([str(folder / "bags")]), folder / f"out-{jobs}"
    options = FleetOptions(replay=ReplayOptions(input=Path()), output=str(out))
    with open_engine(jobs) as engine:
        warm = FleetOptions(replay=options.replay, output=str(folder / f"warm-{jobs}"))
        replay_fleet(recordings[: 2 * jobs], warm, engine=engine)
        start = time.perf_counter()
        replay_fleet(recordings, options, engine=engine)
        return time.perf_counter() - start, _digest(out)


def _megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _convert(folder: Path, frames: list[SmplFrame], count: int) -> None:
    options = ReplayOptions(input=folder / "long.mcap", evaluate=False)
    pipeline = options.load_pipeline()
    few = frames[: min(len(frames), count)]
    for frame in few[:10]:
        pipeline(frame)
    start = time.perf_counter()
    for frame in few:
        pipeline(frame)
    alone = len(few) / (time.perf_counter() - start)
    _write(folder / "long.mcap", frames, count // 10, 0)
    replay(ReplayOptions(input=folder / "long.mcap", output=folder / "a.mcap", evaluate=False), pipeline=pipeline)
    before = _megabytes()
    (folder / "long.mcap").unlink()
    _write(folder / "long.mcap", frames, count, 0)
    start = time.perf_counter()
    replay(ReplayOptions(input=folder / "long.mcap", output=folder / "b.mcap", evaluate=False), pipeline=pipeline)
    speed = count / (time.perf_counter() - start)
    print(f"pipeline alone      {alone:8.1f} frames/s")
    print(f"conversion          {speed:8.1f} frames/s, {100 * speed / alone:.0f} %")
    print(f"largest memory      {before:8.0f} MB after {count // 10} frames, {_megabytes():.0f} MB after {count}")


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bags", type=int, default=20)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--long", type=int, default=3000)
    parser.add_argument("--only", choices=("workers", "convert"))
    args = parser.parse_args()
    frames = _frames()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if args.only != "workers":
            _convert(folder, frames, args.long)
        if args.only != "convert":
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
