"""The files of a data set: memory-mapped arrays, one row a slot, and a card.

    SET/card.json                       plan, settings, versions, hashes, counts, yield
    SET/unseen.npy                      (count,) distance of each test sample to the training set, NaN for the others
    SET/shard-I-of-N/slot.npy           (S,) int32, number of each row's slot in the plan
                     state.npy          (S,) uint8, 0 to do, 1 done, 2 given up
                     vertices.npy       (S, N, 3) int16, posed garment in units of 2^-14 m, see `QUANTUM`
                     pose.npy           (S, 24, 3) float32 [rad]
                     betas.npy          (S, 10) float32
                     style.npy          (S, 4) float32
                     pair.npy clip.npy frame.npy      (S,) int32; clip and frame are -1 for a drawn pose
                     split.npy          (S,) uint8, 0 training, 1 test
                     dropped.npy        (S, 4) uint8, attempts that failed, by cause
                     stretch.npy speed.npy seconds.npy      (S,) float32

A set of sequences has the format `SEQUENCES`, one row a sequence, and other columns: see `sequence_columns`.

A row is written before its state is: what a killed process leaves half written is written again, to the same bytes.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._files import open_file, read_json, replacing
from refu_core._npz import DAMAGE, check_npy
from refu_core.errors import SimulationError
from refu_core.simulation._joined import slices_of
from refu_core.simulation._selection import CAUSES

FORMAT = "refu-garments-2"
SEQUENCES = "refu-sequences-2"
QUANTUM = 2.0**-14
"""Unit of stored positions [m]: 0.06 mm, so ±2 m fit and rounding moves a vertex by at most 0.03 mm an axis."""
TO_DO, DONE, GIVEN_UP = 0, 1, 2
_MAX_BYTES = 1 << 40
_MAX_ROWS = 1 << 22
"""Of a shard; the largest sets have a hundredth of that."""


Columns = dict[str, tuple[tuple[int, ...], str]]
"""Shape of a row and type, by the name of the file."""


def sample_columns(shape: tuple[int, ...]) -> Columns:
    """Columns of a set of samples with garments of this shape, (N, 3)."""
    return {
        "vertices": (shape, "<i2"),
        "pose": ((24, 3), "<f4"),
        "betas": ((10,), "<f4"),
        "style": ((4,), "<f4"),
        "pair": ((), "<i4"),
        "clip": ((), "<i4"),
        "frame": ((), "<i4"),
        "split": ((), "|u1"),
        "dropped": ((len(CAUSES),), "|u1"),
        "stretch": ((), "<f4"),
        "speed": ((), "<f4"),
        "seconds": ((), "<f4"),
        "slot": ((), "<i4"),
        "state": ((), "|u1"),
    }


def sequence_columns(shape: tuple[int, ...]) -> Columns:
    """Columns of a set of sequences with garments of this shape, (T, N, 3): T frames each."""
    frames = shape[:1]
    return {
        "vertices": (shape, "<i2"),
        "pose": ((*frames, 24, 3), "<f4"),
        "transl": ((*frames, 3), "<f4"),
        "cause": (frames, "|u1"),  # 0 a frame in the set, 1 and above: why not, by the order of `CAUSES`
        "stretch": (frames, "<f4"),
        "speed": (frames, "<f4"),
        "betas": ((10,), "<f4"),
        "style": ((4,), "<f4"),
        "shape": ((), "<i4"),
        "clip": ((), "<i4"),
        "start": ((), "<f4"),
        "mirrored": ((), "|u1"),
        "split": ((), "|u1"),
        "dropped": ((len(CAUSES),), "<i4"),
        "seconds": ((), "<f4"),
        "slot": ((), "<i4"),
        "state": ((), "|u1"),
    }


def quantise(vertices: NDArray[np.floating]) -> NDArray[np.int16]:
    """Positions [m] within ±2 m in units of `QUANTUM`.

    Raises `SimulationError` for positions that don't fit.
    """
    units = np.rint(np.asarray(vertices, np.float64) / QUANTUM)
    if not np.abs(units).max(initial=0) < 2**15:
        msg = "a garment more than 2 m away from its body can't be stored: the simulation has failed"
        raise SimulationError(msg)
    return units.astype(np.int16)


def dequantise(units: NDArray[np.int16]) -> NDArray[np.float32]:
    """Positions [m] of stored units; exact."""
    metres: NDArray[np.float32] = units.astype(np.float32) * np.float32(QUANTUM)
    return metres


class Shard:
    """The rows of one shard of a set of samples."""

    columns: Callable[[tuple[int, ...]], Columns] = staticmethod(sample_columns)
    what = "samples"

    def __init__(self, directory: Path, *, mode: str = "r") -> None:
        """Opens an existing shard to read (`r`) or to write (`r+`).

        Raises `SimulationError` when files are missing or don't fit together.
        """
        self.directory = directory
        self.arrays: dict[str, Any] = {}
        try:
            for name in self.columns(()):
                path = directory / f"{name}.npy"
                with open_file(path, most=_MAX_BYTES, error=SimulationError, wanted="a column of a data set") as file:
                    rows = check_npy(file, file.size)[0][:1]  # numpy would lengthen a file that was cut short
                if rows > (_MAX_ROWS,):
                    msg = f"{path}: {rows[0]} rows, at most {_MAX_ROWS} are read"
                    raise SimulationError(msg)
                self.arrays[name] = np.load(path, mmap_mode=mode)  # type: ignore[arg-type]
        except DAMAGE as error:
            msg = f"{directory}: not a shard of a data set, or a damaged one: {error}"
            raise SimulationError(msg) from error
        wanted = self.columns(self.arrays["vertices"].shape[1:])
        n = self.arrays["slot"].size
        for name, (shape, kind) in wanted.items():
            array = self.arrays[name]
            if array.shape != (n, *shape) or array.dtype != np.dtype(kind):
                msg = (
                    f"{directory / name}.npy: wanted {kind} of shape {(n, *shape)}, got {array.dtype} of {array.shape}"
                )
                raise SimulationError(msg)

    @classmethod
    def create(cls, directory: Path, slots: NDArray[np.int32], shape: tuple[int, ...]) -> None:
        """Lays out a shard for these slots (S,) with garments of this shape, with all its room on disk reserved.

        Raises `SimulationError` when the disk hasn't the room, or can't be written.
        """
        columns = cls.columns(shape)
        size = sum(len(slots) * int(np.prod(row)) * np.dtype(kind).itemsize for row, kind in columns.values())
        partial = directory.with_name(directory.name + ".new")
        try:
            partial.mkdir(parents=True, exist_ok=True)
            for name, (row, kind) in columns.items():
                path = partial / f"{name}.npy"
                array = np.lib.format.open_memmap(path, "w+", np.dtype(kind), (len(slots), *row))
                del array
                # A memory map on a full disk kills its process with SIGBUS; reserving first turns that into an error.
                with path.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
            column = np.load(partial / "slot.npy", mmap_mode="r+")
            column[:] = slots
            column.flush()
            partial.rename(directory)
        except OSError as error:
            shutil.rmtree(partial, ignore_errors=True)
            msg = (
                f"{directory}: no room for {len(slots)} {cls.what} ({size / 1e6:.0f} MB), or no right to write: {error}"
            )
            raise SimulationError(msg) from error

    def write(self, row: int, values: dict[str, Any]) -> None:
        """Fills a row; `state` last."""
        state = values["state"]
        for name, value in values.items():
            if name != "state":
                self.arrays[name][row] = value
                self.arrays[name].flush()
        self.arrays["state"][row] = state
        self.arrays["state"].flush()


class SequenceShard(Shard):
    """The rows of one shard of a set of sequences."""

    columns: Callable[[tuple[int, ...]], Columns] = staticmethod(sequence_columns)
    what = "sequences"


def shards_of(directory: Path, kind: type[Shard] = Shard) -> list[Shard]:
    """The shards of a set, by name; none that is only being laid out. Raises `SimulationError` where there is none."""
    shards = [kind(path) for path in sorted(directory.glob("shard-*-of-*")) if path.suffix != ".new"]
    if not shards:
        msg = f"{directory}: a card and no shard; wanted shard-I-of-N directories beside it"
        raise SimulationError(msg)
    return shards


def rows_of(shards: Sequence[Shard], states: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Shard and row of each slot in one of `states`, by slot.

    Shards of two divisions, 0/1 and 0/2 say, may both hold a slot. Finished, it has the same bytes in both; where it is
    finished in one only, that one counts.
    """
    slot = np.concatenate([shard.arrays["slot"] for shard in shards])
    state = np.concatenate([shard.arrays["state"] for shard in shards])
    where = np.concatenate([np.full(len(shard.arrays["slot"]), k) for k, shard in enumerate(shards)])
    row = np.concatenate([np.arange(len(shard.arrays["slot"])) for shard in shards])
    order = np.lexsort((state == TO_DO, slot))
    order = order[np.unique(slot[order], return_index=True)[1]]
    order = order[np.isin(state[order], states)]
    return where[order], row[order]


