"""Methods on the test samples of a data set: every figure of every sample, kept for all tables."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._cache import code_hash
from refu_core._engine import Engine, InProcess, Lost
from refu_core._files import read_json, replacing
from refu_core.errors import RefuError
from refu_core.metrics import CollisionChecker, Figures, FrameMetrics, GarmentMetrics
from refu_lab.reproduction._load import Library
from refu_lab.reproduction._methods import METHODS, Method
from refu_lab.reproduction._predict import GarmentSetup, MethodOutput, Predictor, SampleScene
from refu_lab.reproduction._samples import Sample, SampleSet
from refu_lab.reproduction._tables import Missing

RATIO_EDGES: tuple[float, ...] = (0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 4.25, 4.75, float("inf"))
"""Groups of the ratio of approximate to accurate distance, as in the supplement's bar plot."""
_BLOCK = 8
"""Samples of a task: some seconds' work."""
_CODE = (
    *("refu_core/**/*.py", "refu_core/assets/*.npz", "refu_lab/baselines.py"),
    *("refu_lab/reproduction/_runs.py", "refu_lab/reproduction/_predict.py"),
)
"""Files that a run's figures depend on; those that only write tables aren't among them."""


@dataclass(eq=False)
class ScaleByRatio:
    """Predicted scales α, grouped by the ratio of the approximate to the accurate distance."""

    count: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(RATIO_EDGES) - 1, np.int64))
    """Vertices a group, shape (11,)."""
    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(RATIO_EDGES) - 1))
    """Sum of α a group, shape (11,)."""

    def join(self, other: ScaleByRatio) -> None:
        """Takes in another one."""
        self.count += other.count
        self.total += other.total

    def add(self, output: MethodOutput) -> None:
        """Takes in the vertices that both distances see inside the body (the supplement's "collision-resolved")."""
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
    ms: dict[str, list[float]] = field(default_factory=dict)
    """Wall time of each sample by component [ms]."""
    scales: ScaleByRatio = field(default_factory=ScaleByRatio)

    @cached_property
    def figures(self) -> Figures:
        """The figures over all samples."""
        return Figures.over(self.samples)

    def values(self, name: str) -> NDArray[np.float64]:
        """A field of `FrameMetrics`, of all samples."""
        return np.array([getattr(sample, name) for sample in self.samples], np.float64)

    def median_ms(self, *components: str) -> float | None:
        """Median time of some components together [ms]; None for one that the method hasn't."""
        if not self.samples or not set(components) <= set(self.ms):
            return None
        return float(np.median(np.sum([self.ms[component] for component in components], axis=0)))

    def join(self, other: MethodRun) -> None:
        """Takes in the samples that follow."""
        self.samples += other.samples
        self.unseen += other.unseen
        for component, ms in other.ms.items():
            self.ms.setdefault(component, []).extend(ms)
        self.scales.join(other.scales)

    def as_dict(self) -> dict[str, Any]:
        """The run, ready for JSON."""
        return {
            "garment": self.garment,
            "method": self.method,
            "samples": [asdict(sample) for sample in self.samples],
            "unseen": self.unseen,
            "ms": self.ms,
            "scales": {"count": self.scales.count.tolist(), "total": self.scales.total.tolist()},
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> MethodRun:
        """The run that `as_dict` gave."""
        scales = ScaleByRatio(np.array(data["scales"]["count"]), np.array(data["scales"]["total"]))
        samples = [FrameMetrics(**sample) for sample in data["samples"]]
        return cls(data["garment"], data["method"], samples, data["unseen"], data["ms"], scales)


@dataclass(eq=False)
class Study:
    """All runs, and what couldn't be run."""

    runs: dict[tuple[str, str], MethodRun] = field(default_factory=dict)
    """By (garment, method)."""
    missing: dict[tuple[str, str], Missing] = field(default_factory=dict)
    n_samples: dict[str, int] = field(default_factory=dict)
    """Test samples by garment."""

    def pooled(self, method: str) -> list[MethodRun]:
        """The method's runs of all garments; none where one is missing, as means would be of other garments."""
        runs = [self.runs.get((garment, method)) for garment in self.n_samples]
        return [run for run in runs if run is not None] if None not in runs else []


def run_methods(
    study: Study,
    samples: SampleSet,
    methods: Sequence[str],
    *,
    library: Library,
    cache_folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
    engine: Engine | None = None,
) -> None:
    """Runs methods on the test samples of one garment, into `study`.

    Args:
        study: What runs and reasons are added to.
        samples: The garment's test samples.
        methods: Names of methods; the base of each is run with it.
        library: Where trained networks are.
        cache_folder: Where runs are kept, and found again while samples, weights and code are the same.
        progress: Called with (samples done, samples in all).
        engine: Who runs them, a block of samples a task; None for this process. Figures don't depend on it, times do.

    Raises `RefuError` where blocks are lost with their processes, or those are out of reach.
    """
    garment = samples.garment
    study.n_samples[garment] = len(samples)
    setup = GarmentSetup.of(garment, collider=library.collider, fit=library.fit)
    ready: dict[str, Predictor] = {}
    files: dict[str, Path] = {}
    for method in _with_bases(methods):
        if (garment, method.name) in study.runs:
            continue
        if cache_folder is not None:
            files[method.name] = cache_folder / _cache_name(garment, method, samples.key, library)
            if (known := _read_cached(files[method.name])) is not None:
                study.runs[garment, method.name] = known
                continue
        try:
            ready[method.name] = Predictor(method, setup, library)
        except RefuError as error:
            command = method.train_command(garment)
            study.missing[garment, method.name] = Missing(garment, method.name, str(error), command)
    wanted = list(ready)
    if not wanted:
        return
    for name in wanted:  # a base that is known is still asked which vertices collide
        base = METHODS[name].base
        if base not in ready and (garment, base) not in study.missing:
            ready[base] = Predictor(METHODS[base], setup, library)
    bases_first = dict(sorted(ready.items(), key=lambda item: METHODS[item[0]].base != item[0]))
    runner = _Runner(garment, library, tuple(bases_first), (setup, bases_first))
    runs = _run_blocks(runner, samples, engine or InProcess(), progress)
    for name in wanted:
        study.runs[garment, name] = runs[name]
        if name in files:
            _write_cached(files[name], runs[name])


@dataclass
class _Runner:
    """Makes a process's function from samples to their runs."""

    garment: str
    library: Library
    methods: tuple[str, ...]
    """Bases first."""
    made: tuple[GarmentSetup, Mapping[str, Predictor]] | None = None
    """Of this process, where it has them already; another one makes its own."""

    def __call__(self) -> Callable[[list[Sample]], dict[str, MethodRun]]:
        if self.made is None:
            setup = GarmentSetup.of(self.garment, collider=self.library.collider, fit=self.library.fit)
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


def _run_blocks(
    runner: _Runner, samples: SampleSet, engine: Engine, progress: Callable[[int, int], None] | None
) -> dict[str, MethodRun]:
    """The runs, joined in the samples' order whoever was first."""
    parts: dict[int, dict[str, MethodRun]] = {}
    for index, part in engine.run(runner, _Blocks(samples)):
        if isinstance(part, Lost):
            msg = f"{runner.garment}: samples {index * _BLOCK} and following are lost: {part.reason}"
            raise RefuError(msg)
        parts[index] = part
        if progress is not None:
            progress(sum(len(next(iter(runs.values())).samples) for runs in parts.values()), len(samples))
    joined = {name: MethodRun(runner.garment, name) for name in runner.methods}
    for index in sorted(parts):
        for name, run in joined.items():
            run.join(parts[index][name])
    return joined


def _run_samples(
    setup: GarmentSetup, predictors: Mapping[str, Predictor], garment: str, samples: Sequence[Sample]
) -> dict[str, MethodRun]:
    faces = setup.template.faces.numpy()
    checker = CollisionChecker(setup.body.faces)
    metrics = {name: GarmentMetrics(faces) for name in predictors}
    runs = {name: MethodRun(garment, name) for name in predictors}
    for sample in samples:
        scene = SampleScene.of(setup, sample.pose, sample.betas, sample.style)
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
            run.scales.add(output)
            for component, ms in output.ms.items():
                run.ms.setdefault(component, []).append(ms)
    return runs


def _with_bases(names: Sequence[str]) -> list[Method]:
    """The methods and those that their Laplacian error is measured against, bases first, each once."""
    bases = dict.fromkeys(METHODS[name].base for name in names)
    return [METHODS[name] for name in dict.fromkeys([*bases, *names])]


def _cache_name(garment: str, method: Method, samples_key: str, library: Library) -> str:
    told = json.dumps(
        [asdict(method), samples_key, library.key(method, garment), library.collider, library.body, code_hash(*_CODE)],
        sort_keys=True,
    )
    return f"{garment}-{method.name}-{hashlib.sha256(told.encode()).hexdigest()[:16]}.json"


def _read_cached(file: Path) -> MethodRun | None:
    try:
        return MethodRun.from_dict(read_json(file, error=RefuError, wanted="a run"))
    except (RefuError, ValueError, KeyError, TypeError):
        return None


def _write_cached(file: Path, run: MethodRun) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as part:
        part.write(json.dumps(run.as_dict()).encode())
