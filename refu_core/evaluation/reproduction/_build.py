"""The tables over test samples, made of the runs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from refu_core.evaluation.metrics import Figures
from refu_core.evaluation.reproduction._claims import Gap, Order, findings
from refu_core.evaluation.reproduction._methods import METHODS, SAMPLE_TABLES, SEQUENCE_SHAPES
from refu_core.evaluation.reproduction._paper import OPTIMISATION_MS
from refu_core.evaluation.reproduction._runs import RATIO_EDGES, Run, Study
from refu_core.evaluation.reproduction._tables import ALL, Missing, Row, Table, weighted

LABELS: Mapping[str, str] = {name: method.label for name, method in METHODS.items()}
"""The methods' names for people."""

ENERGY_ZOOM = 2.5e-3
"""Upper end of the paper's zoomed histogram [m²]."""
FEWEST_PAIRED = 10
"""Samples that say how sure a difference is."""
UNSEEN_GROUPS = 5
"""Groups of equally many samples, by distance to the training set."""

_MAIN = ("mpve_mm", "vfcp_percent", "cfmp_percent")
_POST = ("naive", "optimisation", "collision-loss")

_COMPARISON_ORDERS: tuple[Order, ...] = (
    *(Order("cfmp_percent", f"refu-{sdf}", f"{other}-{sdf}") for sdf in ("approx", "accurate") for other in _POST),
    *(Order("mpve_mm", f"refu-{sdf}", f"{other}-{sdf}") for sdf in ("approx", "accurate") for other in _POST),
    Order("cfmp_percent", "refu-accurate", "refu-hybrid"),
    Order("cfmp_percent", "refu-hybrid", "refu-approx"),
    Order("vfcp_percent", "refu-accurate", "refu-hybrid"),
    Order("vfcp_percent", "refu-hybrid", "refu-approx"),
    Order("mpve_mm", "refu-hybrid", "tailornet"),
    Order("cfmp_percent", "refu-hybrid", "optimisation-approx"),
    Order("mpve_mm", "refu-hybrid", "optimisation-approx"),
    Order("cfmp_percent", "refu-hybrid", "optimisation-on-hybrid"),
    Order("mpve_mm", "refu-hybrid", "optimisation-on-hybrid"),
    Order("cfmp_percent", "tailornet", "naive-approx"),
)
_ABLATION_ORDERS: tuple[Order, ...] = (
    *(Order(metric, "refu-approx", "fixed-approx") for metric in (*_MAIN, "avg_vf", "avg_ee")),
    *(Order(metric, "refu-accurate", "fixed-accurate") for metric in ("mpve_mm", "cfmp_percent", "avg_vf", "avg_ee")),
    *(
        Order(metric, f"bare-{sdf}", f"fixed-bare-{sdf}")
        for sdf in ("approx", "accurate")
        for metric in (*_MAIN, "avg_vf", "avg_ee")
    ),
    *(Order("cfmp_percent", f"refu-{mode}", f"bare-{mode}") for mode in ("approx", "accurate", "hybrid")),
)
ORDERS: Mapping[str, tuple[Order, ...]] = {
    "comparison": _COMPARISON_ORDERS,
    "ablation": _ABLATION_ORDERS,
    "alpha": tuple(Order(metric, "refu-approx", f"alt{n}-approx") for metric in _MAIN for n in (1, 2)),
    "gcnn": (
        *(Order(m, f"gcnn-refu-{mode}", "gcnn") for m in _MAIN for mode in ("approx", "accurate", "hybrid")),
        Order("cfmp_percent", "gcnn-refu-accurate", "gcnn-refu-hybrid"),
        Order("cfmp_percent", "gcnn-refu-hybrid", "gcnn-refu-approx"),
    ),
    "laplacian": (
        *(Order("laplacian_mm", f"refu-{sdf}", f"optimisation-{sdf}") for sdf in ("approx", "accurate")),
        Order("laplacian_mm", "refu-hybrid", "optimisation-approx"),
        Order("laplacian_mm", "refu-hybrid", "optimisation-on-hybrid"),
    ),
    "energy": (
        Order("mean_energy", "refu-hybrid", "tailornet"),
        Order("low_energy_percent", "refu-hybrid", "tailornet"),
    ),
    "sequence": tuple(Order(m, f"mlp-{n}-refu-approx", f"mlp-{n}") for n in SEQUENCE_SHAPES for m in _MAIN),
}
"""What the paper's tables say, as orders of methods."""


def figures_table(study: Study, name: str, metrics: Sequence[str], *, title: str, about: str) -> Table:
    """A table of fields of `Figures`, garment by garment and over all garments weighted by test count."""
    table = Table(name, title, about)
    for garment in study.garments:
        for method in SAMPLE_TABLES[name]:
            table.rows += [
                Row.of(name, garment, method, metric, study.figure(garment, method, metric)) for metric in metrics
            ]
    if len(study.garments) > 1:
        table.rows += _over_all(study, table, metrics)
    return _finished(study, table)


