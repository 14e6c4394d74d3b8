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
from numpy.typing import NDArray

from refu_core._engine import Engine, InProcess, Lost
from refu_core._files import replacing
from refu_core._versions import versions
from refu_core.errors import SimulationError
from refu_core.frames import N_JOINTS
from refu_core.simulation import _store as store
from refu_core.simulation._plan import TEST, TRAIN, SamplePlan
from refu_core.simulation._poses import POSTURES, Clip, split_clips
from refu_core.simulation._worker import SimulationSettings, Simulator, SlotSimulator


def summarise(output: str | Path) -> dict[str, Any]:
    """Brings a set's card up to date: counts, yield by cause, stretch, pace; for samples, `unseen.npy`, too.

    A test sample's distance to the training set is the smallest Euclidean one in (θ, β, γ), as in the paper's
    supplement; it is in `unseen.npy`, by slot.

    Raises `SimulationError` when `output` holds no set.
    """
    output = Path(output)
    card = store.read_card(output, store.FORMAT, store.SEQUENCES)
    stored = store.Rows(output, card["format"])
    rows = stored.finished(store.DONE, store.GIVEN_UP)
    column = {name: values[rows] for name, values in stored.arrays.items() if name != "vertices"}
    done = column["state"] == store.DONE
    dropped = column["dropped"].sum(0, dtype=np.int64)
    train, test = (int((done & (column["split"] == split)).sum()) for split in (TRAIN, TEST))
    counts = {"train": train, "test": test, "given_up": int((~done).sum()), "to_do": card["plan"]["count"] - len(done)}
    figures: dict[str, float] = {}
    seconds = float(column["seconds"].sum())
    if card["format"] == store.SEQUENCES:
        good = column["cause"] == 0
        kept = good & done[:, None]
        simulated = int(done.sum()) * round(card["plan"]["seconds"] * store.FPS)
        counts |= {"frames": simulated, "frames_kept": int(kept.sum())}
        if done.any():
            shares = good[done].mean(1)
            figures["seconds_a_frame"] = seconds / simulated
            figures["kept_share_of_worst_sequence"] = float(shares.min())
            figures["kept_share_of_median_sequence"] = float(np.median(shares))
    else:
        kept = done
        simulated = int(kept.sum() + dropped.sum())
        with replacing(output / "unseen.npy") as file:
            np.save(file, _unseen(column, card["plan"]["count"]))
        if done.any():
            figures["seconds_a_sample"] = seconds / int(done.sum())
    if kept.any():
        figures["stretch_p999_median"] = float(np.median(column["stretch"][kept]))
        figures["stretch_p999_largest"] = float(column["stretch"][kept].max())
        figures["speed_m_s_median"] = float(np.median(column["speed"][kept]))
    share, causes = float(kept.sum() / max(simulated, 1)), dict(zip(store.CAUSES, dropped.tolist(), strict=True))
    card |= {"counts": counts, "yield": {"simulated": simulated, "kept_share": share, "dropped": causes}}
    card |= {"figures": figures} if figures else {}
    store.write_card(output, card)
    return card


def _unseen(column: dict[str, NDArray[Any]], count: int) -> NDArray[np.float32]:
    """By slot, how far each test sample is from the nearest training sample (count,); NaN for the others."""
    unseen = np.full(count, np.nan, np.float32)
    kept = column["state"] == store.DONE
    train, test = (kept & (column["split"] == split) for split in (TRAIN, TEST))
    parameters = np.concatenate([column["pose"].reshape(len(kept), 3 * N_JOINTS), column["betas"], column["style"]], 1)
    if train.any():
        for row in np.flatnonzero(test):
            unseen[column["slot"][row]] = np.sqrt(((parameters[train] - parameters[row]) ** 2).sum(1).min())
    return unseen


@dataclass(frozen=True)
class Progress:
    """How far the work on a set has got."""

    done: int
    """Slots (samples, or whole sequences) that are finished."""
    total: int
    """Slots of the set."""
    dropped: dict[str, int]
    """What failed in the finished slots, by cause: attempts at a sample, frames of a sequence."""


