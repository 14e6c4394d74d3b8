"""Makes the tables over test samples from the runs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from refu_core.metrics import Figures
from refu_core.simulation import POSTURES
from refu_lab.reproduction._methods import RUN_TIME_SDF, SDFS, SEQUENCE_SHAPES
from refu_lab.reproduction._runs import RATIO_EDGES, MethodRun, Study
from refu_lab.reproduction._tables import ALL, MAIN_METRICS, Missing, ResultTable, weighted

ENERGY_ZOOM = 2.5e-3
"""Upper end of the paper's zoomed histogram [m²]."""
UNSEEN_GROUPS = 5
"""Number of groups of equally many samples, by distance to the training set."""

Values = Mapping[str, float | None]


@dataclass(frozen=True)
class SampleTable:
    methods: tuple[str, ...]
    metrics: tuple[str, ...] = MAIN_METRICS
    """Metrics that a method without a run has, too, as None."""
    values: Callable[[MethodRun], Values] | None = None
    """Gives a run's values by metric; by default those are the fields of `Figures`."""
    is_summed: bool = True
    """Whether there are rows over all garments together."""

    def of(self, run: MethodRun | None) -> Values:
        if run is None:
            return dict.fromkeys(self.metrics)
        return self.values(run) if self.values else {metric: getattr(run.figures, metric) for metric in self.metrics}


def sample_table(study: Study, name: str) -> ResultTable:
    """A table of `SAMPLE_TABLES`, garment by garment and, if there are several, over all of them."""
    spec, table = SAMPLE_TABLES[name], ResultTable.of(name)
    for garment, method in itertools.product(study.n_samples, spec.methods):
        table.add(garment, method, spec.of(study.runs.get((garment, method))))
    if spec.is_summed:
        _sum_up(study, table, spec.methods, spec.metrics)
    if name == "comparison":
        _add_trends(table)
    table.missing = _missing_of(study, spec.methods)
    if name == "sequence":
        table.missing += _missing_sets(study)
    return table


def _missing_of(study: Study, methods: Iterable[str]) -> list[Missing]:
    """Those of a table's methods that couldn't be run."""
    return [missing for missing in study.missing.values() if missing.method in set(methods)]


def _missing_sets(study: Study) -> Iterator[Missing]:
    """The methods for which no set of sequences was given."""
    for garment, shapes in itertools.product(study.n_samples, SEQUENCE_SHAPES):
        command = f"refu simulate {garment} --sequences --shapes {shapes} --count N --output DIR"
        for method in (f"mlp-{shapes}", f"mlp-{shapes}-refu-approx"):
            if (garment, method) not in study.runs and (garment, method) not in study.missing:
                yield Missing(garment, method, f"no set of {shapes} shapes was given", command)


def _missing_postures(study: Study) -> Iterator[Missing]:
    """The node's method, for each garment none of whose samples is in a posture."""
    method = POSTURE_METHODS[-1]
    for garment in study.n_samples:
        run = study.runs.get((garment, method))
        if run is not None and not any(sample.posture for sample in run.samples):
            command = f"refu simulate {garment} --postures 1 --count N --output DIR"
            yield Missing(garment, method, "none of its test samples is in an everyday posture", command)


def posture_table(study: Study) -> ResultTable:
    """The node in each everyday posture, garment by garment and over all of them."""
    table = ResultTable.of("postures")
    table.missing = [*_missing_of(study, POSTURE_METHODS), *_missing_postures(study)]
    found = {garment: [study.runs.get((garment, name)) for name in POSTURE_METHODS] for garment in study.n_samples}
    if len(found) > 1:
        found[ALL] = [study.pooled(name) for name in POSTURE_METHODS]
    for garment, (before, after) in found.items():
        if before is None or after is None:
            continue
        known = {sample.posture for sample in after.samples}
        postures = [posture for posture in POSTURES if posture in known]
        whole = Figures.over(after.of_postures(postures)).mpve_mm if postures else None
        if not whole:
            continue
        groups = {posture: [posture] for posture in postures} | {"all of them": postures}
        for title, group in groups.items():
            figures = Figures.over(after.of_postures(group))
            values = {
                "n_samples": float(figures.n_frames),
                "network_mpve_mm": Figures.over(before.of_postures(group)).mpve_mm,
                "mpve_mm": figures.mpve_mm,
                "share_of_mean": None if figures.mpve_mm is None else figures.mpve_mm / whole,
                "cfmp_percent": figures.cfmp_percent,
            }
            table.add(garment, title, values)
    return table


