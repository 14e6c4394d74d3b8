"""Making a data set: processes, resuming, progress, the card."""

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_core.simulation._errors import SimulationError
from refu_core.simulation._plan import Plan
from refu_core.simulation._poses import load_clips, split_clips
from refu_core.simulation._selection import CAUSES
from refu_core.simulation._store import DONE, FORMAT, GIVEN_UP, QUANTUM, TO_DO, Shard, locked, read_card, write_card
from refu_core.simulation._worker import (
    Job,
    SimulationSettings,
    SlotSimulator,
    load_pair,
    simulate_block,
    start_process,
)


@dataclass(frozen=True)
class Progress:
    """How far a shard is."""

    done: int
    """Slots of this shard that are finished."""
    total: int
    """Slots of this shard."""
    seconds_left: float
    """By the pace of this run; infinite before its first slot."""
    dropped: dict[str, int]
    """Attempts that failed in the finished slots, by cause."""


def simulate_dataset(
    garment: str,
    count: int,
    output: str | Path,
    *,
    motions: str | Path,
    body: str | Path | None = None,
    seed: int = 0,
    processes: int = 1,
    shard: tuple[int, int] = (0, 1),
    test_share: float = 1 / 6,
    settings: SimulationSettings | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> dict[str, Any]:
    """Simulates a data set of `count` samples of a built-in garment, or goes on with one that was interrupted.

    The same arguments give the same samples, whatever `processes` and `shard` are and however often the work was
    interrupted. Finished samples are on disk at any time and can be read while others are made.

    Args:
        garment: `tshirt-male` or another built-in garment.
        count: samples in the set, training and test together, over all shards.
        output: directory of the set; it is made, or must hold the beginning of the same set.
        motions: a folder of AMASS-style `.npz` files, two at least.
        body: name or file of a body; None for the one the garment was cut for.
        seed: of everything that is drawn.
        processes: how many processes share the work, one thread each.
        shard: (i, n): this run makes the i-th of n parts of the set, counted from 0.
        test_share: share of the samples that is kept for the test.
        settings: of simulation and selection.
        progress: called in this process after each slot.

    Returns:
        The card of the set, as it stands in `card.json`.

    Raises:
        SimulationError: motions of another layout, a full disk, a directory that holds another set, a shard that
            another run is writing, or a process that was killed (what is finished is kept; run again to go on).
        MeshError: the body isn't watertight.
        BodyError, GarmentError: no such body or garment.
    """
    index, n_shards = shard
    if not 0 <= index < n_shards or processes < 1:
        msg = f"wanted a shard (i, n) with 0 <= i < n and at least one process, got {shard} and {processes}"
        raise SimulationError(msg)
    output = Path(output)
    plan = Plan(garment, count, seed=seed, test_share=test_share)
    settings = settings or SimulationSettings()
    clips = split_clips(load_clips(motions))
    template, worn_by = load_pair(garment, body)
    job = Job(plan, clips, settings, template.body if body is None else body)
    # Made here although workers make their own: a body or garment that won't do is refused before anything is written.
    simulator = SlotSimulator(plan, template, worn_by, clips, settings)

    blocks = plan.blocks()[index::n_shards]
    slots = np.array([slot for block in blocks for slot in block], np.int32)
    card = _make_card(plan, settings, job, template, worn_by)
    _open_set(output, card)
    directory = output / f"shard-{index}-of-{n_shards}"
    if not directory.exists():
        Shard.create(directory, slots, template.n_vertices)
    with locked(directory):
        rows = Shard(directory, mode="r+")
        if not np.array_equal(rows.arrays["slot"], slots):
            msg = f"{directory}: holds other slots than this plan's; give another output directory"
            raise SimulationError(msg)
        state = rows.arrays["state"]
        ends = np.cumsum([len(block) for block in blocks])
        left = [
            [row for row in range(end - len(b), end) if state[row] == TO_DO]
            for b, end in zip(blocks, ends, strict=True)
        ]
        left = [block for block in left if block]
        started, done, total = time.monotonic(), 0, sum(map(len, left))
        for n in _simulate(simulator, rows, job, left, processes):
            done += n
            if progress is not None:
                pace = (time.monotonic() - started) / done
                dropped = rows.arrays["dropped"][state != TO_DO].sum(0, dtype=np.int64).tolist()
                causes = dict(zip(CAUSES, dropped, strict=True))
                progress(Progress(len(slots) - total + done, len(slots), pace * (total - done), causes))
    return summarise(output)


def _simulate(
    simulator: SlotSimulator, shard: Shard, job: Job, blocks: list[list[int]], processes: int
) -> Iterator[int]:
    """Simulates blocks of rows and writes them; yields how many are new, again and again."""
    if processes == 1:
        for block in blocks:
            for row in block:
                shard.write(row, simulator.simulate(int(shard.arrays["slot"][row])))
                yield 1
        return
    pool = ProcessPoolExecutor(
        processes, mp_context=get_context("spawn"), initializer=start_process, initargs=(job, shard.directory)
    )
    try:
        # A whole block goes to one process, for the sake of its common canonical drape.
        for future in as_completed([pool.submit(simulate_block, block) for block in blocks]):
            yield future.result()
    except BrokenProcessPool as error:
        msg = (
            "a simulating process was killed (out of memory?): finished samples are kept, run the same command to go on"
        )
        raise SimulationError(msg) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _make_card(
    plan: Plan, settings: SimulationSettings, job: Job, garment: GarmentTemplate, body: SmplBody
) -> dict[str, Any]:
    digest = hashlib.sha256()
    for tensor in (garment.faces, garment.weights, garment.v_template, garment.shapedirs, garment.styledirs):
        if tensor is not None:
            digest.update(tensor.contiguous().numpy().tobytes())
    motions = hashlib.sha256()
    for clip in (*job.clips[0], *job.clips[1]):
        motions.update(clip.name.encode() + clip.poses.tobytes())
    return {
        "format": FORMAT,
        "garment": plan.garment,
        "body": body.name,
        "body_fingerprint": body.fingerprint,
        "garment_fingerprint": digest.hexdigest()[:16],
        "motions_fingerprint": motions.hexdigest()[:16],
        "quantum_m": QUANTUM,
        "plan": plan.as_dict(),
        "settings": asdict(settings),
        "clips": {"train": [clip.name for clip in job.clips[0]], "test": [clip.name for clip in job.clips[1]]},
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
    there = read_card(output)
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


def summarise(output: str | Path) -> dict[str, Any]:
    """Brings the card of a set up to date: counts, yield by cause, stretch, pace; and the test samples' distances.

    A test sample's distance to the training set is the smallest Euclidean one in (θ, β, γ), as in the paper's
    supplement; it is in `unseen.npy`, by slot.

    Raises `SimulationError` when `output` holds no set.
    """
    output = Path(output)
    card = read_card(output)
    shards = [Shard(path) for path in sorted(output.glob("shard-*-of-*")) if path.suffix != ".new"]
    column: dict[str, NDArray[Any]] = {
        name: np.concatenate([np.asarray(shard.arrays[name]) for shard in shards])
        for name in shards[0].arrays
        if name != "vertices"
    }
    kept = column["state"] == DONE
    finished = column["state"] != TO_DO
    train, test = (kept & (column["split"] == k) for k in (0, 1))
    unseen = np.full(card["plan"]["count"], np.nan, np.float32)
    parameters = np.concatenate([column["pose"].reshape(len(kept), -1), column["betas"], column["style"]], 1)
    if train.any():
        for row in np.flatnonzero(test):
            unseen[column["slot"][row]] = np.sqrt(((parameters[train] - parameters[row]) ** 2).sum(1).min())
    np.save(output / "unseen.npy", unseen)
    dropped = column["dropped"][finished].sum(0, dtype=np.int64)
    simulated = int(kept.sum() + dropped[1:].sum())
    card["counts"] = {
        "train": int(train.sum()),
        "test": int(test.sum()),
        "given_up": int((column["state"] == GIVEN_UP).sum()),
        "to_do": int(card["plan"]["count"] - finished.sum()),
        "held_back": int((column["share"][kept] < 1).sum()),
    }
    card["yield"] = {
        "simulated": simulated,
        "kept_share": float(kept.sum() / max(simulated, 1)),
        "dropped": dict(zip(CAUSES, dropped.tolist(), strict=True)),
    }
    if kept.any():
        card["figures"] = {
            "seconds_a_sample": float(column["seconds"][finished].sum() / kept.sum()),
            "stretch_p999_median": float(np.median(column["stretch"][kept])),
            "stretch_p999_largest": float(column["stretch"][kept].max()),
            "speed_m_s_median": float(np.median(column["speed"][kept])),
        }
    write_card(output, card)
    return card
