"""Kills recordings, simulations and trainings at random moments: is the disk's content readable, can the work go on?

    python scripts/kill_test.py --what recording|simulation|training --times 100 [--seed S]

Each kind of work is done once without interruption. Then it is begun in a process that is killed (SIGKILL) after a
random time, checked, and begun again in the same place until it is finished; then it starts over. A check means that
the project's own readers read what is there, and every finished part has the bytes of the uninterrupted work.

Exit status 1 where anything couldn't be read, differs, or was lost beyond what the documentation says.
"""

from __future__ import annotations

import argparse
import json
import mmap
import os
import random
import shutil
import struct
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
GARMENT = "short-pant-male"
CHUNK_BYTES = 1 << 20


class Recording:
    """The node's recorder under full load; a recording can't be continued, so the next one must find another place.

    Every kind of work has the same members as this one: `longest_s`, how long a process may live; `begin`, which does
    the work or continues it; `check`, which reads what a kill has left, says how far the work was and raises where
    anything is wrong; and `check_finished`, which raises where finished work differs from an uninterrupted run.
    """

    topic, message_type = "/garments", "visualization_msgs/msg/MarkerArray"
    longest_s = 0.6

    def __init__(self, folder: Path) -> None:
        self._progress = folder / "progress"
        self._progress.write_bytes(bytes(8))

    @staticmethod
    def payload(i: int) -> bytes:
        """Message number `i`: its size and content follow from its number, and it hardly compresses."""
        rng = random.Random(i)
        return struct.pack("<4sQ", b"\0\1\0\0", i) + rng.randbytes(rng.choice((100, 2_000, 60_000, 300_000)))

    def begin(self, folder: Path) -> None:
        from msg_adapters import QosProfile
        from msg_adapters.bags import Recorder

        with self._progress.open("r+b") as file, mmap.mmap(file.fileno(), 8) as progress:
            # Reset before there is a new bag: otherwise the last one's count would be taken for that of the empty file.
            struct.pack_into("<Q", progress, 0, 0)
            recorder = Recorder(folder / "bag")
            for i in range(1 << 30):
                while recorder.state().queued > 20:
                    time.sleep(0.001)
                recorder.put(self.topic, self.message_type, self.payload(i), time_ns=i, qos=QosProfile())
                struct.pack_into("<Q", progress, 0, recorder.state().written)

    def check(self, folder: Path) -> str:
        """All messages but those of the last chunk are there, once each and unharmed."""
        from msg_adapters import BagReader

        (written,) = struct.unpack("<Q", self._progress.read_bytes())
        newest = max(folder.glob("bag*/*.mcap"), key=lambda path: path.stat().st_mtime_ns, default=None)
        if newest is None or newest.stat().st_size == 0:
            require(written == 0, "messages were written, and there is no file")
            return "not begun"
        with BagReader(newest) as reader:
            messages = list(reader.messages())
        for i, message in enumerate(messages):
            require(message.data == self.payload(i), f"message {i} of {len(messages)} is another")
        lost = sum(len(self.payload(i)) for i in range(len(messages), written - 1))
        require(lost <= CHUNK_BYTES, f"{lost} bytes of written messages are lost, a chunk has {CHUNK_BYTES}")
        return "recording" if messages else "first chunk"

    def check_finished(self, folder: Path) -> None:
        """Nothing to check: recordings don't end by themselves."""


class Continued:
    """Work that goes on where it was killed: finished, its `files` have the bytes of uninterrupted work."""

    files: tuple[str, ...]

    def __init__(self, folder: Path) -> None:
        self.begin(folder / "reference")
        self._wanted = self._bytes(folder / "reference")
        started = time.monotonic()
        self.begin(folder / "again")  # all kernels are compiled by now
        self.check_finished(folder / "again")
        self.longest_s = 1.2 * (time.monotonic() - started)

    def begin(self, folder: Path) -> None:
        raise NotImplementedError

    def _bytes(self, folder: Path) -> dict[str, bytes]:
        found = [path for pattern in self.files for path in folder.glob(pattern) if path.name != "seconds.npy"]
        return {str(path.relative_to(folder)): path.read_bytes() for path in found}

    def check_finished(self, folder: Path) -> None:
        got = self._bytes(folder)
        for name, wanted in self._wanted.items():
            require(got.get(name) == wanted, f"{name} differs")


class Simulation(Continued):
    """`refu simulate`: a small set of shorts."""

    count, files = 3, ("*.npy", "shard-*-of-1/*.npy")

    def __init__(self, folder: Path) -> None:
        from refu_core.simulation import GarmentDataset

        super().__init__(folder)
        self._by_slot = GarmentDataset(folder / "reference")
        require(len(self._by_slot) == self.count, "not every slot has got a sample, so that rows can't be compared")

    def begin(self, folder: Path) -> None:
        from refu_core.simulation import simulate_dataset

        simulate_dataset(GARMENT, self.count, folder)

    def check(self, folder: Path) -> str:
        """Each sample that is marked as finished is the one that it should be."""
        from refu_core.simulation import GarmentDataset, SimulationError

        if not (folder / "card.json").exists():
            return "no card"
        try:
            dataset = GarmentDataset(folder)
        except SimulationError as error:
            require("no shard" in str(error), str(error))
            return "no shard"
        for i in range(len(dataset)):
            dataset.sample(i)
        slots = dataset.column("slot")
        for name in ("vertices", "pose", "betas", "style", "split"):
            wanted = self._by_slot.column(name)[slots]
            require(np.array_equal(dataset.column(name), wanted), f"{name} of a finished sample is another")
        return f"{len(dataset)} samples"