def time_table(study: Study) -> ResultTable:
    """The supplement's run times, by component and garment."""
    table = ResultTable.of("time", labels={name: label for name, (label, *_) in _COMPONENTS.items()})
    for garment, (name, (_, method, *parts)) in itertools.product(study.n_samples, _COMPONENTS.items()):
        run = study.runs.get((garment, method))
        table.add(garment, name, {"ms": None if run is None else run.median_ms(*parts)})
    _sum_up(study, table, tuple(_COMPONENTS), ("ms",))
    table.missing = _missing_of(study, TIMED_METHODS)
    return table


def _sum_up(study: Study, table: ResultTable, methods: Sequence[str], metrics: Sequence[str]) -> None:
    """Adds the means over several garments, weighted by their numbers of samples."""
    for method in methods if len(study.n_samples) > 1 else ():
        values = {m: weighted((table.value(g, method, m), n) for g, n in study.n_samples.items()) for m in metrics}
        table.add(ALL, method, values)


def _add_trends(table: ResultTable) -> None:
    """Adds the changes against the backbone alone [%], for all other methods but the skinned template."""
    for row in list(table.rows):
        base = table.value(row.garment, "tailornet", row.metric)
        if row.method not in ("skinned", "tailornet"):
            change = None if row.value is None or not base else 100.0 * (row.value - base) / base
            table.add(row.garment, row.method, {f"{row.metric}_trend": change})


def _alpha_values(run: MethodRun) -> Values:
    """The main figures and, for ReFU, its mean α by how wrong its distance is."""
    values = {metric: getattr(run.figures, metric) for metric in MAIN_METRICS}
    groups = zip(itertools.pairwise(RATIO_EDGES), *run.scales, strict=True)
    for (low, high), count, total in groups if run.method == "refu-approx" else ():
        if count:
            values[f"mean α at a ratio of {low:g} to {high:g}"] = float(total / count)
    return values


def _energy_values(run: MethodRun) -> Values:
    energy = run.values("energy")
    return {
        "mean_energy": float(energy.mean()),
        "median_energy": float(np.median(energy)),
        "zero_energy_percent": 100.0 * float((energy == 0).mean()),
        "low_energy_percent": 100.0 * float((energy < ENERGY_ZOOM).mean()),
    }


def _unseen_values(run: MethodRun) -> Values:
    return {f"error [mm] at {d.min():.2f} to {d.max():.2f}": float(error.mean()) for d, error in unseen_groups(run)}


def unseen_groups(run: MethodRun) -> list[tuple[np.ndarray, np.ndarray]]:
    """(distances, collision errors [mm]) of groups of equally many samples by distance; none if one is unknown."""
    distance = np.array([sample.unseen for sample in run.samples])
    if not len(distance) or not np.isfinite(distance).all():
        return []
    error = run.values("collision_error_mm")
    groups = np.array_split(np.argsort(distance, kind="stable"), min(UNSEEN_GROUPS, len(distance)))
    return [(distance[rows], error[rows]) for rows in groups]


POSTURE_METHODS = ("tailornet", "node-hybrid")
_OPTIMISATIONS = (
    *(f"optimisation-{sdf}{margin}" for margin in ("", "-margin") for sdf in SDFS),
    "optimisation-on-hybrid",
    "optimisation-kept-on-hybrid",
)

