"""The files of a data set: memory-mapped arrays, one row a slot, and a card.

    SET/card.json                  plan, settings, versions, hashes, counts, yield
    SET/unseen.npy                 (count,) distance of each test sample to the training set, NaN for the others
    SET/shard-0-of-1/NAME.npy      S rows each; `columns_of` has their names, docs/guide/data.md what they are

A row's state is written last: a row that a killed process left half written is written again, with the same bytes.
"""

from __future__ import annotations

import json
import os
import shutil
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from refu_core._files import exclusive, open_file, read_json, replacing
from refu_core._npz import DAMAGE, check_npy
from refu_core.errors import SimulationError

FORMAT = "refu-garments-2"
SEQUENCES = "refu-sequences-2"
QUANTUM = 2.0**-14
"""Unit of stored positions [m]: 0.06 mm, so ±2 m fit and rounding moves a vertex by at most 0.03 mm per axis."""
GOT_THROUGH = ("body_collision", "self_intersection")
"""Causes that time and smoothing may mend: cloth that got through the body or itself."""
CAUSES = (*GOT_THROUGH, "stretch", "unsettled")
"""Why a sample isn't taken, in the order of the checks."""
FPS = 30
"""Frames of a sequence [1/s]."""
TO_DO, DONE, GIVEN_UP = 0, 1, 2
_ROWS = "shard-0-of-1"
_MAX_BYTES = 1 << 40
_MAX_ROWS = 1 << 22
"""The largest sets have a hundredth of that."""

Columns = dict[str, tuple[tuple[int, ...], str]]
"""Shape of a row and type of its values, by the name of the file."""


def columns_of(kind: str, shape: tuple[int, ...]) -> Columns:
    """Columns of a set of the format `kind`, with garments of the shape (N, 3), or (T, N, 3) for T frames each."""
    frames = shape[:-2]
    common: Columns = {
        "vertices": (shape, "<i2"),
        "pose": ((*frames, 24, 3), "<f4"),
        "betas": ((10,), "<f4"),
        "style": ((4,), "<f4"),
        "clip": ((), "<i4"),
        "split": ((), "|u1"),
        "stretch": (frames, "<f4"),
        "speed": (frames, "<f4"),
        "seconds": ((), "<f4"),
        "slot": ((), "<i4"),
        "state": ((), "|u1"),
    }
    if kind == FORMAT:
        return common | {"pair": ((), "<i4"), "frame": ((), "<i4"), "dropped": ((len(CAUSES),), "|u1")}
    return common | {
        "transl": ((*frames, 3), "<f4"),
        "cause": (frames, "|u1"),
        "shape": ((), "<i4"),
        "start": ((), "<f4"),
        "mirrored": ((), "|u1"),
        "dropped": ((len(CAUSES),), "<i4"),
    }


def quantise(vertices: NDArray[np.floating]) -> NDArray[np.int16]:
    """Positions [m] within ±2 m in units of `QUANTUM`. Raises `SimulationError` for positions that don't fit."""
    units = np.rint(np.asarray(vertices, np.float64) / QUANTUM)
    if not np.abs(units).max(initial=0) < 2**15:
        raise SimulationError("a garment more than 2 m away from its body can't be stored: the simulation has failed")
    return units.astype(np.int16)


def dequantise(units: NDArray[np.int16]) -> NDArray[np.float32]:
    """Positions [m] of stored units of any shape; exact."""
    metres: NDArray[np.float32] = units.astype(np.float32) * np.float32(QUANTUM)
    return metres


def has_rows(output: Path) -> bool:
    """Whether a set's rows are laid out."""
    return (output / _ROWS).exists()