def check_rows(
    shards: Sequence[Shard], where: NDArray[np.intp], row: NDArray[np.intp], bounds: dict[str, tuple[int, Any]]
) -> None:
    """Checks that columns of whole numbers, at these rows, are within bounds: the lower one in, the upper one out.

    Raises `SimulationError` where one isn't: the set is damaged.
    """
    for name, (low, high) in bounds.items():
        values = gather(shards, where, row, name)
        high = np.broadcast_to(high, values.shape)
        bad = np.flatnonzero((values < low) | (values >= high))
        if bad.size:
            set_, value, limit = shards[0].directory.parent, values.flat[bad[0]], high.flat[bad[0]]
            msg = f"{set_}: damaged: {name} is {value}, wanted {low} to {limit - 1}; simulate it again"
            raise SimulationError(msg)


def clip_names(card: dict[str, Any]) -> dict[str, list[str]]:
    """Names of the motions, by split. Raises `SimulationError` for a card that doesn't have them."""
    clips = card.get("clips")
    names = {split: clips.get(split) for split in ("train", "test")} if isinstance(clips, dict) else {}
    if not names or not all(isinstance(value, list) for value in names.values()):
        msg = f"wanted a card with the names of the motions in clips.train and clips.test, got {str(clips)[:80]}"
        raise SimulationError(msg)
    return {split: [str(name) for name in value or ()] for split, value in names.items()}