SAMPLE_TABLES: Mapping[str, SampleTable] = {
    "parts": SampleTable(
        (
            *("skinned", "tailornet", "naive-approx"),
            *(f"refu-hybrid{kind}" for kind in ("-bare", "-unblended", "")),
            *("node-hybrid", "node-accurate", "node-skinned"),
        )
    ),
    "comparison": SampleTable(
        (
            *("skinned", "tailornet", "naive-approx", "naive-accurate", *_OPTIMISATIONS),
            *("collision-loss-approx", "collision-loss-accurate", *(f"refu-{mode}" for mode in RUN_TIME_SDF)),
            *("node-skinned", *(f"node-{mode}" for mode in RUN_TIME_SDF)),
        )
    ),
    "ablation": SampleTable(
        (
            "tailornet",
            *(f"fixed-bare-{sdf}" for sdf in SDFS),
            *(f"bare-{mode}" for mode in RUN_TIME_SDF),
            *(f"fixed-{sdf}{kind}" for kind in ("-bare", "-unblended", "") for sdf in SDFS),
            *(f"refu-{mode}{kind}" for kind in ("-bare", "-unblended", "") for mode in RUN_TIME_SDF),
        ),
        (*MAIN_METRICS, "avg_vf", "avg_ee"),
    ),
    "alpha": SampleTable(("tailornet", "alt1-approx", "alt2-approx", "refu-approx"), values=_alpha_values),
    "gcnn": SampleTable(("gcnn", *(f"gcnn-refu-{mode}" for mode in RUN_TIME_SDF))),
    "laplacian": SampleTable(
        (
            *("tailornet", "skinned-naive", "skinned-optimisation", *_OPTIMISATIONS),
            *(f"refu-{mode}" for mode in RUN_TIME_SDF),
            "node-hybrid",
        ),
        ("laplacian_mm", "mpve_mm"),
    ),
    "unseen": SampleTable(
        ("tailornet", "collision-loss-approx", "collision-loss-accurate", "refu-approx", "refu-hybrid"),
        metrics=(),
        values=_unseen_values,
        is_summed=False,
    ),
    "energy": SampleTable(
        ("skinned", "tailornet", *(f"refu-{mode}" for mode in RUN_TIME_SDF)),
        metrics=("mean_energy", "median_energy", "zero_energy_percent", "low_energy_percent"),
        values=_energy_values,
        is_summed=False,
    ),
    "sequence": SampleTable(("mlp-5", "mlp-5-refu-approx", "mlp-17", "mlp-17-refu-approx"), is_summed=False),
}
"""The tables over test samples, without those of postures and times."""

_COMPONENTS: Mapping[str, tuple[str, ...]] = {
    "sdf-approx": ("approximate SDF", "refu-hybrid", "sdf"),
    "sdf-accurate": ("accurate SDF", "refu-accurate", "sdf"),
    "refu": ("ReFU", "refu-hybrid", "refu"),
    "backbone": ("backbone alone (TailorNet)", "tailornet", "backbone"),
    "node": ("the node, hybrid: a whole frame", "node-hybrid", "node"),
    "node, backbone": ("of this, the backbone", "node-hybrid", "node backbone"),
    "node, collisions": ("of this, distance and ReFU", "node-hybrid", "node sdf", "node refu"),
    "optimisation": ("optimisation post-process, approximate", "optimisation-approx", "post-process"),
    "optimisation, accurate": ("optimisation post-process, accurate", "optimisation-accurate", "post-process"),
    "optimisation, kept": (
        "optimisation post-process, approximate, ReFU's margin kept everywhere",
        *("optimisation-kept-on-hybrid", "post-process"),
    ),
    "skinned backbone": ("skinned template", "skinned", "backbone"),
    "skinned, naive": ("skinned, naive post-process, accurate", "skinned-naive", "post-process"),
    "skinned, optimisation": (
        "skinned, optimisation post-process, accurate",
        *("skinned-optimisation", "post-process"),
    ),
}
"""For each component its label, the method that has it, and the parts of that method's time."""
TIMED_METHODS = tuple(dict.fromkeys(method for _, method, *_ in _COMPONENTS.values()))
