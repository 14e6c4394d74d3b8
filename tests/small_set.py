"""A data set in the documented format (docs/guide/data.md), written without the project's writer."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate

QUANTUM = 2.0**-14


def write_set(
    folder: Path,
    garment: GarmentTemplate,
    body: SmplBody,
    *,
    pairs: int = 12,
    poses: int = 6,
    test_pairs: int = 3,
    spread: float = 0.2,
    turn: float | None = None,
    displacement: Callable[[Tensor], Tensor] | None = None,
    plan: Mapping[str, Any] | None = None,
) -> Path:
    """Writes garments that follow the skin, displaced by a function of the poses (N, 24, 3) to (N, V, 3) [m].

    `pairs` style-shape pairs with `poses` poses each, whose angles spread by `spread` [rad], those of the root by
    `turn`, if given; the last `test_pairs` are for the test. `plan` is written into the card as what was drawn from.
    """
    rng = np.random.default_rng(0)
    n = pairs * poses
    pair = np.repeat(np.arange(pairs), poses).astype("<i4")
    betas = rng.normal(size=(pairs, 10)).astype("<f4")[pair]
    style = rng.normal(size=(pairs, 4)).astype("<f4")[pair]
    pose = rng.normal(0, spread, (n, 24, 3)).astype("<f4")
    if turn is not None:
        pose[:, 0] *= turn / spread
    with torch.no_grad():
        b, p = torch.as_tensor(betas), torch.as_tensor(pose)
        unposed = garment.rest(b, garment.own(torch.as_tensor(style)))
        if displacement is not None:
            unposed = unposed + displacement(p)
        posed = garment.pose(unposed, body(p, b).transforms).numpy()
    columns = {
        "vertices": np.rint(posed / QUANTUM).astype("<i2"),
        "pose": pose,
        "betas": betas,
        "style": style,
        "pair": pair,
        "slot": np.arange(n, dtype="<i4"),
        "clip": np.full(n, -1, "<i4"),
        "frame": np.full(n, -1, "<i4"),
        "split": (pair >= pairs - test_pairs).astype("|u1"),
        "state": np.ones(n, "|u1"),
        "dropped": np.zeros((n, 4), "|u1"),
        **{name: np.ones(n, "<f4") for name in ("stretch", "speed", "seconds")},
    }
    card = {
        "format": "refu-garments-2",
        "garment": garment.name,
        "body": garment.body,
        "body_fingerprint": body.fingerprint,
        "quantum_m": QUANTUM,
        "plan": {"count": n, "pivots": 4} if plan is None else plan,
        "clips": {"train": [], "test": []},
    }
    return write_shard(folder, columns, card)


def write_shard(folder: Path, columns: Mapping[str, NDArray[Any]], card: Mapping[str, Any]) -> Path:
    """A set of one shard, as these columns and this card."""
    shard = folder / "shard-0-of-1"
    shard.mkdir(parents=True)
    for name, array in columns.items():
        np.save(shard / f"{name}.npy", array)
    (folder / "card.json").write_text(json.dumps(card))
    return folder