def comparison_table(study: Study) -> Table:
    """Tab. "comparison": every way to handle collisions, and its change against the backbone alone."""
    table = figures_table(
        study,
        "comparison",
        _MAIN,
        title="Comparison: ways to handle collisions",
        about="Test samples of each garment's set, each way of collision handling with the approximate and the "
        'accurate signed distance of the body, as in the paper\'s Table 2. The rows "the node" are what `garment_node` '
        "and `refu replay` publish: ReFU and a second look at what it moved.",
    )
    groups = [*study.garments, *([ALL] if len(study.garments) > 1 else [])]
    for garment in groups:
        base = {metric: table.value(garment, "tailornet", metric) for metric in _MAIN}
        for method in SAMPLE_TABLES["comparison"][2:]:
            for metric in _MAIN:
                value, start = table.value(garment, method, metric), base[metric]
                change = None if value is None or not start else 100.0 * (value - start) / start
                table.rows.append(Row.of("comparison", garment, method, f"{metric}_trend", change))
    return table


def ablation_table(study: Study) -> Table:
    """Tab. "ablation": fixed against predicted scale, with and without the margin."""
    return figures_table(
        study,
        "ablation",
        (*_MAIN, "avg_vf", "avg_ee"),
        title="Ablation: predicted scale, margin, blending",
        about="α fixed at 1 against α predicted, each trained so. Ours has two things that the paper's layer lacks: a "
        "margin (a vertex is pushed to ε from the skin instead of onto it) and blending (a push takes its "
        'neighbourhood along). The rows "not blended" and "ε = 0" leave them out at run time, without training anew; '
        "with neither, it is exactly the paper's layer, which is also shown trained that way.\n\n"
        "Where a fixed scale is as good as a predicted one: the paper's α has two things to do, to make up for a "
        "distance that is off by a quarter, and to carry vertices so far beyond the skin that the edges between them "
        "clear it, too. Here the distance is right (table sdf; the share of vertices is in the table alpha), and the "
        "margin and the blending clear the edges. The rows trained as the paper's layer have neither: there, what α "
        "is worth shows in the contacts that are left (Avg. VF, Avg. EE).",
    )


def alpha_table(study: Study) -> Table:
    """Supplement, Tab. "alpha_ablation", and the groups of its Fig. "scale_analysis"."""
    table = figures_table(
        study,
        "alpha",
        _MAIN,
        title="Networks that predict the scale α",
        about="Alt. 1: one latent vector for all vertices, as many weights. Alt. 2: from the vertex's distance alone. "
        "ReFU: a latent vector for each vertex. All with the approximate distance. How little they differ here has "
        "the reasons that the ablation gives for a fixed scale: little is left for α to do.",
    )
    for garment in study.garments:
        for method in ("refu-approx", "refu-hybrid"):
            run = study.runs.get((garment, method))
            table.rows += _scale_rows(run)
            table.findings += _ratio_finding(run)
    return table


def gcnn_table(study: Study) -> Table:
    """Supplement, Tab. "gcnn"."""
    return figures_table(
        study,
        "gcnn",
        _MAIN,
        title="Graph convolution as the backbone, trained from scratch",
        about="The same graph convolution network with and without ReFU in it, from scratch. The paper doesn't say for "
        "which garment its figures are; they stand beside each of ours.",
    )


def laplacian_table(study: Study) -> Table:
    """Supplement, Tab. "local_lap"."""
    return figures_table(
        study,
        "laplacian",
        ("laplacian_mm", "mpve_mm"),
        title="Local Laplacian error where collisions were resolved",
        about="Mean length of the difference between a vertex's uniform Laplacian on its 1-ring and the true one, over "
        "the vertices that are inside the body in what the backbone alone predicts: the same vertices for every method "
        "of that backbone.",
    )


def energy_table(study: Study) -> Table:
    """Supplement, Fig. "hist" and "zoom_in_hist"."""
    table = Table(
        "energy",
        "Penetration energy",
        "E = Σ max(0, -f)² over a garment's vertices, with the exact distance f. The paper takes its energy from "
        "another work without giving the formula; this one is ours, so only the shape of the histograms compares.",
    )
    for garment in study.garments:
        for method in SAMPLE_TABLES["energy"]:
            run = study.runs.get((garment, method))
            energy = None if run is None else np.array([sample.energy for sample in run.samples])
            for metric, of in _ENERGY.items():
                value = None if energy is None or not len(energy) else of(energy)
                table.rows.append(Row.of("energy", garment, method, metric, value))
    return _finished(study, table)


