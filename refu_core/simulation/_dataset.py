"""Reading simulated sets, also while they are being made: garments at rest, and sequences."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._files import read_json
from refu_core.errors import SimulationError
from refu_core.simulation._motion import FPS
from refu_core.simulation._plan import TEST
from refu_core.simulation._selection import CAUSES
from refu_core.simulation._store import (
    DONE,
    FORMAT,
    SEQUENCES,
    SequenceShard,
    Shard,
    check_rows,
    clip_names,
    dequantise,
    gather,
    parts_of,
    read_by_slot,
    read_card,
    rows_of,
    shards_of,
)


@dataclass(frozen=True, eq=False)
class GarmentSample:
    """One simulated garment and what it was simulated for."""

    vertices: NDArray[np.float32]
    """Garment on the body at zero translation, SMPL axes [m], shape (N, 3); several one after the other (`parts`)."""
    pose: NDArray[np.float32]
    """θ that was simulated, rotation vectors [rad], shape (24, 3)."""
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


@dataclass(frozen=True, eq=False)
class GarmentSequence:
    """One continuous motion and the garment that moves with it, T frames."""

    kept: NDArray[np.bool_]
    """Which frames passed the selection, shape (T,): **the others hold a garment that collides, or none.**"""
    cause: list[str | None]
    """Why a frame didn't pass (one of `CAUSES`), T entries; None for those that did."""
    pose: NDArray[np.float32]
    """θ that was simulated, rotation vectors [rad], shape (T, 24, 3)."""
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


class _Rows:
    """The finished rows of a set, in the order of their slots, memory-mapped and read-only.

    Shards that are still being written may be read: those rows are there that were finished when the set was opened.
    """

    def __init__(self, path: Path, kind: str, shard: type[Shard], *, first_clip: int) -> None:
        self.card: dict[str, Any] = read_card(path, kind)
        """What the set is: plan, settings, versions, and counts and yield once it is summarised."""
        self._shards = shards_of(path, shard)
        shapes = {shard.arrays["vertices"].shape[1:] for shard in self._shards}
        if len(shapes) > 1:
            msg = f"{path}: wanted shards of one garment, got rows of the shapes {sorted(shapes)}"
            raise SimulationError(msg)
        self.parts = parts_of(path, self.card, shapes.pop()[-2])
        """Which of a row's vertices are each garment's: several where garments were simulated together."""
        self._where, self._rows = rows_of(self._shards, (DONE,))
        self._clips = clip_names(self.card)
        self._check(split=(0, 2))
        is_test = self.column("split") == TEST
        self._check(clip=(first_clip, np.where(is_test, len(self._clips["test"]), len(self._clips["train"]))))
        self.train: NDArray[np.bool_] = ~is_test
        """Which rows are for training, shape (M,)."""
        self.test: NDArray[np.bool_] = is_test
        """Which rows are kept for the test, shape (M,)."""

    def _check(self, **bounds: tuple[int, Any]) -> None:
        check_rows(self._shards, self._where, self._rows, bounds)

    def __len__(self) -> int:
        """Finished rows."""
        return len(self._rows)

    def column(self, name: str) -> NDArray[Any]:
        """A column of all rows as it is stored, shape (M, ...): `pose`, `betas` and so on.

        `vertices` comes in units of `card["quantum_m"]`, and is as large as the set.

        Raises `SimulationError` for a name that is no column.
        """
        columns = self._shards[0].arrays
        if name not in columns:
            msg = f"wanted one of the columns {', '.join(sorted(columns))}, got {name!r}"
            raise SimulationError(msg)
        return gather(self._shards, self._where, self._rows, name)

    def _row(self, index: int) -> tuple[dict[str, Any], str]:
        """The columns of one row, and its split. Raises `SimulationError` when there is no such row."""
        if not -len(self) <= index < len(self):
            msg = f"the set has {len(self)} finished rows, there is none of the index {index}"
            raise SimulationError(msg)
        arrays = self._shards[self._where[index]].arrays
        row = {name: values[self._rows[index]] for name, values in arrays.items()}
        return row, "test" if row["split"] == TEST else "train"


