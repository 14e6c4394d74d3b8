"""Runs methods on the test samples of a data set; keeps every figure of every sample for all tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from msg_adapters import BAG_SUFFIXES
from refu_core._engine import Engine, InProcess, Lost
from refu_core.errors import RefuError
from refu_core.frames import N_STYLES
from refu_core.garments import load_garment
from refu_core.metrics import CollisionChecker, Figures, FrameMetrics, GarmentMetrics
from refu_core.simulation import GarmentDataset, GarmentSequences, open_dataset
from refu_lab.reproduction._load import Library
from refu_lab.reproduction._methods import METHODS
from refu_lab.reproduction._predict import GarmentSetup, MethodOutput, Predictor, SampleScene
from refu_lab.reproduction._tables import Missing
from refu_lab.truth import garments_of, moments_of

RATIO_EDGES: tuple[float, ...] = (0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 4.25, 4.75, float("inf"))
"""Limits of the groups by ratio of approximate to accurate distance, as in the supplement's bar plot."""
_BLOCK = 8
"""Samples in a task: a few seconds' work."""


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
    """Distance to the nearest training sample in (θ, β, γ); NaN if it isn't known."""
    posture: str | None = None
    """Name of the pose in `POSTURES`; None if it is another pose, or isn't known."""


@dataclass(frozen=True, eq=False)
class SampleSet:
    """The test samples of one garment, read one at a time."""

    garment: str
    count: int
    shapes: int | None
    """Number of body shapes in a set of sequences; None for a set of poses."""
    read: Callable[[int], Sample]
    """Reads the sample of a number from 0 to `count` - 1."""

    def __len__(self) -> int:
        return self.count

    def thinned(self, most: int) -> SampleSet:
        """At most `most` of these samples, evenly spread."""
        rows = np.unique(np.linspace(0, self.count - 1, min(most, self.count)).round().astype(int))
        return replace(self, count=len(rows), read=lambda number: self.read(int(rows[number])))

    @classmethod
    def open(cls, path: Path) -> SampleSet:
        """The test samples finished so far of the set in the folder `path`, or the samples of a bag with ground truth.

        Raises:
            RefuError: no such set or bag, a damaged one, one without a finished test sample, or a bag whose truth isn't
                of one garment.
        """
        if any(one.suffix in BAG_SUFFIXES for one in (path, *path.glob("*"))):
            return _of_bag(path)
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
        return Sample(sample.vertices, sample.pose, sample.betas, sample.style, sample.unseen, sample.posture)

    return SampleSet(str(dataset.card["garment"]), len(rows), None, read)


def _of_bag(path: Path) -> SampleSet:
    names = garments_of(path)
    if len(names) != 1:
        msg = f"{path}: wanted the ground truth of one garment, got {', '.join(names) or 'none'}"
        raise RefuError(msg)
    moments = moments_of(path, load_garment(names[0]))

    def read(number: int) -> Sample:
        frame, truth, _ = moments[number]
        style = np.zeros(N_STYLES, np.float32) if frame.style is None else frame.style
        # Copies, since a frame's arrays are read-only.
        return Sample(truth.astype(np.float32), frame.pose.copy(), frame.betas.copy(), style.copy(), float("nan"))

    return SampleSet(names[0], len(moments), None, read)


def _of_sequences(dataset: GarmentSequences) -> SampleSet:
    sequences = [dataset.sequence(int(row)) for row in np.flatnonzero(dataset.test)]
    frames = [(k, int(t)) for k, sequence in enumerate(sequences) for t in np.flatnonzero(sequence.kept)]

    def read(number: int) -> Sample:
        sequence, t = sequences[frames[number][0]], frames[number][1]
        return Sample(sequence.vertices(t), sequence.pose[t], sequence.betas, sequence.style, float("nan"))

    plan = dataset.card["plan"]
    return SampleSet(str(plan["garment"]), len(frames), int(plan["shapes"]), read)


@dataclass(eq=False)
class ScaleByRatio:
    """Predicted scales α, grouped by the ratio of the approximate to the accurate distance."""

    count: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(RATIO_EDGES) - 1, np.int64))
    """Number of vertices in each group, shape (11,)."""
    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(RATIO_EDGES) - 1))
    """Sum of α in each group, shape (11,)."""

    def join(self, other: ScaleByRatio) -> None:
        """Adds the counts and sums of another one."""
        self.count += other.count
        self.total += other.total

    def add(self, output: MethodOutput) -> None:
        """Adds the vertices that both distances put inside the body (the supplement's "collision-resolved")."""
        approx, accurate = output.approx.numpy(), output.accurate.numpy()
        inside = (approx < 0) & (accurate < 0)
        group = np.digitize(approx[inside] / accurate[inside], RATIO_EDGES) - 1
        np.add.at(self.count, group, 1)
        np.add.at(self.total, group, output.scale.numpy()[inside])


