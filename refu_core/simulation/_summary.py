"""What a set contains: counts and yield for its card, and how far test samples are from the training set."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import N_JOINTS
from refu_core.simulation._motion import FPS
from refu_core.simulation._plan import TEST, TRAIN
from refu_core.simulation._selection import CAUSES
from refu_core.simulation._store import DONE, FORMAT, GIVEN_UP, SEQUENCES, Rows, read_card, write_card, write_unseen


def summarise(output: str | Path) -> dict[str, Any]:
    """Brings a set's card up to date: counts, yield by cause, stretch, pace; for samples, `unseen.npy`, too.

    A test sample's distance to the training set is the smallest Euclidean one in (θ, β, γ), as in the paper's
    supplement; it is in `unseen.npy`, by slot.

    Raises `SimulationError` when `output` holds no set.
    """
    output = Path(output)
    card = read_card(output, FORMAT, SEQUENCES)
    stored = Rows(output, card["format"])
    rows = stored.finished(DONE, GIVEN_UP)
    column = {name: values[rows] for name, values in stored.arrays.items() if name != "vertices"}
    done = column["state"] == DONE
    dropped = column["dropped"].sum(0, dtype=np.int64)
    counts = {
        "train": int((done & (column["split"] == TRAIN)).sum()),
        "test": int((done & (column["split"] == TEST)).sum()),
        "given_up": int((~done).sum()),
        "to_do": int(card["plan"]["count"] - len(done)),
    }
    figures: dict[str, float] = {}
    seconds = float(column["seconds"].sum())
    if card["format"] == SEQUENCES:
        good = column["cause"] == 0
        kept = good & done[:, None]
        simulated = int(done.sum()) * round(card["plan"]["seconds"] * FPS)
        counts |= {"frames": simulated, "frames_kept": int(kept.sum())}
        if done.any():
            shares = good[done].mean(1)
            figures["seconds_a_frame"] = seconds / simulated
            figures["kept_share_of_worst_sequence"] = float(shares.min())
            figures["kept_share_of_median_sequence"] = float(np.median(shares))
    else:
        kept = done
        simulated = int(kept.sum() + dropped.sum())
        write_unseen(output, _unseen(column, card["plan"]["count"]))
        if done.any():
            figures["seconds_a_sample"] = seconds / int(done.sum())
    if kept.any():
        figures["stretch_p999_median"] = float(np.median(column["stretch"][kept]))
        figures["stretch_p999_largest"] = float(column["stretch"][kept].max())
        figures["speed_m_s_median"] = float(np.median(column["speed"][kept]))
    card["counts"] = counts
    card["yield"] = {
        "simulated": simulated,
        "kept_share": float(kept.sum() / max(simulated, 1)),
        "dropped": dict(zip(CAUSES, dropped.tolist(), strict=True)),
    }
    if figures:
        card["figures"] = figures
    write_card(output, card)
    return card


def _unseen(column: dict[str, NDArray[Any]], count: int) -> NDArray[np.float32]:
    """By slot, how far each test sample is from the nearest training sample (count,); NaN for the others."""
    unseen = np.full(count, np.nan, np.float32)
    kept = column["state"] == DONE
    train, test = (kept & (column["split"] == split) for split in (TRAIN, TEST))
    parameters = np.concatenate([column["pose"].reshape(len(kept), 3 * N_JOINTS), column["betas"], column["style"]], 1)
    if train.any():
        for row in np.flatnonzero(test):
            unseen[column["slot"][row]] = np.sqrt(((parameters[train] - parameters[row]) ** 2).sum(1).min())
    return unseen
