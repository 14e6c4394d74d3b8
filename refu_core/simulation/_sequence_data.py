"""Reading a set of simulated sequences, also while it is being made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.simulation._errors import SimulationError
from refu_core.simulation._motion import FPS
from refu_core.simulation._plan import TEST
from refu_core.simulation._selection import CAUSES
from refu_core.simulation._store import (
    DONE,
    SEQUENCES,
    SequenceShard,
    check_rows,
    clip_names,
    dequantise,
    gather,
    read_card,
    rows_of,
    shards_of,
)


@dataclass(frozen=True, eq=False)
class GarmentSequence:
    """One continuous motion and the garment that moves with it, T frames."""

    kept: NDArray[np.bool_]
    """Which frames passed the selection, shape (T,): **the others hold a garment that collides, or none.**"""
    cause: list[str | None]
    """Why a frame didn't pass (one of `CAUSES`), T entries; None for those that did."""
    pose: NDArray[np.float32]
    """θ that was simulated, rotation vectors [rad], shape (T, 24, 3)."""
    asked: NDArray[np.float32]
    """θ before limbs were held back to make room for the cloth [rad], shape (T, 24, 3)."""
    transl: NDArray[np.float32]
    """Translation of the body [m], shape (T, 3); not contained in the vertices."""
    betas: NDArray[np.float32]
    """β, shape (10,)."""
    style: NDArray[np.float32]
    """γ, shape (4,)."""
    fps: float
    """Frames a second."""
    number: int
    """Its number in the plan of the set."""
    shape: int
    """Number of its body shape."""
    split: str
    """`train` or `test`."""
    clip: str
    """Name of the motion."""
    start: float
    """Where in the motion it starts [s]."""
    mirrored: bool
    """Left and right of the motion are exchanged."""
    _units: NDArray[np.int16]

    def __len__(self) -> int:
        """Frames."""
        return len(self.kept)

    def vertices(self, frames: int | slice | NDArray[Any] = slice(None)) -> NDArray[np.float32]:
        """Garments on the body at zero translation, root rotation included, SMPL axes [m], shape ([n,] N, 3).

        Only the asked frames are read from disk.
        """
        return dequantise(np.asarray(self._units[frames]))


class GarmentSequences:
    """The finished sequences of a set, in the order of their numbers, memory-mapped and read-only."""

    def __init__(self, path: str | Path) -> None:
        """Opens all shards in the directory `path`, also while they are being written.

        Raises `SimulationError` when there is no set of sequences, no shard, or a damaged one.
        """
        path = Path(path)
        self.card: dict[str, Any] = read_card(path, SEQUENCES)
        """What the set is: plan, settings, versions, and counts and yield once it is summarised."""
        self._shards = shards_of(path, SequenceShard)
        if not self._shards:
            msg = f"{path}: a card and no shard; wanted shard-I-of-N directories beside it"
            raise SimulationError(msg)
        self._where, self._rows = rows_of(self._shards, (DONE,))
        self._clips = clip_names(self.card)
        bounds = {"cause": (0, len(CAUSES) + 1), "split": (0, 2)}
        check_rows(self._shards, self._where, self._rows, bounds)
        split = self.column("split")
        n_clips = np.where(split == TEST, len(self._clips["test"]), len(self._clips["train"]))
        check_rows(self._shards, self._where, self._rows, {"clip": (0, n_clips)})
        self.train: NDArray[np.bool_] = split != TEST
        """Which sequences are for training, shape (S,)."""
        self.test: NDArray[np.bool_] = split == TEST
        """Which sequences are kept for the test, shape (S,)."""

    def __len__(self) -> int:
        """Sequences."""
        return len(self._rows)

    def column(self, name: str) -> NDArray[Any]:
        """A column of all sequences as it is stored, shape (S, ...): `pose` (S, T, 24, 3), `betas`, and so on.

        Raises `SimulationError` for a name that is no column.
        """
        columns = self._shards[0].arrays
        if name not in columns:
            msg = f"wanted one of the columns {', '.join(sorted(columns))}, got {name!r}"
            raise SimulationError(msg)
        return gather(self._shards, self._where, self._rows, name)

    def sequence(self, index: int) -> GarmentSequence:
        """The sequence of this index, -S to S - 1.

        Raises `SimulationError` when there is no such sequence.
        """
        if not -len(self) <= index < len(self):
            msg = f"the set has {len(self)} finished sequences, there is none of the index {index}"
            raise SimulationError(msg)
        row = self._rows[index]
        array = {name: values[row] for name, values in self._shards[self._where[index]].arrays.items()}
        split = "test" if array["split"] == TEST else "train"
        return GarmentSequence(
            kept=np.asarray(array["cause"] == 0),
            cause=[None if cause == 0 else CAUSES[cause - 1] for cause in array["cause"]],
            pose=np.array(array["pose"]),
            asked=np.array(array["asked"]),
            transl=np.array(array["transl"]),
            betas=np.array(array["betas"]),
            style=np.array(array["style"]),
            fps=float(FPS),
            number=int(array["slot"]),
            shape=int(array["shape"]),
            split=split,
            clip=self._clips[split][int(array["clip"])],
            start=float(array["start"]),
            mirrored=bool(array["mirrored"]),
            _units=array["vertices"],
        )
