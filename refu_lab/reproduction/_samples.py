"""Test samples that methods are run on: those of a set of poses, or the frames of a set of sequences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import RefuError
from refu_core.simulation import GarmentDataset, GarmentSequences, open_dataset


class Sample(NamedTuple):
    """One body and the garment that was simulated on it."""

    vertices: NDArray[np.float32]
    """The true garment [m], shape (N, 3)."""
    pose: NDArray[np.float32]
    """θ [rad], shape (24, 3)."""
    betas: NDArray[np.float32]
    """β, shape (10,)."""
    style: NDArray[np.float32]
    """γ, shape (4,)."""
    unseen: float
    """Distance to the nearest training sample in (θ, β, γ); NaN where it isn't known."""


@dataclass(frozen=True, eq=False)
class SampleSet:
    """The test samples of one garment, read one at a time."""

    garment: str
    count: int
    shapes: int | None
    """Body shapes of a set of sequences; None for a set of poses."""
    read: Callable[[int], Sample]
    """The sample of a number from 0 to `count` - 1."""

    def __len__(self) -> int:
        return self.count

    def thinned(self, most: int) -> SampleSet:
        """At most so many of these samples, evenly spread."""
        rows = np.unique(np.linspace(0, self.count - 1, min(most, self.count)).round().astype(int))
        return replace(self, count=len(rows), read=lambda number: self.read(int(rows[number])))

    @classmethod
    def open(cls, path: Path) -> SampleSet:
        """The test samples of the set in the folder `path`, finished so far.

        Raises:
            RefuError: no such set, a damaged one, or one without a finished test sample.
        """
        dataset = open_dataset(path)
        samples = _of_sequences(dataset) if isinstance(dataset, GarmentSequences) else _of_poses(dataset)
        if not samples.count:
            msg = f"{path}: no test sample in it is finished yet"
            raise RefuError(msg)
        return samples


def _of_poses(dataset: GarmentDataset) -> SampleSet:
    rows = np.flatnonzero(dataset.test)

    def read(number: int) -> Sample:
        sample = dataset.sample(int(rows[number]))
        return Sample(sample.vertices, sample.pose, sample.betas, sample.style, sample.unseen)

    return SampleSet(str(dataset.card["garment"]), len(rows), None, read)


def _of_sequences(dataset: GarmentSequences) -> SampleSet:
    sequences = [dataset.sequence(int(row)) for row in np.flatnonzero(dataset.test)]
    frames = [(k, int(t)) for k, sequence in enumerate(sequences) for t in np.flatnonzero(sequence.kept)]

    def read(number: int) -> Sample:
        sequence, t = sequences[frames[number][0]], frames[number][1]
        return Sample(sequence.vertices(t), sequence.pose[t], sequence.betas, sequence.style, float("nan"))

    plan = dataset.card["plan"]
    return SampleSet(str(plan["garment"]), len(frames), int(plan["shapes"]), read)
