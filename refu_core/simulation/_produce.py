"""Making a set, whatever is in it: a directory that is its own, shards, processes, resuming, progress."""

from __future__ import annotations

import hashlib
import platform
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from refu_core.simulation._errors import SimulationError
from refu_core.simulation._selection import CAUSES
from refu_core.simulation._store import QUANTUM, TO_DO, Shard, locked, read_card, write_card

if TYPE_CHECKING:
    from refu_core.simulation._worker import Simulator


@dataclass(frozen=True)
class Progress:
    """How far a shard is."""

    done: int
    """Slots (samples, or whole sequences) of this shard that are finished."""
    total: int
    """Slots of this shard."""
    seconds_left: float
    """By the pace of this run; infinite before its first slot."""
    dropped: dict[str, int]
    """What failed in the finished slots, by cause: attempts at a sample, frames of a sequence."""


def produce(
    make: Callable[[], Simulator],
    output: Path,
    *,
    processes: int,
    shard: tuple[int, int],
    progress: Callable[[Progress], None] | None,
    **card: Any,
) -> Simulator:
    """Simulates what is left of one shard of the set in `output`; returns this process's simulator.

    Args:
        make: makes a process's simulator; it is sent to each process, so it is small.
        output: directory of the set.
        processes: how many.
        shard: which of how many.
        progress: called after each slot.
        card: what the set's card says besides.

    Raises:
        SimulationError: see `simulate_dataset`.
    """
    index, n_shards = shard
    if not 0 <= index < n_shards or processes < 1:
        msg = f"wanted a shard (i, n) with 0 <= i < n and at least one process, got {shard} and {processes}"
        raise SimulationError(msg)
    # Made here although workers make their own: a body or garment that won't do is refused before anything is written.
    simulator = make()
    mine = simulator.plan.blocks()[index::n_shards]
    slots = np.array([slot for block in mine for slot in block], np.int32)
    _open_set(output, _card_of(simulator) | card)
    directory = output / f"shard-{index}-of-{n_shards}"
    if not directory.exists():
        simulator.rows.create(directory, slots, simulator.shape)
    with locked(directory):
        rows = simulator.rows(directory, mode="r+")
        if not np.array_equal(rows.arrays["slot"], slots):
            msg = f"{directory}: holds other slots than this plan's; give another output directory"
            raise SimulationError(msg)
        state = rows.arrays["state"]
        ends = np.cumsum([len(block) for block in mine])
        left = [
            [row for row in range(end - len(b), end) if state[row] == TO_DO] for b, end in zip(mine, ends, strict=True)
        ]
        left = [block for block in left if block]
        started, done, total = time.monotonic(), 0, sum(map(len, left))
        for n in _simulate(simulator, rows, make, left, processes):
            done += n
            if progress is not None:
                pace = (time.monotonic() - started) / done
                dropped = rows.arrays["dropped"][state != TO_DO].sum(0, dtype=np.int64).tolist()
                causes = dict(zip(CAUSES, dropped, strict=True))
                progress(Progress(len(slots) - total + done, len(slots), pace * (total - done), causes))
    return simulator


def _simulate(
    simulator: Simulator, shard: Shard, make: Callable[[], Simulator], blocks: list[list[int]], processes: int
) -> Iterator[int]:
    """Simulates blocks of rows and writes them; yields how many are new, again and again."""
    if processes == 1:
        for row in (row for block in blocks for row in block):
            shard.write(row, simulator.simulate(int(shard.arrays["slot"][row])))
            yield 1
        return
    pool = ProcessPoolExecutor(
        processes, mp_context=get_context("spawn"), initializer=_start_process, initargs=(make, shard.directory)
    )
    try:
        # A whole block goes to one process, for the sake of its common canonical drape.
        for future in as_completed([pool.submit(_simulate_block, block) for block in blocks]):
            yield future.result()
    except BrokenProcessPool as error:
        msg = (
            "a simulating process was killed (out of memory?): finished samples are kept, run the same command to go on"
        )
        raise SimulationError(msg) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_state: tuple[Simulator, Shard] | None = None


def _start_process(make: Callable[[], Simulator], directory: Path) -> None:
    """Prepares this process, once. One thread: the processes are the parallelism."""
    global _state
    torch.set_num_threads(1)
    simulator = make()
    _state = simulator, simulator.rows(directory, mode="r+")


def _simulate_block(rows: list[int]) -> int:
    """Simulates and writes some rows of this process's shard; their number."""
    assert _state is not None
    simulator, shard = _state
    for row in rows:
        shard.write(row, simulator.simulate(int(shard.arrays["slot"][row])))
    return len(rows)


def _card_of(simulator: Simulator) -> dict[str, Any]:
    """What a simulator's set is, before there is anything in it."""
    garment, body, clips = simulator.garment, simulator.body, simulator.clips
    digest = hashlib.sha256()
    for tensor in (garment.faces, garment.weights, garment.v_template, garment.shapedirs, garment.styledirs):
        if tensor is not None:
            digest.update(tensor.contiguous().numpy().tobytes())
    motions = hashlib.sha256()
    for clip in (*clips[0], *clips[1]):
        motions.update(clip.name.encode() + clip.poses.tobytes())
    return {
        "format": simulator.kind,
        "garment": garment.name,
        "body": body.name,
        "body_fingerprint": body.fingerprint,
        "garment_fingerprint": digest.hexdigest()[:16],
        "motions_fingerprint": motions.hexdigest()[:16],
        "quantum_m": QUANTUM,
        "plan": asdict(simulator.plan),
        "settings": asdict(simulator.settings),
        "clips": {"train": [clip.name for clip in clips[0]], "test": [clip.name for clip in clips[1]]},
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("refu-ros", "numpy", "torch", "warp-lang", "numba")},
        },
    }


_MUST_AGREE = (
    "format", "garment", "body_fingerprint", "garment_fingerprint", "motions_fingerprint", "plan", "settings", "clips",
)  # fmt: skip


def _open_set(output: Path, card: dict[str, Any]) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
        if not (output / "card.json").exists():
            if any(output.iterdir()):
                msg = f"{output}: is neither empty nor a simulated data set; give another output directory"
                raise SimulationError(msg)
            write_card(output, card)
            return
    except OSError as error:
        msg = f"{output}: can't be written: {error}"
        raise SimulationError(msg) from error
    there = read_card(output, card["format"])
    differing = [key for key in _MUST_AGREE if _plain(there.get(key)) != _plain(card[key])]
    if differing:
        msg = f"{output}: holds another set ({', '.join(differing)} differ); give another output directory"
        raise SimulationError(msg)


def _plain(value: Any) -> Any:
    """As JSON has it: tuples are lists."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value