_ENERGY: Mapping[str, Callable[[np.ndarray], float]] = {
    "mean_energy": lambda e: float(e.mean()),
    "median_energy": lambda e: float(np.median(e)),
    "zero_energy_percent": lambda e: 100.0 * float((e == 0).mean()),
    "low_energy_percent": lambda e: 100.0 * float((e < ENERGY_ZOOM).mean()),
}


def unseen_table(study: Study) -> Table:
    """Supplement, Fig. "unseen": collision error against the distance to the training set."""
    table = Table(
        "unseen",
        "Collision error far from the training set",
        "Mean collision error Σ max(0, -f) [mm] of test samples in groups of equal size, by their distance to the "
        "nearest training sample in (θ, β, γ). The paper prints no figures, only a plot.",
    )
    for garment in study.garments:
        for method in SAMPLE_TABLES["unseen"]:
            for label, error in unseen_groups(study.runs.get((garment, method))):
                table.rows.append(Row.of("unseen", garment, method, f"error [mm] at {label}", error))
    return _finished(study, table)


def unseen_groups(run: Run | None) -> list[tuple[str, float]]:
    """(range of distances, mean collision error [mm]) of each group of a run's samples; none for unknown distances."""
    if run is None or not run.samples or not np.isfinite(run.unseen).all():
        return []
    distance = np.array(run.unseen)
    error = np.array([sample.collision_error_mm for sample in run.samples])
    groups = np.array_split(np.argsort(distance, kind="stable"), min(UNSEEN_GROUPS, len(distance)))
    return [(f"{distance[g].min():.2f} to {distance[g].max():.2f}", float(error[g].mean())) for g in groups]


def time_table(study: Study) -> Table:
    """Supplement, Tab. "time": per component and garment."""
    table = Table(
        "time",
        "Run time by component",
        "Median wall time of one garment in one frame on one thread of the CPU that this ran on; of the signed "
        "distances, taking over the pose and asking for all vertices. The paper's are of a GPU, but for its accurate "
        "distance and its optimisation. The optimisation includes its distances.",
    )
    for garment in study.garments:
        for component, (method, *parts) in _COMPONENTS.items():
            run = study.runs.get((garment, method))
            table.rows.append(Row.of("time", garment, component, "ms", None if run is None else run.median_ms(*parts)))
    if len(study.garments) > 1:
        table.rows += _over_all(study, table, ("ms",), methods=tuple(_COMPONENTS))
    table.rows += [
        Row.of("time", row.garment, row.method, "times", row.value / own)
        for row in table.rows
        if row.value is not None and (own := table.value(row.garment, "node, collisions", "ms"))
    ]
    for garment in dict.fromkeys(row.garment for row in table.rows):
        slow = table.value(garment, "optimisation", "ms")
        layer = [table.value(garment, component, "ms") for component in ("sdf-approx", "refu")]
        node = [table.value(garment, "node, collisions", "ms")]
        for what, fast in (("ReFU with its distance", layer), ("what the node does about collisions", node)):
            known = [ms for ms in fast if ms is not None]
            if slow is not None and len(known) == len(fast):
                low, high = OPTIMISATION_MS
                table.findings.append(
                    f"{garment}: {what} takes {sum(known):.2f} ms, the optimisation on the same inputs {slow:.0f} ms, "
                    f"{slow / sum(known):.0f} times as long (the paper: 2.00 ms against {low:.0f} to {high:.0f} ms)."
                )
        asked = table.value(garment, "sdf-approx", "ms")
        if slow is not None and asked:
            limit = "so nothing that asks it could be 100 times as fast on this core: the optimisation asks it, too"
            table.findings.append(
                f"{garment}: taking over the body and asking the approximate distance of every vertex alone takes "
                f"1/{slow / asked:.0f} of the optimisation's time" + (f", {limit}." if slow / asked < 100 else ".")
            )
    return _finished(study, table)


_COMPONENTS: Mapping[str, tuple[str, ...]] = {
    "sdf-approx": ("refu-hybrid", "sdf"),
    "sdf-accurate": ("refu-accurate", "sdf"),
    "refu": ("refu-hybrid", "refu"),
    "backbone": ("tailornet", "backbone"),
    "node": ("node-hybrid", "node"),
    "node, backbone": ("node-hybrid", "node backbone"),
    "node, collisions": ("node-hybrid", "node sdf", "node refu"),
    "optimisation": ("optimisation-approx", "post-process"),
    "optimisation, accurate": ("optimisation-accurate", "post-process"),
    "optimisation, kept": ("optimisation-kept-on-hybrid", "post-process"),
    "skinned backbone": ("skinned", "backbone"),
    "skinned, naive": ("skinned-naive", "post-process"),
    "skinned, optimisation": ("skinned-optimisation", "post-process"),
}
"""Component: (method, parts of its time)."""
COMPONENT_LABELS: Mapping[str, str] = {
    "sdf-approx": "approximate SDF",
    "sdf-neural": "the paper's SDF network, its size",
    "sdf-accurate": "accurate SDF",
    "refu": "ReFU",
    "node": "the node, hybrid: a whole frame",
    "node, backbone": "of this, the backbone",
    "node, collisions": "of this, distance and ReFU",
    "optimisation": "optimisation post-process, approximate",
    "optimisation, accurate": "optimisation post-process, accurate",
    "optimisation, kept": "optimisation post-process, approximate, ReFU's margin kept everywhere",
}


