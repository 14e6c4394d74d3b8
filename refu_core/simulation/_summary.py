"""What there is in a set: counts and yield for its card, and what is known of each slot once it is done."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import N_JOINTS
from refu_core.simulation._motion import FPS
from refu_core.simulation._plan import TEST, TRAIN
from refu_core.simulation._selection import CAUSES
from refu_core.simulation._store import (
    DONE,
    GIVEN_UP,
    SEQUENCES,
    SequenceShard,
    Shard,
    gather,
    read_card,
    rows_of,
    shards_of,
    write_by_slot,
    write_card,
)


def _finished(output: Path, kind: type[Shard] = Shard) -> dict[str, NDArray[Any]]:
    """The columns of all slots that are done or given up, by slot; without the garments."""
    shards = shards_of(output, kind)
    where, row = rows_of(shards, (DONE, GIVEN_UP))
    return {name: gather(shards, where, row, name) for name in shards[0].arrays if name != "vertices"}


def _count(card: dict[str, Any], column: dict[str, NDArray[Any]], **more: int) -> None:
    """Writes a card's counts of slots, and `more`."""
    done = column["state"] == DONE
    card["counts"] = {
        "train": int((done & (column["split"] == TRAIN)).sum()),
        "test": int((done & (column["split"] == TEST)).sum()),
        "given_up": int((column["state"] == GIVEN_UP).sum()),
        "to_do": int(card["plan"]["count"] - len(done)),
        **more,
    }


def _note_yield(card: dict[str, Any], simulated: int, kept: Any, dropped: NDArray[np.int64]) -> None:
    """Writes a card's share of what was kept, and why the rest wasn't."""
    card["yield"] = {
        "simulated": simulated,
        "kept_share": float(kept / max(simulated, 1)),
        "dropped": dict(zip(CAUSES, dropped.tolist(), strict=True)),
    }


def _cloth_figures(column: dict[str, NDArray[Any]], kept: NDArray[np.bool_]) -> dict[str, float]:
    """Stretch and speed of what was kept."""
    return {
        "stretch_p999_median": float(np.median(column["stretch"][kept])),
        "stretch_p999_largest": float(column["stretch"][kept].max()),
        "speed_m_s_median": float(np.median(column["speed"][kept])),
    }


def summarise(output: str | Path) -> dict[str, Any]:
    """Brings the card of a set of samples up to date (counts, yield by cause, stretch, pace), and `unseen.npy`.

    A test sample's distance to the training set is the smallest Euclidean one in (θ, β, γ), as in the paper's
    supplement; it is in `unseen.npy`, by slot.

    A slot that two divisions into shards both hold counts once.

    Raises `SimulationError` when `output` holds no set.
    """
    output = Path(output)
    card = read_card(output)
    column = _finished(output)
    kept = column["state"] == DONE
    train, test = (kept & (column["split"] == k) for k in (TRAIN, TEST))
    unseen = np.full(card["plan"]["count"], np.nan, np.float32)
    parameters = np.concatenate([column["pose"].reshape(len(kept), 3 * N_JOINTS), column["betas"], column["style"]], 1)
    if train.any():
        for row in np.flatnonzero(test):
            unseen[column["slot"][row]] = np.sqrt(((parameters[train] - parameters[row]) ** 2).sum(1).min())
    write_by_slot(output, "unseen", unseen)
    dropped = column["dropped"].sum(0, dtype=np.int64)
    _count(card, column)
    _note_yield(card, int(kept.sum() + dropped.sum()), kept.sum(), dropped)
    if kept.any():
        pace = float(column["seconds"].sum() / kept.sum())
        card["figures"] = {"seconds_a_sample": pace, **_cloth_figures(column, kept)}
    write_card(output, card)
    return card


def summarise_sequences(output: str | Path) -> dict[str, Any]:
    """Brings the card of a set of sequences up to date: counts, the frames that are in the set and why others aren't.

    Raises `SimulationError` when `output` holds no set of sequences.
    """
    output = Path(output)
    card = read_card(output, SEQUENCES)
    column = _finished(output, SequenceShard)
    done = column["state"] == DONE
    good = column["cause"] == 0
    frames = int(done.sum()) * round(card["plan"]["seconds"] * FPS)
    n_kept = int(good[done].sum())
    _count(card, column, frames=frames, frames_kept=n_kept)
    _note_yield(card, frames, n_kept, column["dropped"][done].sum(0, dtype=np.int64))
    if done.any():
        kept = good & done[:, None]
        shares = good[done].mean(1)
        card["figures"] = {
            "seconds_a_frame": float(column["seconds"].sum() / frames),
            "kept_share_of_worst_sequence": float(shares.min()),
            "kept_share_of_median_sequence": float(np.median(shares)),
            **(_cloth_figures(column, kept) if kept.any() else {}),
        }
    write_card(output, card)
    return card
