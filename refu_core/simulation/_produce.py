"""Makes a set of any kind: in a directory of its own, with an engine that shares the work, resuming, and progress."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from refu_core._engine import Engine, InProcess, Lost
from refu_core._versions import versions
from refu_core.errors import SimulationError
from refu_core.simulation._plan import SamplePlan
from refu_core.simulation._poses import Clip, as_clips, split_clips
from refu_core.simulation._postures import POSTURES
from refu_core.simulation._selection import CAUSES
from refu_core.simulation._store import QUANTUM, TO_DO, Rows, has_rows, locked, read_card, write_card
from refu_core.simulation._summary import summarise
from refu_core.simulation._worker import SimulationSettings, Simulator, SlotSimulator


@dataclass(frozen=True)
class Progress:
    """How far the work on a set has got."""

    done: int
    """Slots (samples, or whole sequences) that are finished."""
    total: int
    """Slots of the set."""
    dropped: dict[str, int]
    """What failed in the finished slots, by cause: attempts at a sample, frames of a sequence."""


def _block_maker(make: Callable[[], Simulator]) -> Callable[[list[int]], list[dict[str, Any]]]:
    """Makes a process's function from slots to their rows; `make` is small enough to be sent to that process."""
    return make().block


def produce(
    make: Callable[[], Simulator],
    output: Path,
    *,
    engine: Engine | None,
    progress: Callable[[Progress], None] | None,
    **card: Any,
) -> None:
    """Simulates what is left of the set in `output`; `card` is added to the set's card. Raises as `simulate_dataset`.

    `make` makes a process's simulator; it is sent to each process, so it is small. Only this process writes rows,
    whichever process has simulated them: other machines needn't see the folder.
    """
    # Also made here, though workers make their own: an unsuitable body or garment is refused before any writing.
    simulator = make()
    blocks = [list(block) for block in simulator.plan.blocks()]
    slots = np.array([slot for block in blocks for slot in block], np.int32)
    _open_set(output, _card_of(simulator) | card)
    if not has_rows(output):
        Rows.create(output, simulator.kind, slots, simulator.shape)
    with locked(output):
        rows = Rows(output, simulator.kind, mode="r+")
        if not np.array_equal(rows.arrays["slot"], slots):
            msg = f"{output}: holds other slots than this plan's; give another output directory"
            raise SimulationError(msg)
        state, row_of = rows.arrays["state"], {int(slot): row for row, slot in enumerate(slots)}
        left = [[slot for slot in block if state[row_of[slot]] == TO_DO] for block in blocks]
        make_block: Callable[[], Callable[[list[int]], list[dict[str, Any]]]] = partial(_block_maker, make)
        if engine is None or isinstance(engine, InProcess):  # one slot at a time is on disk soonest
            engine, make_block = InProcess(), lambda: simulator.block
            left = [[slot] for block in left for slot in block]
        left = [block for block in left if block]
        # A whole block goes to one process, because its slots share a canonical drape.
        done, total, lost = 0, sum(map(len, left)), 0
        for index, made in engine.run(make_block, left):
            if isinstance(made, Lost):
                lost += len(left[index])
                continue
            for slot, values in zip(left[index], made, strict=True):
                rows.write(row_of[slot], values)
            done += len(made)
            if progress is not None:
                dropped = rows.arrays["dropped"][state != TO_DO].sum(0, dtype=np.int64).tolist()
                progress(Progress(len(slots) - total + done, len(slots), dict(zip(CAUSES, dropped, strict=True))))
        if lost:
            msg = f"{lost} of {total} slots were lost with their processes (out of memory?): "
            msg += "finished samples are kept, run the same command to go on"
            raise SimulationError(msg)


def _card_of(simulator: Simulator) -> dict[str, Any]:
    """The card of a simulator's set before there is anything in it."""
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
        "parts": {name: part.stop - part.start for name, part in simulator.parts.items()},
        "body": body.name,
        "body_fingerprint": body.fingerprint,
        "garment_fingerprint": digest.hexdigest()[:16],
        "motions_fingerprint": motions.hexdigest()[:16],
        "quantum_m": QUANTUM,
        "plan": asdict(simulator.plan) | {"garment": garment.name},  # whatever its file was called
        "settings": asdict(simulator.settings),
        "clips": {"train": [clip.name for clip in clips[0]], "test": [clip.name for clip in clips[1]]},
        "versions": {
            "python": platform.python_version(),
            **versions("numpy", "torch", "warp-lang", "numba"),
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
    there, wanted = read_card(output, card["format"]), json.loads(json.dumps(card))
    differing = [key for key in _MUST_AGREE if there.get(key) != wanted[key]]
    if differing:
        msg = f"{output}: holds another set ({', '.join(differing)} differ); give another output directory"
        raise SimulationError(msg)


def simulate_dataset(
    garment: str | Sequence[str],
    count: int,
    output: str | Path,
    *,
    motions: str | Path | Sequence[Clip] | None = None,
    body: str | Path | None = None,
    seed: int = 0,
    engine: Engine | None = None,
    test_share: float = 1 / 6,
    recorded_share: float = SamplePlan.recorded_share,
    posture_share: float = SamplePlan.posture_share,
    postures: Sequence[str] = tuple(POSTURES),
    pivots: int = SamplePlan.pivots,
    settings: SimulationSettings | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> dict[str, Any]:
    """Simulates a data set of `count` samples of a built-in garment, or goes on with one that was interrupted.

    The same arguments give the same samples, whatever `engine` is and however often the work was interrupted. Finished
    samples are on disk at any time and can be read while others are made.

    Args:
        garment: `tshirt-male` or another garment, or several that are worn together: their layers never cross.
        count: samples in the set, training and test together.
        output: directory of the set; it is made, or must hold the beginning of the same set.
        motions: a folder of motion files, or what `load_clips` has read, two at least; None for drawn poses alone.
        body: name or file of a body; None for the one the garment was cut for.
        seed: seed of everything that is drawn.
        engine: what shares the work among processes (`refu_lab.fleet.open_engine`); None to use this one alone.
        test_share: share of the samples that is kept for the test.
        recorded_share: share of the poses that are frames of the motions.
        posture_share: share of the poses that are varied everyday postures; the others are drawn.
        postures: which of `POSTURES` these are.
        pivots: style-shape pairs that half of the training samples share.
        settings: settings of simulation and selection.
        progress: called in this process after each slot.

    Returns:
        The card of the set, as it stands in `card.json`.

    Raises:
        SimulationError: motions of another layout, a full disk, a directory that holds another set, one that
            another run is writing, or processes that were killed again and again (what is finished is kept; run again
            to go on).
        MeshError: the body isn't watertight.
        BodyError, GarmentError: no such body or garment.
    """
    clips: tuple[list[Clip], list[Clip]] = ([], []) if motions is None else split_clips(as_clips(motions))
    recorded_share = 0.0 if motions is None else recorded_share
    plan = SamplePlan(
        garment,
        count,
        seed,
        test_share=test_share,
        pivots=pivots,
        recorded_share=recorded_share,
        posture_share=posture_share,
        postures=postures,
    )
    make = partial(SlotSimulator, plan, clips, settings or SimulationSettings(), body)
    produce(make, Path(output), engine=engine, progress=progress)
    return summarise(output)
