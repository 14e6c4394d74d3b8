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
                     dropped.npy        (S, 5) uint8, attempts that failed, by cause
                     share.npy stretch.npy speed.npy seconds.npy      (S,) float32

A row is written before its state is: what a killed process leaves half written is written again, to the same bytes.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.simulation._errors import SimulationError
from refu_core.simulation._selection import CAUSES

FORMAT = "refu-garments-1"
QUANTUM = 2.0**-14
"""Unit of stored positions [m]: 0.06 mm, so ±2 m fit and rounding moves a vertex by at most 0.03 mm an axis."""
TO_DO, DONE, GIVEN_UP = 0, 1, 2


def _columns(n_vertices: int) -> dict[str, tuple[tuple[int, ...], str]]:
    return {
        "vertices": ((n_vertices, 3), "<i2"),
        "pose": ((24, 3), "<f4"),
        "betas": ((10,), "<f4"),
        "style": ((4,), "<f4"),
        "pair": ((), "<i4"),
        "clip": ((), "<i4"),
        "frame": ((), "<i4"),
        "split": ((), "|u1"),
        "dropped": ((len(CAUSES),), "|u1"),
        "share": ((), "<f4"),
        "stretch": ((), "<f4"),
        "speed": ((), "<f4"),
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
    """The rows of one shard."""

    def __init__(self, directory: Path, *, mode: str = "r") -> None:
        """Opens an existing shard to read (`r`) or to write (`r+`).

        Raises `SimulationError` when files are missing or don't fit together.
        """
        self.directory = directory
        self.arrays: dict[str, Any] = {}
        try:
            for name in _columns(0):
                self.arrays[name] = np.load(directory / f"{name}.npy", mmap_mode=mode)  # type: ignore[arg-type]
        except (OSError, ValueError) as error:
            msg = f"{directory}: not a shard of a data set, or a damaged one: {error}"
            raise SimulationError(msg) from error
        wanted = _columns(self.arrays["vertices"].shape[1])
        n = len(self.arrays["slot"])
        for name, (shape, kind) in wanted.items():
            array = self.arrays[name]
            if array.shape != (n, *shape) or array.dtype != np.dtype(kind):
                msg = (
                    f"{directory / name}.npy: wanted {kind} of shape {(n, *shape)}, got {array.dtype} of {array.shape}"
                )
                raise SimulationError(msg)

    @staticmethod
    def create(directory: Path, slots: NDArray[np.int32], n_vertices: int) -> None:
        """Lays out a shard for these slots (S,), with all its room on disk reserved.

        Raises `SimulationError` when the disk hasn't the room, or can't be written.
        """
        size = sum(
            len(slots) * int(np.prod(shape)) * np.dtype(kind).itemsize for shape, kind in _columns(n_vertices).values()
        )
        partial = directory.with_name(directory.name + ".new")
        try:
            partial.mkdir(parents=True, exist_ok=True)
            for name, (shape, kind) in _columns(n_vertices).items():
                path = partial / f"{name}.npy"
                array = np.lib.format.open_memmap(path, "w+", np.dtype(kind), (len(slots), *shape))
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
            msg = f"{directory}: no room for {len(slots)} samples ({size / 1e6:.0f} MB), or no right to write: {error}"
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
            msg = f"{directory}: another run writes this shard; wait for it, or give another --shard"
            raise SimulationError(msg) from error
        yield


def read_card(directory: Path) -> dict[str, Any]:
    """The card of a data set. Raises `SimulationError` when there is none, or it can't be read."""
    path = directory / "card.json"
    try:
        card = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        msg = f"{path}: wanted the card of a simulated data set: {error}"
        raise SimulationError(msg) from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        msg = f"{path}: wanted the card of a data set of the format {FORMAT}, got another format"
        raise SimulationError(msg)
    return card


def write_card(directory: Path, card: dict[str, Any]) -> None:
    """Writes the card in one step: a reader sees the old one or the new one."""
    partial = directory / f"card.json.{os.getpid()}"
    partial.write_text(json.dumps(card, indent=1) + "\n")
    partial.replace(directory / "card.json")