class Training(Continued):
    """`refu train`: a small network on a small set."""

    files = ("*.safetensors",)

    def __init__(self, folder: Path) -> None:
        from refu_core import load_body, load_garment
        from refu_core.backbones import TailorNetConfig
        from refu_core.training import LoopSettings, PretrainSettings, TrainingLog

        TrainingLog.draw = lambda _: None  # type: ignore[method-assign]  # curves for people, as long as all the rest
        sys.path.insert(0, str(ROOT / "tests"))
        from small_set import write_set

        garment = load_garment(GARMENT)
        self._set = write_set(folder / "set", garment, load_body(garment.body), pairs=8, poses=4, test_pairs=2)
        self._config = TailorNetConfig((0, 1, 2, 4, 5), low=(16,), high=(8,), style_shape=(8,), dropout=0.05)
        loop = LoopSettings(batch_size=8, learning_rate=1e-2, weight_decay=0.01, check_every=4)
        steps = {"style_shape_steps": 16, "low_steps": 16, "steps": 16}
        self._settings = PretrainSettings(loop, rank=4, validation_share=0.2, **steps)
        super().__init__(folder)

    def begin(self, folder: Path) -> None:
        from refu_core.training import pretrain

        torch.manual_seed(os.getpid())  # must not matter
        pretrain(GARMENT, self._set, folder, settings=self._settings, config=self._config, quiet=True)

    def check(self, folder: Path) -> str:
        """Checkpoint, weights and curves are there whole, or not at all."""
        from refu_core.training import load_checkpoint
        from refu_core.weights import load_weights

        for path in folder.glob("*.safetensors"):
            if path.with_suffix(".json").exists():
                load_weights(path.with_suffix(""))
        for path in folder.glob("*.jsonl"):
            for line in path.read_text().splitlines():
                json.loads(line)
        states = [state for path in folder.glob("*.checkpoint") if (state := load_checkpoint(path)) is not None]
        if not states:
            return "no checkpoint"
        done = ", ".join(states[0]["done"]) or "nothing"
        return f"done: {done}"


WORKS: dict[str, type[Any]] = {"recording": Recording, "simulation": Simulation, "training": Training}


def require(condition: object, what: str) -> None:
    """Raises `AssertionError` if the condition is false, even where Python ignores `assert`."""
    if not condition:
        raise AssertionError(what)


@dataclass
class Result:
    kills: int = 0
    finished: int = 0
    """Runs that were finished, interrupted or not, and compared with the uninterrupted one."""
    failures: list[str] = field(default_factory=list)
    moments: Counter[str] = field(default_factory=Counter)
    """How far the work was when it was killed."""


def kill_often(what: str, times: int, *, seed: int, folder: Path) -> Result:
    """Begins and kills the work until it has been killed `times` times."""
    work = WORKS[what](folder)
    rng, result = random.Random(seed), Result()
    place = folder / "work"
    while result.kills < times:
        status = _status_of(work, place, rng.uniform(0, work.longest_s))
        try:
            if status is None:
                result.kills += 1
                result.moments[work.check(place)] += 1
            else:
                require(status == 0, f"the work failed with status {status} after {result.kills} kills")
                work.check_finished(place)
                result.finished += 1
                shutil.rmtree(place)
        except Exception as error:
            result.failures.append(f"{type(error).__name__}: {error}")
            shutil.rmtree(place, ignore_errors=True)
    if _status_of(work, place, 1.0 if what == "recording" else 600.0) == 0:
        work.check_finished(place)
        result.finished += 1
    return result


def _status_of(work: Any, place: Path, seconds: float) -> int | None:
    """The exit status of a process that does the work, or None where it didn't end in time and was killed."""
    place.mkdir(exist_ok=True)
    child = get_context("fork").Process(target=work.begin, args=(place,), daemon=True)
    child.start()
    child.join(seconds)
    status = child.exitcode
    child.kill()
    child.join()
    return status


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", choices=[*WORKS, "all"], default="all", help="what is killed")
    parser.add_argument("--times", type=int, default=100, help="kills of each (100)")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (0)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    has_failed = False
    for what in WORKS if args.what == "all" else (args.what,):
        with tempfile.TemporaryDirectory() as folder:
            result = kill_often(what, args.times, seed=args.seed, folder=Path(folder))
        has_failed |= bool(result.failures)
        where = ", ".join(f"{moment} {count}" for moment, count in sorted(result.moments.items()))
        print(f"{what}: {result.kills} kills, {result.finished} finished, {len(result.failures)} failures ({where})")
        for failure in dict.fromkeys(result.failures):
            print(f"  {failure}")
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main())
