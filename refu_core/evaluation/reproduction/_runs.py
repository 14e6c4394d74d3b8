"""Methods on the test samples of a data set: every figure of every sample, kept for all tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.body import load_body
from refu_core.errors import RefuError
from refu_core.evaluation.collisions import CollisionChecker
from refu_core.evaluation.metrics import Figures, FrameMetrics, GarmentMetrics
from refu_core.evaluation.reproduction._cache import Cache
from refu_core.evaluation.reproduction._load import Library
from refu_core.evaluation.reproduction._methods import METHODS, Method
from refu_core.evaluation.reproduction._predict import Outcome, Predictor, Scene, Wardrobe
from refu_core.evaluation.reproduction._samples import Samples
from refu_core.evaluation.reproduction._tables import Missing
from refu_core.garments import load_garment

RATIO_EDGES: tuple[float, ...] = (0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.25, 3.75, 4.25, 4.75, float("inf"))
"""Groups of the ratio of approximate to accurate distance, as in the supplement's bar plot."""


@dataclass(eq=False)
class ScaleByRatio:
    """Predicted scales α, grouped by the ratio of the approximate to the accurate distance."""

    count: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(RATIO_EDGES) - 1, np.int64))
    """Vertices a group, shape (11,)."""
    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(RATIO_EDGES) - 1))
    """Sum of α a group, shape (11,)."""

    def add(self, outcome: Outcome) -> None:
        """Takes in the vertices that both distances see inside the body (the supplement's "collision-resolved")."""
        approx, accurate = outcome.approx.numpy(), outcome.accurate.numpy()
        inside = (approx < 0) & (accurate < 0)
        group = np.digitize(approx[inside] / accurate[inside], RATIO_EDGES) - 1
        np.add.at(self.count, group, 1)
        np.add.at(self.total, group, outcome.scale.numpy()[inside])


@dataclass(eq=False)
class Run:
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

    @property
    def figures(self) -> Figures:
        """The figures over all samples."""
        return Figures.over(self.samples)

    def median_ms(self, *components: str) -> float | None:
        """Median time of some components together [ms]; None for one that the method hasn't."""
        if not self.samples or not set(components) <= set(self.ms):
            return None
        return float(np.median(np.sum([self.ms[component] for component in components], axis=0)))

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
    def from_dict(cls, data: Mapping[str, Any]) -> Run:
        """The run that `as_dict` gave."""
        scales = ScaleByRatio(np.array(data["scales"]["count"]), np.array(data["scales"]["total"]))
        samples = [FrameMetrics(**sample) for sample in data["samples"]]
        return cls(data["garment"], data["method"], samples, data["unseen"], data["ms"], scales)


@dataclass(eq=False)
class Study:
    """All runs, and what couldn't be run."""

    runs: dict[tuple[str, str], Run] = field(default_factory=dict)
    """By (garment, method)."""
    missing: dict[tuple[str, str], Missing] = field(default_factory=dict)
    n_samples: dict[str, int] = field(default_factory=dict)
    """Test samples by garment."""

    @property
    def garments(self) -> list[str]:
        """The garments there is data of."""
        return list(self.n_samples)

    def figure(self, garment: str, method: str, metric: str) -> float | None:
        """A field of `Figures`; None where it wasn't measured."""
        run = self.runs.get((garment, method))
        return None if run is None else getattr(run.figures, metric)

    def paired(self, garment: str | None, first: str, second: str, metric: str) -> NDArray[np.float64]:
        """First method's figure less the second one's, of each sample of a garment (of all for None), shape (N,).

        Samples of which one has no figure are left out, and garments that one wasn't run on.
        """
        differences = []
        for name in self.garments if garment is None else [garment]:
            runs = self.runs.get((name, first)), self.runs.get((name, second))
            if runs[0] is None or runs[1] is None:
                continue
            for one, other in zip(runs[0].samples, runs[1].samples, strict=True):
                a, b = (getattr(Figures.over([sample]), metric) for sample in (one, other))
                if a is not None and b is not None:
                    differences.append(a - b)
        return np.array(differences, np.float64)


def run_methods(
    study: Study,
    samples: Samples,
    methods: Sequence[str],
    *,
    library: Library,
    cache: Cache | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Runs methods on the test samples of one garment, into `study`.

    Args:
        study: What runs and reasons are added to.
        samples: The garment's test samples.
        methods: Names of methods; the base of each is run with it.
        library: Where trained networks are.
        cache: Where runs are kept, and found again.
        progress: Called with (samples done, samples in all).
    """
    garment = samples.garment
    study.n_samples[garment] = len(samples)
    template = load_garment(garment)
    wardrobe = Wardrobe.of(template, load_body(template.body))
    ready: dict[str, Predictor] = {}
    keys: dict[str, str] = {}
    for method in _with_bases(methods):
        if (garment, method.name) in study.runs:
            continue
        keys[method.name] = f"{samples.key} {library.key(method, garment)}"
        known = cache.find(garment, method, keys[method.name]) if cache is not None else None
        if known is not None:
            study.runs[garment, method.name] = Run.from_dict(known)
            continue
        try:
            ready[method.name] = Predictor(method, wardrobe, library)
        except RefuError as error:
            study.missing[garment, method.name] = Missing(
                garment, method.name, str(error), method.train_command(garment)
            )
    wanted = list(ready)
    if not wanted:
        return
    for name in list(ready):  # a base that is known is still asked which vertices collide
        base = METHODS[name].base
        if base not in ready and (garment, base) not in study.missing:
            ready[base] = Predictor(METHODS[base], wardrobe, library)
    order = sorted(ready, key=lambda name: METHODS[name].base != name)
    runs = _run_samples(garment, {name: ready[name] for name in order}, wardrobe, samples, progress)
    for name in wanted:
        study.runs[garment, name] = runs[name]
        if cache is not None:
            cache.keep(garment, METHODS[name], keys[name], runs[name].as_dict())


def _run_samples(
    garment: str,
    predictors: Mapping[str, Predictor],
    wardrobe: Wardrobe,
    samples: Samples,
    progress: Callable[[int, int], None] | None,
) -> dict[str, Run]:
    faces = wardrobe.template.faces.numpy()
    checker = CollisionChecker(wardrobe.body.faces)
    metrics = {name: GarmentMetrics(faces) for name in predictors}
    runs = {name: Run(garment, name) for name in predictors}
    for number in range(len(samples)):
        sample = samples.read(number)
        scene = Scene.of(wardrobe, sample.pose, sample.betas, sample.style)
        checker.update(scene.vertices)
        colliding = dict.fromkeys(METHODS, np.zeros(wardrobe.template.n_vertices, np.bool_))
        for name, predict in predictors.items():
            outcome = predict(scene)
            found = checker.check(outcome.vertices, faces)
            if METHODS[name].base == name:
                colliding[name] = found.inside
            run = runs[name]
            run.samples.append(
                metrics[name].add(
                    outcome.vertices, found, truth=sample.vertices, resolved=colliding[METHODS[name].base]
                )
            )
            run.unseen.append(sample.unseen)
            run.scales.add(outcome)
            for component, ms in outcome.ms.items():
                run.ms.setdefault(component, []).append(ms)
        if progress is not None:
            progress(number + 1, len(samples))
    return runs


def _with_bases(names: Sequence[str]) -> list[Method]:
    """The methods and those that their Laplacian error is measured against, bases first, each once."""
    bases = dict.fromkeys(METHODS[name].base for name in names)
    return [METHODS[name] for name in dict.fromkeys([*bases, *names])]