def sequence_table(studies: Mapping[int, Study]) -> Table:
    """Supplement, Tab. "vto": the perceptron on continuous motion, by the number of body shapes of the set."""
    table = Table(
        "sequence",
        "Continuous motion with a perceptron",
        "Every frame of test sequences with motions of their own: simulated with dynamics, where the networks see the "
        "pose of that frame alone. The paper's figures are of another data set (VTO).",
    )
    garments = dict.fromkeys(garment for study in studies.values() for garment in study.garments)
    for garment in garments:
        for shapes in SEQUENCE_SHAPES:
            study = studies.get(shapes, Study())
            methods = (f"mlp-{shapes}", f"mlp-{shapes}-refu-approx")
            if garment not in study.n_samples:
                command = f"refu simulate {garment} --sequences --shapes {shapes} --count N --output DIR"
                table.missing += [Missing(garment, m, f"no set of {shapes} shapes was given", command) for m in methods]
            table.rows += [
                Row.of("sequence", garment, method, m, study.figure(garment, method, m))
                for method in methods
                for m in _MAIN
            ]
    table.missing += [missing for study in studies.values() for missing in study.missing.values()]
    table.findings = findings(table, ORDERS["sequence"], LABELS)
    return table


def _over_all(study: Study, table: Table, metrics: Iterable[str], *, methods: Sequence[str] | None = None) -> list[Row]:
    return [
        Row.of(
            table.name,
            ALL,
            method,
            metric,
            weighted((table.value(g, method, metric), n) for g, n in study.n_samples.items()),
        )
        for method in methods or SAMPLE_TABLES[table.name]
        for metric in metrics
    ]


def _scale_rows(run: Run | None) -> list[Row]:
    if run is None:
        return []
    edges = itertools.pairwise(RATIO_EDGES)
    return [
        Row.of("alpha", run.garment, run.method, f"mean α at a ratio of {low:g} to {high:g}", float(total / count))
        for (low, high), count, total in zip(edges, run.scales.count, run.scales.total, strict=True)
        if count
    ]


def _ratio_finding(run: Run | None) -> list[str]:
    """How often the distance that ReFU sees is wrong by much: what α is there to make up for."""
    if run is None or not run.scales.count.sum():
        return []
    right = RATIO_EDGES.index(0.75)
    share = 100.0 * run.scales.count[right] / run.scales.count.sum()
    return [
        f"{run.garment}, {LABELS[run.method]}: of the vertices inside the body, {share:.1f} % are given 0.75 to 1.25 "
        "of their accurate distance. The paper's network is off by a quarter on average, which leaves α more to do."
    ]


def _finished(study: Study, table: Table) -> Table:
    """The table with what is missing, and what agrees with the paper."""
    methods = {row.method for row in table.rows} | set(SAMPLE_TABLES.get(table.name, ()))
    table.missing = [missing for missing in study.missing.values() if missing.method in methods]
    table.findings += findings(
        table, ORDERS.get(table.name, ()), LABELS, gap=lambda garment, order: _gap(study, garment, order)
    )
    return table


def _gap(study: Study, garment: str, order: Order) -> Gap | None:
    """How sure a difference is, by the samples: they are independent poses. None for too few, or for other figures."""
    if order.metric not in Figures.__dataclass_fields__:
        return None
    differences = study.paired(None if garment == ALL else garment, order.better, order.worse, order.metric)
    if len(differences) < FEWEST_PAIRED:
        return None
    spread = float(differences.std(ddof=1)) / len(differences) ** 0.5
    return Gap(float(differences.mean()), 1.96 * spread)


SAMPLE_BUILDERS: Mapping[str, Callable[[Study], Table]] = {
    "comparison": comparison_table,
    "ablation": ablation_table,
    "alpha": alpha_table,
    "gcnn": gcnn_table,
    "laplacian": laplacian_table,
    "time": time_table,
    "unseen": unseen_table,
    "energy": energy_table,
}
"""What makes each table of a study."""