class Rows:
    """The rows of a set, one memory-mapped array per column."""

    def __init__(self, output: Path, kind: str, *, mode: Literal["r", "r+"] = "r") -> None:
        """Opens the rows of a set of the format `kind` for reading (`r`) or writing (`r+`).

        Raises `SimulationError` when files are missing or don't fit together.
        """
        self.directory = output / _ROWS
        if not has_rows(output):
            raise SimulationError(f"{output}: no shard: wanted a folder {_ROWS} beside the card")
        self.arrays: dict[str, Any] = {
            name: _mapped(self.directory / f"{name}.npy", mode) for name in columns_of(kind, ())
        }
        shape, n = self.arrays["vertices"].shape[1:], self.arrays["slot"].size
        if len(shape) != (2 if kind == FORMAT else 3):
            raise SimulationError(f"{self.directory}: wanted vertices of the format {kind}, got the shape {shape}")
        for name, (row, dtype) in columns_of(kind, shape).items():
            array = self.arrays[name]
            if array.shape != (n, *row) or array.dtype != np.dtype(dtype):
                msg = f"{self.directory / name}.npy: wanted {dtype} of shape {(n, *row)}, "
                msg += f"got {array.dtype} of {array.shape}"
                raise SimulationError(msg)

    @staticmethod
    def create(output: Path, kind: str, slots: NDArray[np.int32], shape: tuple[int, ...]) -> None:
        """Lays out rows for these slots (S,) with garments of this shape, and reserves all their space on disk.

        Raises `SimulationError` when the disk hasn't enough space, or can't be written.
        """
        columns = columns_of(kind, shape)
        size = sum(len(slots) * int(np.prod(row)) * np.dtype(dtype).itemsize for row, dtype in columns.values())
        partial = output / f"{_ROWS}.new"
        try:
            partial.mkdir(parents=True, exist_ok=True)
            for name, (row, dtype) in columns.items():
                path = partial / f"{name}.npy"
                array = np.lib.format.open_memmap(path, "w+", np.dtype(dtype), (len(slots), *row))
                # A memory map on a full disk kills its process with SIGBUS; reserving first turns that into an error.
                with path.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
                if name == "slot":
                    array[:] = slots
                    array.flush()
            partial.rename(output / _ROWS)
        except OSError as error:
            shutil.rmtree(partial, ignore_errors=True)
            what = "samples" if kind == FORMAT else "sequences"
            msg = f"{output}: no room for {len(slots)} {what} ({size / 1e6:.0f} MB), or no right to write: {error}"
            raise SimulationError(msg) from error

    def finished(self, *states: int) -> NDArray[np.intp]:
        """The rows in one of these states, by slot."""
        rows = np.flatnonzero(np.isin(self.arrays["state"], states))
        return rows[np.argsort(self.arrays["slot"][rows], kind="stable")]

    def write(self, row: int, values: dict[str, Any]) -> None:
        """Fills a row; `state` last."""
        for name in sorted(values, key=lambda name: name == "state"):
            self.arrays[name][row] = values[name]
            self.arrays[name].flush()


def _mapped(path: Path, mode: Literal["r", "r+"] = "r") -> NDArray[Any]:
    """An array of a set, memory-mapped. Raises `SimulationError` where the file isn't complete."""
    try:
        with open_file(path, most=_MAX_BYTES, error=SimulationError, wanted="a column of a data set") as file:
            rows = check_npy(file, file.size)[0][:1]  # numpy would lengthen a file that was cut short
        if rows > (_MAX_ROWS,):
            raise ValueError(f"{rows[0]} rows, at most {_MAX_ROWS} are read")
        array: NDArray[Any] = np.load(path, mmap_mode=mode)
    except DAMAGE as error:
        raise SimulationError(f"{path}: not a column of a data set, or a damaged one: {error}") from error
    return array


def locked(output: Path) -> AbstractContextManager[None]:
    """Keeps other runs out of a set's rows while they are written. Raises `SimulationError` if another run has them."""
    msg = f"{output}: another run writes this set; wait for it"
    return exclusive(output / _ROWS / "lock", error=SimulationError(msg))


def read_card(directory: Path, *kinds: str) -> dict[str, Any]:
    """The card of a data set of one of these formats. Raises `SimulationError` for none or another format."""
    path = directory / "card.json"
    card = read_json(path, error=SimulationError, wanted="the card of a simulated data set")
    got = card.get("format") if isinstance(card, dict) else None
    if got not in kinds:
        raise SimulationError(f"{path}: wanted a data set's card of the format {' or '.join(kinds)}, got {got!r}")
    found: dict[str, Any] = card
    return found


def write_card(directory: Path, card: dict[str, Any]) -> None:
    """Writes the card in one step: a reader sees the old one or the new one."""
    with replacing(directory / "card.json") as file:
        file.write((json.dumps(card, indent=1) + "\n").encode())


def read_unseen(directory: Path, count: int) -> NDArray[np.float32]:
    """Distance of each slot's sample to the training set; NaN until `summarise` has written it.

    Raises `SimulationError` for a damaged file.
    """
    path = directory / "unseen.npy"
    if not path.exists():
        return np.broadcast_to(np.float32(np.nan), count)
    found = _mapped(path)
    if found.shape != (count,) or found.dtype != np.float32:
        raise SimulationError(f"{path}: wanted float32 of shape {(count,)}, got {found.dtype} of {found.shape}")
    return found
