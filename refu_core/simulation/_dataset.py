"""Reading simulated sets, also while they are being made: garments at rest, and sequences."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import SimulationError
from refu_core.frames import MAX_ANGLE, MAX_COEFFICIENT
from refu_core.simulation import _store as store
from refu_core.simulation._joined import slices_of
from refu_core.simulation._plan import TEST
from refu_core.simulation._poses import POSTURES


@dataclass(frozen=True, eq=False)
class GarmentSample:
    """One simulated garment and what it was simulated for."""

    vertices: NDArray[np.float32]
    """Garment on the body at zero translation, SMPL axes [m], shape (N, 3); several follow one another (`parts`)."""
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
    posture: str | None
    """Which of `POSTURES` was varied; None for any other pose."""
    unseen: float
    """Distance in (θ, β, γ) to the nearest training sample; NaN for training samples, and until `summarise` runs."""


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
    """Translation of the body [m], shape (T, 3); the vertices don't include it."""
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
    clip: str | None
    """Name of the motion; None for a synthetic one."""
    start: float
    """Where in the motion it starts [s]."""
    mirrored: bool
    """Whether left and right of the motion are exchanged."""
    _units: NDArray[np.int16]

    def __len__(self) -> int:
        """Frames."""
        return len(self.kept)

    def vertices(self, frames: int | slice | NDArray[Any] = slice(None)) -> NDArray[np.float32]:
        """Garments on the body at zero translation, root rotation included, SMPL axes [m], shape ([n,] N, 3).

        Only the asked frames are read from disk.
        """
        return store.dequantise(np.asarray(self._units[frames]))


class _Finished:
    """The finished rows of a set, in the order of their slots, memory-mapped and read-only."""

    def __init__(self, path: str | Path, kind: str) -> None:
        self._path = Path(path)
        self.card: dict[str, Any] = store.read_card(self._path, kind)
        """What the set is: plan, settings, versions, and counts and yield once it is summarised."""
        stored = store.Rows(self._path, kind)
        self._columns, self._rows = stored.arrays, stored.finished(store.DONE)
        self.parts = self._parts(self._columns["vertices"].shape[-2])
        """The slice of a row's vertices of each garment: several where garments were simulated together."""
        self._clips = self._clip_names()
        self._check("split", 0, 1)
        self.test: NDArray[np.bool_] = self.column("split") == TEST
        self.train: NDArray[np.bool_] = ~self.test
        """Which rows are for training, shape (M,); the others, `test`, are kept for the test."""
        self._check("clip", -1, np.where(self.test, len(self._clips["test"]), len(self._clips["train"])) - 1)
        if self.card.get("quantum_m") != store.QUANTUM:
            msg = f"{path}: wanted positions in units of {store.QUANTUM} m, got {str(self.card.get('quantum_m'))[:80]}"
            raise SimulationError(msg)
        for name, largest in (("pose", MAX_ANGLE), ("betas", MAX_COEFFICIENT), ("style", MAX_COEFFICIENT)):
            self._check(name, -largest, largest)

    def _parts(self, n_vertices: int) -> dict[str, slice]:
        """Raises `SimulationError` for a card whose garments don't have that many vertices."""
        garment = str(self.card.get("garment"))
        parts = self.card.get("parts", {garment: n_vertices})
        is_whole = isinstance(parts, dict) and all(type(count) is int and count > 0 for count in parts.values())
        if not is_whole or sum(parts.values()) != n_vertices or list(parts) != garment.split("+"):
            msg = f"{self._path}: wanted a card whose parts are the {n_vertices} vertices of {garment[:80]} by "
            msg += f"garment, got {str(parts)[:80]}"
            raise SimulationError(msg)
        return slices_of(parts)

    def _clip_names(self) -> dict[str, list[str]]:
        """Names of the motions, by split. Raises `SimulationError` for a card that doesn't have them."""
        clips = self.card.get("clips")
        names = {split: clips.get(split) for split in ("train", "test")} if isinstance(clips, dict) else {}
        if not names or not all(isinstance(value, list) for value in names.values()):
            raise SimulationError(f"wanted motions' names in the card's clips.train and clips.test, got {clips!s:.80}")
        return {split: [str(name) for name in value or ()] for split, value in names.items()}

    def _check(self, name: str, low: float, high: Any) -> None:
        """Raises `SimulationError` where a column has a number that isn't from `low` to `high`."""
        values = self.column(name)
        high = np.broadcast_to(high, values.shape)
        bad = np.flatnonzero(~((values >= low) & (values <= high)))  # also NaN
        if bad.size:
            got = f"{name} is {values.flat[bad[0]]}, wanted {low:g} to {high.flat[bad[0]]:g}"
            raise SimulationError(f"{self._path}: damaged: {got}; simulate it again")

    def __len__(self) -> int:
        """Finished rows."""
        return len(self._rows)

    def column(self, name: str) -> NDArray[Any]:
        """A column of all rows as it is stored, shape (M, ...): `pose`, `betas` and so on.

        `vertices` are in the units that `dequantise` takes, and as large as the set.

        Raises `SimulationError` for a name that is no column.
        """
        if name not in self._columns:
            raise SimulationError(f"wanted one of the columns {', '.join(sorted(self._columns))}, got {name!r}")
        found: NDArray[Any] = self._columns[name][self._rows]
        return found

    def _row(self, index: int) -> tuple[dict[str, Any], str]:
        """The columns of one row, and its split. Raises `SimulationError` when there is no such row."""
        if not -len(self) <= index < len(self):
            raise SimulationError(f"the set has {len(self)} finished rows, there is none of the index {index}")
        row = {name: values[self._rows[index]] for name, values in self._columns.items()}
        return row, "test" if row["split"] == TEST else "train"