@dataclass(eq=False)
class MethodRun:
    """One method on one garment's test samples."""

    garment: str
    method: str
    samples: list[FrameMetrics] = field(default_factory=list)
    """The figures of each sample, in the set's order."""
    unseen: list[float] = field(default_factory=list)
    """Each sample's distance to the training set in (θ, β, γ)."""
    postures: list[str | None] = field(default_factory=list)
    """Each sample's posture."""
    ms: dict[str, list[float]] = field(default_factory=dict)
    """Wall time of each sample by component [ms]."""
    scales: ScaleByRatio = field(default_factory=ScaleByRatio)

    @cached_property
    def figures(self) -> Figures:
        """The figures over all samples."""
        return Figures.over(self.samples)

    def values(self, name: str) -> NDArray[np.float64]:
        """A field of `FrameMetrics` for all samples."""
        return np.array([getattr(sample, name) for sample in self.samples], np.float64)

    def median_ms(self, *components: str) -> float | None:
        """Median time of some components together [ms]; None if the method lacks one."""
        if not self.samples or not set(components) <= set(self.ms):
            return None
        return float(np.median(np.sum([self.ms[component] for component in components], axis=0)))

    def of_postures(self, postures: Sequence[str]) -> list[FrameMetrics]:
        """The figures of the samples in these postures."""
        return [sample for sample, posture in zip(self.samples, self.postures, strict=True) if posture in postures]

    @classmethod
    def joined(cls, garment: str, method: str, runs: Iterable[MethodRun]) -> MethodRun:
        """One run with all samples of `runs`, in their order."""
        whole = cls(garment, method)
        for run in runs:
            whole.join(run)
        return whole

    def join(self, other: MethodRun) -> None:
        """Appends the samples of another run."""
        self.samples += other.samples
        self.unseen += other.unseen
        self.postures += other.postures
        for component, ms in other.ms.items():
            self.ms.setdefault(component, []).extend(ms)
        self.scales.join(other.scales)


@dataclass(eq=False)
class Study:
    """All runs, and the methods that couldn't be run."""

    runs: dict[tuple[str, str], MethodRun] = field(default_factory=dict)
    """By (garment, method)."""
    missing: dict[tuple[str, str], Missing] = field(default_factory=dict)
    n_samples: dict[str, int] = field(default_factory=dict)
    """Test samples by garment."""

    def pooled(self, method: str) -> list[MethodRun]:
        """The method's runs on all garments; none if one is missing, as means would then be over other garments."""
        runs = [self.runs.get((garment, method)) for garment in self.n_samples]
        return [run for run in runs if run is not None] if None not in runs else []


def run_methods(
    study: Study,
    samples: SampleSet,
    methods: Sequence[str],
    *,
    library: Library,
    engine: Engine | None = None,
    progress: bool = False,
) -> None:
    """Runs methods by name, and the base of each, on the test samples of one garment, and adds the runs to `study`.

    `engine` runs them, a block of samples a task; None stands for this process. Figures don't depend on it, times do.

    Raises `RefuError` if blocks are lost with their processes, or the processes can't be reached.
    """
    garment = samples.garment
    study.n_samples[garment] = len(samples)
    setup = GarmentSetup(garment, library)
    ready: dict[str, Predictor] = {}
    bases = [METHODS[name].base for name in methods]
    for name in dict.fromkeys([*bases, *methods]):  # their Laplacian errors are measured against the bases'
        method = METHODS[name]
        try:
            ready[name] = Predictor(method, setup, library)
        except RefuError as error:
            study.missing[garment, name] = Missing(garment, name, str(error), method.train_command(garment))
    if not ready:
        return
    runner = _Runner(garment, library, tuple(ready), (setup, ready))
    parts: dict[int, dict[str, MethodRun]] = {}
    with tqdm(total=len(samples), desc=garment, unit="sample", disable=None if progress else True) as bar:
        for index, part in (engine or InProcess()).run(runner, _Blocks(samples)):
            if isinstance(part, Lost):
                msg = f"{garment}: samples {index * _BLOCK} and following are lost: {part.reason}"
                raise RefuError(msg)
            parts[index] = part
            bar.update(len(next(iter(part.values())).samples))
    for name in ready:
        in_order = (parts[index][name] for index in sorted(parts))  # in whatever order they were done
        study.runs[garment, name] = MethodRun.joined(garment, name, in_order)


@dataclass
class _Runner:
    """Makes a process's function, which turns samples into runs."""

    garment: str
    library: Library
    methods: tuple[str, ...]
    """Bases first."""
    made: tuple[GarmentSetup, Mapping[str, Predictor]] | None = None
    """Those that this process has already; another process makes its own."""

    def __call__(self) -> Callable[[list[Sample]], dict[str, MethodRun]]:
        if self.made is None:
            setup = GarmentSetup(self.garment, self.library)
            self.made = setup, {name: Predictor(METHODS[name], setup, self.library) for name in self.methods}
        return partial(_run_samples, *self.made, self.garment)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Runner, (self.garment, self.library, self.methods)


class _Blocks(Sequence[list[Sample]]):
    """Samples in blocks, read when they are asked for."""

    def __init__(self, samples: SampleSet) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return -(-len(self._samples) // _BLOCK)

    def __getitem__(self, index: Any) -> Any:
        first = index * _BLOCK
        return [self._samples.read(number) for number in range(first, min(first + _BLOCK, len(self._samples)))]


def _run_samples(
    setup: GarmentSetup, predictors: Mapping[str, Predictor], garment: str, samples: Sequence[Sample]
) -> dict[str, MethodRun]:
    faces = setup.template.faces.numpy()
    checker = CollisionChecker(setup.body.faces)
    metrics = {name: GarmentMetrics(faces) for name in predictors}
    runs = {name: MethodRun(garment, name) for name in predictors}
    for sample in samples:
        scene = SampleScene(setup, sample.pose, sample.betas, sample.style)
        checker.update(scene.vertices)
        colliding = dict.fromkeys(METHODS, np.zeros(setup.template.n_vertices, np.bool_))
        for name, predict in predictors.items():
            output = predict(scene)
            found = checker.check(output.vertices, faces)
            base = METHODS[name].base
            if base == name:
                colliding[name] = found.inside
            run = runs[name]
            frame = metrics[name].add(output.vertices, found, truth=sample.vertices, resolved=colliding[base])
            run.samples.append(frame)
            run.unseen.append(sample.unseen)
            run.postures.append(sample.posture)
            run.scales.add(output)
            for component, ms in output.ms.items():
                run.ms.setdefault(component, []).append(ms)
    return runs