def parts_of(path: Path, card: dict[str, Any], n_vertices: int) -> dict[str, slice]:
    """Which of a row's vertices are each garment's, by the card of the set at `path`.

    Raises `SimulationError` for a card whose garments don't have that many vertices.
    """
    garment = str(card.get("garment"))
    parts = card.get("parts", {garment: n_vertices})
    is_whole = isinstance(parts, dict) and all(type(count) is int and count > 0 for count in parts.values())
    if not is_whole or sum(parts.values()) != n_vertices or list(parts) != garment.split("+"):
        msg = f"{path}: wanted a card whose parts are the {n_vertices} vertices of {garment[:80]} by garment, "
        msg += f"got {str(parts)[:80]}"
        raise SimulationError(msg)
    return slices_of(parts)


def gather(shards: Sequence[Shard], where: NDArray[np.intp], row: NDArray[np.intp], name: str) -> NDArray[Any]:
    """A column at these rows of these shards, as `rows_of` names them, shape (M, ...)."""
    column = shards[0].arrays[name]
    out = np.empty((len(row), *column.shape[1:]), column.dtype)
    for k, shard in enumerate(shards):
        here = where == k
        out[here] = shard.arrays[name][row[here]]
    return out


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keeps other runs out of a shard while it is written; the lock goes with the process, however that ends.

    Raises `SimulationError` when another run has it.
    """
    import fcntl

    with (directory / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            msg = f"{directory}: another run writes this set; wait for it"
            raise SimulationError(msg) from error
        yield


def read_card(directory: Path, kind: str = FORMAT) -> dict[str, Any]:
    """The card of a data set of the format `kind`. Raises `SimulationError` when there is none, or it can't be read."""
    path = directory / "card.json"
    card = read_json(path, error=SimulationError, wanted="the card of a simulated data set")
    if not isinstance(card, dict) or card.get("format") != kind:
        got = card.get("format") if isinstance(card, dict) else None
        msg = f"{path}: wanted the card of a data set of the format {kind}, got the format {got!r}"
        raise SimulationError(msg)
    return card


def write_card(directory: Path, card: dict[str, Any]) -> None:
    """Writes the card in one step: a reader sees the old one or the new one."""
    with replacing(directory / "card.json") as file:
        file.write((json.dumps(card, indent=1) + "\n").encode())


def write_by_slot(directory: Path, name: str, values: NDArray[np.float32]) -> None:
    """Writes `name`.npy of a set, one row a slot, in one step."""
    with replacing(directory / f"{name}.npy") as file:
        np.save(file, values)


def read_by_slot(directory: Path, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """`name`.npy of a set, of this shape; NaN where it hasn't been written yet.

    Raises `SimulationError` for a damaged file.
    """
    path = directory / f"{name}.npy"
    if not path.exists():
        return np.broadcast_to(np.float32(np.nan), shape)
    try:
        with open_file(path, most=_MAX_BYTES, error=SimulationError, wanted=f"{name} of a data set") as file:
            found, dtype = check_npy(file, file.size)
            if found == shape and dtype == np.float32:
                file.seek(0)
                return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
    except DAMAGE as error:
        if isinstance(error, SimulationError):
            raise
        msg = f"{path}: can't be read: {error}"
        raise SimulationError(msg) from error
    msg = f"{path}: wanted float32 of shape {shape}, got {dtype} of {found}"
    raise SimulationError(msg)
