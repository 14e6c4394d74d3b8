"""Reading a simulated data set, also while it is being made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import N_JOINTS
from refu_core.simulation._errors import SimulationError
from refu_core.simulation._plan import TEST
from refu_core.simulation._store import (
    DONE,
    check_rows,
    clip_names,
    dequantise,
    gather,
    read_by_slot,
    read_card,
    rows_of,
    shards_of,
)


@dataclass(frozen=True, eq=False)
class GarmentSample:
    """One simulated garment and what it was simulated for."""

    vertices: NDArray[np.float32]
    """Garment on the body at zero translation, SMPL axes [m], shape (N, 3)."""
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
    asked: NDArray[np.float32]
    """θ before limbs were held back to make room for the cloth, rotation vectors [rad], shape (24, 3): equal to `pose`
    where none was; NaN until a run of the set has ended."""
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
        self._shards = shards_of(path)
        if not self._shards:
            msg = f"{path}: a card and no shard; wanted shard-I-of-N directories beside it"
            raise SimulationError(msg)
        shapes = {shard.arrays["vertices"].shape[1] for shard in self._shards}
        if len(shapes) > 1:
            msg = f"{path}: wanted shards of one garment, got {sorted(shapes)} vertices a sample"
            raise SimulationError(msg)
        self._where, self._rows = rows_of(self._shards, (DONE,))
        plan = self.card.get("plan")
        count = plan.get("count") if isinstance(plan, dict) else None
        if not isinstance(count, int) or not 0 <= count < 2**31:
            msg = f"{path}: wanted a card with the number of samples in plan.count, got {str(count)[:80]}"
            raise SimulationError(msg)
        self._clips = clip_names(self.card)
        check_rows(self._shards, self._where, self._rows, {"slot": (0, count), "split": (0, 2)})
        is_test = gather(self._shards, self._where, self._rows, "split") == TEST
        n_clips = np.where(is_test, len(self._clips["test"]), len(self._clips["train"]))
        check_rows(self._shards, self._where, self._rows, {"clip": (-1, n_clips)})
        self._by_slot = {
            "unseen": read_by_slot(path, "unseen", (count,)),
            "asked": read_by_slot(path, "asked", (count, N_JOINTS, 3)),
        }
        self.train: NDArray[np.bool_] = ~is_test
        """Which samples are for training, shape (M,)."""
        self.test: NDArray[np.bool_] = is_test
        """Which samples are kept for the test, shape (M,)."""

    def __len__(self) -> int:
        """Samples."""
        return len(self._rows)

    def column(self, name: str) -> NDArray[Any]:
        """A column of all samples as it is stored, shape (M, ...): `pose`, `asked`, `betas`, `pair` and so on.

        `vertices` comes in units of `card["quantum_m"]`, and is as large as the set.

        Raises `SimulationError` for a name that is no column.
        """
        columns = self._shards[0].arrays
        if name in self._by_slot:
            return np.asarray(self._by_slot[name][self.column("slot")])
        if name not in columns:
            msg = f"wanted one of the columns {', '.join(sorted({*columns, *self._by_slot}))}, got {name!r}"
            raise SimulationError(msg)
        return gather(self._shards, self._where, self._rows, name)

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
            clip=None if clip < 0 else self._clips[split][clip],
            frame=None if clip < 0 else int(array["frame"]),
            asked=np.array(self._by_slot["asked"][array["slot"]]),
            unseen=float(self._by_slot["unseen"][array["slot"]]),
        )