class GarmentDataset(_Rows):
    """The finished samples of a set, in the order of their slots, memory-mapped and read-only.

    Shards that are still being written may be read: those samples are there that were finished when the set was opened.
    """

    def __init__(self, path: str | Path) -> None:
        """Opens all shards in the directory `path`.

        Raises `SimulationError` when there is no set, no shard, a damaged one, or shards of different garments.
        """
        path = Path(path)
        super().__init__(path, FORMAT, Shard, first_clip=-1)
        plan = self.card.get("plan")
        count = plan.get("count") if isinstance(plan, dict) else None
        if not isinstance(count, int) or not 0 <= count < 2**31:
            msg = f"{path}: wanted a card with the number of samples in plan.count, got {str(count)[:80]}"
            raise SimulationError(msg)
        self._check(slot=(0, count))
        self._unseen = read_by_slot(path, "unseen", (count,))

    def column(self, name: str) -> NDArray[Any]:
        """A column of all samples, shape (M, ...): also `unseen`, which is kept by slot."""
        if name == "unseen":
            return np.asarray(self._unseen[super().column("slot")])
        return super().column(name)

    def sample(self, index: int) -> GarmentSample:
        """The sample of this index, -M to M - 1; its arrays are copies.

        Raises `SimulationError` when there is no such sample.
        """
        row, split = self._row(index)
        clip = int(row["clip"])
        return GarmentSample(
            vertices=dequantise(row["vertices"]),
            pose=np.array(row["pose"]),
            betas=np.array(row["betas"]),
            style=np.array(row["style"]),
            slot=int(row["slot"]),
            pair=int(row["pair"]),
            split=split,
            clip=None if clip < 0 else self._clips[split][clip],
            frame=None if clip < 0 else int(row["frame"]),
            unseen=float(self._unseen[row["slot"]]),
        )


class GarmentSequences(_Rows):
    """The finished sequences of a set, in the order of their numbers, memory-mapped and read-only."""

    def __init__(self, path: str | Path) -> None:
        """Opens all shards in the directory `path`, also while they are being written.

        Raises `SimulationError` when there is no set of sequences, no shard, or a damaged one.
        """
        super().__init__(Path(path), SEQUENCES, SequenceShard, first_clip=0)
        self._check(cause=(0, len(CAUSES) + 1))

    def sequence(self, index: int) -> GarmentSequence:
        """The sequence of this index, -S to S - 1.

        Raises `SimulationError` when there is no such sequence.
        """
        row, split = self._row(index)
        return GarmentSequence(
            kept=np.asarray(row["cause"] == 0),
            cause=[None if cause == 0 else CAUSES[cause - 1] for cause in row["cause"]],
            pose=np.array(row["pose"]),
            transl=np.array(row["transl"]),
            betas=np.array(row["betas"]),
            style=np.array(row["style"]),
            fps=float(FPS),
            number=int(row["slot"]),
            shape=int(row["shape"]),
            split=split,
            clip=self._clips[split][int(row["clip"])],
            start=float(row["start"]),
            mirrored=bool(row["mirrored"]),
            _units=row["vertices"],
        )


def open_dataset(path: str | Path) -> GarmentDataset | GarmentSequences:
    """Opens the set in the directory `path`: garments at rest, or sequences.

    Raises:
        SimulationError: there is no set, no shard, or a damaged one.
    """
    path = Path(path)
    try:
        kind = read_json(path / "card.json", error=SimulationError, wanted="a card")["format"]
    except (SimulationError, KeyError, TypeError):
        kind = None  # the reader of sets of garments says what is wrong
    return GarmentSequences(path) if kind == SEQUENCES else GarmentDataset(path)