class GarmentDataset(_Finished):
    """The finished samples of a set, in the order of their slots, memory-mapped and read-only.

    A set that is still being made can be read: it has the samples that were finished when it was opened.
    """

    def __init__(self, path: str | Path) -> None:
        """Opens the set in the directory `path`. Raises `SimulationError` when there is none, or a damaged one."""
        super().__init__(path, store.FORMAT)
        plan = self.card.get("plan")
        count = plan.get("count") if isinstance(plan, dict) else None
        if not isinstance(count, int) or not 0 <= count < 2**31:
            raise SimulationError(f"{path}: wanted the number of samples in the card's plan.count, got {count!s:.80}")
        self._check("slot", 0, count - 1)
        self._unseen = store.read_unseen(self._path, count)

    def sample(self, index: int) -> GarmentSample:
        """The sample of this index, -M to M - 1; its arrays are copies.

        Raises `SimulationError` when there is no such sample.
        """
        row, split = self._row(index)
        clip, frame = int(row["clip"]), int(row["frame"])
        copied: dict[str, Any] = {name: np.array(row[name]) for name in ("pose", "betas", "style")}
        return GarmentSample(
            vertices=store.dequantise(row["vertices"]),
            **copied,
            slot=int(row["slot"]),
            pair=int(row["pair"]),
            split=split,
            clip=None if clip < 0 else self._clips[split][clip],
            frame=None if clip < 0 else frame,
            posture=tuple(POSTURES)[frame] if clip < 0 <= frame < len(POSTURES) else None,
            unseen=float(self._unseen[row["slot"]]),
        )


class GarmentSequences(_Finished):
    """The finished sequences of a set, in the order of their numbers, memory-mapped and read-only."""

    def __init__(self, path: str | Path) -> None:
        """Opens the set in the directory `path`. Raises `SimulationError` when there is none, or a damaged one."""
        super().__init__(path, store.SEQUENCES)
        self._check("cause", 0, len(store.CAUSES))

    def sequence(self, index: int) -> GarmentSequence:
        """The sequence of this index, -S to S - 1. Raises `SimulationError` when there is no such sequence."""
        row, split = self._row(index)
        copied: dict[str, Any] = {name: np.array(row[name]) for name in ("pose", "transl", "betas", "style")}
        return GarmentSequence(
            kept=np.asarray(row["cause"] == 0),
            cause=[None if cause == 0 else store.CAUSES[cause - 1] for cause in row["cause"]],
            **copied,
            fps=float(store.FPS),
            number=int(row["slot"]),
            shape=int(row["shape"]),
            split=split,
            clip=None if row["clip"] < 0 else self._clips[split][int(row["clip"])],
            start=float(row["start"]),
            mirrored=bool(row["mirrored"]),
            _units=row["vertices"],
        )


def open_dataset(path: str | Path) -> GarmentDataset | GarmentSequences:
    """Opens the set in the directory `path`: garments at rest, or sequences. Raises `SimulationError` as they do."""
    is_sequences = store.read_card(Path(path), store.FORMAT, store.SEQUENCES)["format"] == store.SEQUENCES
    return GarmentSequences(path) if is_sequences else GarmentDataset(path)
