"""Reading a simulated data set, also while it is being made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.simulation._errors import SimulationError
from refu_core.simulation._plan import TEST
from refu_core.simulation._store import DONE, Shard, dequantise, read_card


@dataclass(frozen=True, eq=False)
class GarmentSample:
    """One simulated garment and what it was simulated for."""

    vertices: NDArray[np.float32]
    """Garment on the body at zero translation, SMPL axes [m], shape (N, 3)."""
    pose: NDArray[np.float32]
    """θ, rotation vectors [rad], shape (24, 3)."""
    betas: NDArray[np.float32]
    """β, shape (10,)."""
    style: NDArray[np.float32]
    """γ, shape (4,)."""
    slot: int
    """Its number in the plan of the set."""
    pair: int
    """Number of its style-shape pair; those below the plan's `pivots` are the pivots."""
    split: str
    """`train` or `test`."""
    clip: str | None
    """Name of the motion that the pose is from; None for a drawn pose."""
    frame: int | None
    """Number of that motion's frame; None for a drawn pose."""
    unseen: float
    """Distance in (θ, β, γ) to the nearest training sample; NaN for those and until the set is summarised."""


class GarmentDataset:
    """The finished samples of a set, in the order of their slots, memory-mapped and read-only.

    Shards that are still being written may be read: those samples are there that were finished when the set was opened.
    """

    def __init__(self, path: str | Path) -> None:
        """Opens all shards in the directory `path`.

        Raises `SimulationError` when there is no set, no shard, a damaged one, or shards of different garments.
        """
        path = Path(path)
        self.card: dict[str, Any] = read_card(path)
        """What the set is: plan, settings, versions, and counts and yield once it is summarised."""
        directories = sorted(d for d in path.glob("shard-*-of-*") if d.suffix != ".new")
        if not directories:
            msg = f"{path}: a card and no shard; wanted shard-I-of-N directories beside it"
            raise SimulationError(msg)
        self._shards = [Shard(directory) for directory in directories]
        shapes = {shard.arrays["vertices"].shape[1] for shard in self._shards}
        if len(shapes) > 1:
            msg = f"{path}: wanted shards of one garment, got {sorted(shapes)} vertices a sample"
            raise SimulationError(msg)
        done = [np.flatnonzero(shard.arrays["state"] == DONE) for shard in self._shards]
        where = np.concatenate([np.full(len(rows), k) for k, rows in enumerate(done)])
        rows = np.concatenate(done)
        slots = np.concatenate([shard.arrays["slot"][rows] for shard, rows in zip(self._shards, done, strict=True)])
        # Shards of two divisions, 0/1 and 0/2 say, may hold one slot twice: the same bytes, so either will do.
        _, first = np.unique(slots, return_index=True)
        self._where, self._rows = where[first], rows[first]
        self._unseen = self._read_unseen(path / "unseen.npy")
        split = self.column("split")
        self.train: NDArray[np.bool_] = split != TEST
        """Which samples are for training, shape (M,)."""
        self.test: NDArray[np.bool_] = split == TEST
        """Which samples are kept for the test, shape (M,)."""

    def _read_unseen(self, path: Path) -> NDArray[np.float32]:
        count = int(self.card["plan"]["count"])
        if not path.exists():
            return np.full(count, np.nan, np.float32)
        try:
            unseen = np.load(path)
        except (OSError, ValueError) as error:
            msg = f"{path}: can't be read: {error}"
            raise SimulationError(msg) from error
        if unseen.shape != (count,) or unseen.dtype != np.float32:
            msg = f"{path}: wanted float32 of shape ({count},), got {unseen.dtype} of {unseen.shape}"
            raise SimulationError(msg)
        return np.asarray(unseen)

    def __len__(self) -> int:
        """Samples."""
        return len(self._rows)

    def column(self, name: str) -> NDArray[Any]:
        """A column of all samples as it is stored, shape (M, ...): `pose`, `betas`, `pair` and so on.

        `vertices` comes in units of `card["quantum_m"]`, and is as large as the set.

        Raises `SimulationError` for a name that is no column.
        """
        columns = self._shards[0].arrays
        if name not in columns:
            msg = f"wanted one of the columns {', '.join(sorted(columns))}, got {name!r}"
            raise SimulationError(msg)
        shape, kind = columns[name].shape[1:], columns[name].dtype
        out = np.empty((len(self), *shape), kind)
        for k, shard in enumerate(self._shards):
            here = self._where == k
            out[here] = shard.arrays[name][self._rows[here]]
        return out

    def sample(self, index: int) -> GarmentSample:
        """The sample of this index, -M to M - 1; its arrays are copies.

        Raises `SimulationError` when there is no such sample.
        """
        if not -len(self) <= index < len(self):
            msg = f"the set has {len(self)} finished samples, there is none of the index {index}"
            raise SimulationError(msg)
        row = self._rows[index]
        array = {name: values[row] for name, values in self._shards[self._where[index]].arrays.items()}
        split = "test" if array["split"] == TEST else "train"
        clip = int(array["clip"])
        return GarmentSample(
            vertices=dequantise(array["vertices"]),
            pose=np.array(array["pose"]),
            betas=np.array(array["betas"]),
            style=np.array(array["style"]),
            slot=int(array["slot"]),
            pair=int(array["pair"]),
            split=split,
            clip=None if clip < 0 else str(self.card["clips"][split][clip]),
            frame=None if clip < 0 else int(array["frame"]),
            unseen=float(self._unseen[array["slot"]]),
        )
