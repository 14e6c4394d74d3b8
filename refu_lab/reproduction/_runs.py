"""Runs methods on the test samples of a data set; keeps every figure of every sample for all tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
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
from refu_lab.fleet._engine import run_function
from refu_lab.reproduction._methods import METHODS, Library
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
    def joined(cls, sets: Sequence[SampleSet]) -> list[SampleSet]:
        """The sets, those of one garment and kind joined to one."""
        groups: dict[tuple[str, int | None], list[SampleSet]] = {}
        for one in sets:
            groups.setdefault((one.garment, one.shapes), []).append(one)
        found = []
        for (garment, shapes), group in groups.items():
            places = [(one, row) for one in group for row in range(len(one))]
            found.append(cls(garment, len(places), shapes, partial(_read, places)))
        return found

    @classmethod
    def open(cls, path: Path) -> SampleSet:
        """The test samples finished so far of the set in the folder `path`, or the samples of a bag with ground truth.

        Raises `RefuError`: no such set or bag, a damaged one, one without a finished test sample, or a bag whose truth
        isn't of one garment.
        """
        if any(one.suffix in BAG_SUFFIXES for one in (path, *path.glob("*"))):
            return _of_bag(path)
        dataset = open_dataset(path)
        samples = _of_sequences(dataset) if isinstance(dataset, GarmentSequences) else _of_poses(dataset)
        if not samples.count:
            raise RefuError(f"{path}: no test sample in it is finished yet")
        return samples


def _read(places: Sequence[tuple[SampleSet, int]], number: int) -> Sample:
    samples, row = places[number]
    return samples.read(row)


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
        raise RefuError(f"{msg}: refu simulate makes it; refu replay --report measures a recording without")
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


class SampleResult(NamedTuple):
    """What a method made of one sample."""

    figures: FrameMetrics
    unseen: float
    """The sample's distance to the training set in (θ, β, γ)."""
    posture: str | None
    ms: Mapping[str, float]
    """Wall time by component [ms]."""
    scales: NDArray[np.float64]
    """Number of vertices and sum of α, by ratio of the approximate to the accurate distance, shape (2, 11)."""


@dataclass(eq=False)
class MethodRun:
    """One method on the test samples of one garment, or of several."""

    method: str
    samples: list[SampleResult]
    """In the sets' order."""

    @cached_property
    def figures(self) -> Figures:
        return Figures.over([sample.figures for sample in self.samples])

    @cached_property
    def scales(self) -> NDArray[np.float64]:
        """`SampleResult.scales` of all samples together."""
        return np.asarray(sum(sample.scales for sample in self.samples))

    def values(self, name: str) -> NDArray[np.float64]:
        """A field of `FrameMetrics` for all samples."""
        return np.array([getattr(sample.figures, name) for sample in self.samples], np.float64)

    def median_ms(self, *components: str) -> float | None:
        """Median time of some components together [ms]; None if the method lacks one."""
        if not self.samples or not set(components) <= set(self.samples[0].ms):
            return None
        return float(np.median([sum(sample.ms[component] for component in components) for sample in self.samples]))

    def of_postures(self, postures: Sequence[str]) -> list[FrameMetrics]:
        return [sample.figures for sample in self.samples if sample.posture in postures]


def scales_by_ratio(output: MethodOutput) -> NDArray[np.float64]:
    """`SampleResult.scales`, of the vertices that both distances put inside the body ("collision-resolved")."""
    approx, accurate = output.approx.numpy(), output.accurate.numpy()
    inside = (approx < 0) & (accurate < 0)
    group, n = np.digitize(approx[inside] / accurate[inside], RATIO_EDGES) - 1, len(RATIO_EDGES) - 1
    return np.stack([np.bincount(group, weights, n) for weights in (None, output.scale.numpy()[inside])])


@dataclass(eq=False)
class Study:
    """All runs, and the methods that couldn't be run."""

    runs: dict[tuple[str, str], MethodRun] = field(default_factory=dict)
    """By (garment, method)."""
    missing: dict[tuple[str, str], Missing] = field(default_factory=dict)
    n_samples: dict[str, int] = field(default_factory=dict)

    def pooled(self, method: str) -> MethodRun:
        """The method on all garments; without samples if one is missing, as means would then be over other garments."""
        keys = [(garment, method) for garment in self.n_samples]
        whole = keys if all(key in self.runs for key in keys) else []
        return MethodRun(method, [sample for key in whole for sample in self.runs[key].samples])


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
    bases = [METHODS[name].base for name in methods]  # first, as Laplacian errors are measured against theirs
    prepared = garment, library, tuple(dict.fromkeys([*bases, *methods]))
    _, ready, missing = _prepared(*prepared)
    study.missing |= {(garment, one.method): one for one in missing}
    if not ready:
        return
    parts: dict[int, dict[str, list[SampleResult]]] = {}
    with tqdm(total=len(samples), desc=garment, unit="sample", disable=None if progress else True) as bar:
        make = run_function(partial(_run_samples, *prepared))
        for index, part in (engine or InProcess()).run(make, _Blocks(samples)):
            if isinstance(part, Lost) or part.keys() != ready.keys():
                why = part.reason if isinstance(part, Lost) else "a process hasn't the weights that this one has"
                raise RefuError(f"{garment}: samples {index * _BLOCK} and following are lost: {why}")
            parts[index] = part
            bar.update(len(next(iter(part.values()))))
    for name in ready:
        in_order = [sample for index in sorted(parts) for sample in parts[index][name]]  # whatever was done first
        study.runs[garment, name] = MethodRun(name, in_order)


@lru_cache(maxsize=1)
def _prepared(
    garment: str, library: Library, methods: tuple[str, ...]
) -> tuple[GarmentSetup, dict[str, Predictor], list[Missing]]:
    """What this process needs to run methods, and those that can't be run."""
    setup, ready, missing = GarmentSetup(garment, library), dict[str, Predictor](), []
    for name in methods:
        method = METHODS[name]
        try:
            ready[name] = Predictor(method, setup, library)
        except RefuError as error:
            missing.append(Missing(garment, name, str(error), method.train_command(garment)))
    return setup, ready, missing


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
    garment: str, library: Library, methods: tuple[str, ...], samples: list[Sample]
) -> dict[str, list[SampleResult]]:
    setup, predictors, _ = _prepared(garment, library, methods)
    faces = setup.template.faces.numpy()
    checker = CollisionChecker(setup.body.faces)
    metrics = {name: GarmentMetrics(faces) for name in predictors}
    done: dict[str, list[SampleResult]] = {name: [] for name in predictors}
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
            frame = metrics[name].add(output.vertices, found, truth=sample.vertices, resolved=colliding[base])
            done[name].append(SampleResult(frame, sample.unseen, sample.posture, output.ms, scales_by_ratio(output)))
    return done