def produce(
    kind: type[Simulator],
    *given: Any,
    output: str | Path,
    engine: Engine | None,
    progress: Callable[[Progress], None] | None,
    **card: Any,
) -> dict[str, Any]:
    """Simulates what is left of the set in `output`; returns its card, with `card` in it. Raises as `simulate_dataset`.

    Each process makes a simulator of this kind from what is `given`. Only this process writes rows, whichever process
    has simulated them: other machines needn't see the folder.
    """
    # Also made here, though workers make their own: an unsuitable body or garment is refused before any writing.
    simulator, output = kind(*given), Path(output)
    blocks = [list(block) for block in simulator.plan.blocks()]
    slots = np.array([slot for block in blocks for slot in block], np.int32)
    _open_set(output, _card_of(simulator) | card)
    if not store.has_rows(output):
        store.Rows.create(output, simulator.kind, slots, simulator.shape)
    with store.locked(output):
        rows = store.Rows(output, simulator.kind, mode="r+")
        if not np.array_equal(rows.arrays["slot"], slots):
            raise SimulationError(f"{output}: holds other slots than this plan's; give another output directory")
        state, row_of = rows.arrays["state"], {int(slot): row for row, slot in enumerate(slots)}
        left = [[slot for slot in block if state[row_of[slot]] == store.TO_DO] for block in blocks]
        make: Callable[[], Simulator] = partial(kind, *given)
        if engine is None or isinstance(engine, InProcess):  # one slot at a time is on disk soonest
            engine, make = InProcess(), lambda: simulator
            left = [[slot] for block in left for slot in block]
        left = [block for block in left if block]
        # A whole block goes to one process, because its slots share a canonical drape.
        done, total, lost = 0, sum(map(len, left)), 0
        for index, made in engine.run(make, left):
            if isinstance(made, Lost):
                lost += len(left[index])
                continue
            for slot, values in zip(left[index], made, strict=True):
                rows.write(row_of[slot], values)
            done += len(made)
            if progress is not None:
                dropped = rows.arrays["dropped"][state != store.TO_DO].sum(0, dtype=np.int64).tolist()
                progress(Progress(len(slots) - total + done, len(slots), dict(zip(store.CAUSES, dropped, strict=True))))
        if lost:
            msg = f"{lost} of {total} slots were lost with their processes (out of memory?): "
            msg += "finished samples are kept, run the same command to go on"
            raise SimulationError(msg)
    return summarise(output)


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
        "quantum_m": store.QUANTUM,
        "plan": asdict(simulator.plan) | {"garment": garment.name},  # whatever its file was called
        "settings": asdict(simulator.settings),
        "clips": {"train": [clip.name for clip in clips[0]], "test": [clip.name for clip in clips[1]]},
        "versions": {"python": platform.python_version(), **versions("numpy", "torch", "warp-lang", "numba")},
    }


_MUST_AGREE = (
    "format", "garment", "body_fingerprint", "garment_fingerprint", "motions_fingerprint", "plan", "settings", "clips",
)  # fmt: skip


def _open_set(output: Path, card: dict[str, Any]) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
        if not (output / "card.json").exists():
            if any(output.iterdir()):
                raise SimulationError(f"{output}: is neither empty nor a simulated data set; give another directory")
            store.write_card(output, card)
            return
    except OSError as error:
        raise SimulationError(f"{output}: can't be written: {error}") from error
    there, wanted = store.read_card(output, card["format"]), json.loads(json.dumps(card))
    differing = [key for key in _MUST_AGREE if there.get(key) != wanted[key]]
    if differing:
        raise SimulationError(f"{output}: holds another set ({', '.join(differing)} differ); give another directory")


def simulate_dataset(
    garment: str | Sequence[str],
    count: int,
    output: str | Path,
    *,
    motions: str | Path | Sequence[Clip] | None = None,
    body: str | Path | None = None,
    engine: Engine | None = None,
    settings: SimulationSettings | None = None,
    progress: Callable[[Progress], None] | None = None,
    **plan: Any,
) -> dict[str, Any]:
    """Simulates a data set of `count` samples of a built-in garment, or goes on with one that was interrupted.

    The same arguments give the same samples, whatever `engine` is and however often the work was interrupted. Finished
    samples are on disk at any time and can be read while others are made. Returns the card of the set.

    Args:
        garment, count: as in `SamplePlan`; the layers of garments that are worn together never cross.
        output: directory of the set; it is made, or must hold the beginning of the same set.
        motions: a folder of motion files, or what `load_clips` has read, two at least; None for drawn poses alone.
        body: name or file of a body; None for the one the garment was cut for.
        engine: what shares the work among processes (`refu_lab.fleet.open_engine`); None to use this one alone.
        settings: settings of simulation and selection.
        progress: called in this process after each slot.
        plan: other fields of `SamplePlan`, such as `seed` and `posture_share`; without `postures`, all are drawn.

    Raises `SimulationError` for motions of another layout, a full disk, a directory that holds another set or that
    another run is writing, and processes that were killed again and again (what is finished is kept); `MeshError` for a
    body that isn't watertight; `BodyError` or `GarmentError` for no such body or garment.
    """
    clips: tuple[list[Clip], list[Clip]] = ([], []) if motions is None else split_clips(motions)
    if motions is None:
        plan["recorded_share"] = 0.0
    slots = SamplePlan(garment, count, **({"postures": tuple(POSTURES)} | plan))
    given = slots, clips, settings or SimulationSettings(), body
    return produce(SlotSimulator, *given, output=output, engine=engine, progress=progress)
