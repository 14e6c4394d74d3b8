"""What `refu evaluate --quick` does: a few bags in a few minutes, held against figures that are kept beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

import msg_adapters as adapters
from refu_core import RefuError
from refu_core._engine import Engine, Lost
from refu_core._files import read_json
from refu_core.modes import DEFAULT_GARMENTS
from refu_lab.commands.replay import ReplayOptions
from refu_lab.fleet import fetched, find_recordings, run_function
from refu_lab.fleet.replay import pipeline_for
from refu_lab.replay import replay
from refu_lab.reproduction import METRICS, format_value, label_of
from refu_lab.tables import format_table, write_json
from refu_lab.truth import TOPIC

BAGS = Path("bags")
REFERENCE = Path("docs/results/quick.json")
TOLERANCES: dict[str, float] = {"mpve_mm": 0.3, "vfcp_percent": 0.02, "cfmp_percent": 7.0, "max_depth_mm": 1.0}
"""How much worse a figure may be than its reference: what other processors and releases of torch make of the same
weights, far less than what a worse method does."""
_FRAMES = 15
"""Frames of a bag, at most."""
_MODES = (("skinned", "accurate"), ("auto", "hybrid"))
"""(backbone, sdf) of the pipelines that are measured."""


class FigureKey(NamedTuple):
    """Names a figure of a bag."""

    bag: str
    garment: str
    method: str
    metric: str


@dataclass(frozen=True)
class Comparison:
    """A figure beside its reference."""

    key: FigureKey
    value: float | None
    """None for a figure that is gone."""
    reference: float | None
    """None for a figure that the reference doesn't have."""
    tolerance: float

    @property
    def is_passed(self) -> bool:
        """Not worse than the reference by more than the tolerance; a figure that is gone has fallen."""
        if self.reference is None or self.value is None:
            return self.reference is None
        loss = self.value - self.reference
        return (-loss if METRICS[self.key.metric].higher_is_better else loss) <= self.tolerance


@dataclass(eq=False)
class QuickResult:
    """What was measured, and how it compares."""

    comparisons: list[Comparison]
    reference: Path
    is_renewed: bool
    """Whether the reference was written instead of compared with."""

    @property
    def is_passed(self) -> bool:
        """No figure has fallen."""
        return all(comparison.is_passed for comparison in self.comparisons)

    def as_dict(self) -> dict[str, Any]:
        """The machine-readable result (`--json`)."""
        rows = [
            {"table": "quick", **c.key._asdict(), "value": c.value, "paper": None}
            | {"reference": c.reference, "tolerance": c.tolerance, "passed": c.is_passed}
            for c in self.comparisons
        ]
        return {"passed": self.is_passed, "reference": str(self.reference), "rows": rows}


def quick_check(
    data: Sequence[str], *, reference: Path | None, renew: bool, progress: bool, engine: Engine
) -> QuickResult:
    """Replays bags (`bags` if none is named), a bag a task, and compares with the `reference` or writes it anew.

    Raises:
        RefuError: no bag, a bad one, or no reference.
    """
    file = reference or REFERENCE
    bags = [one.source for one in find_recordings(data or [str(BAGS)])]
    known = {} if renew else _read(file)
    figures: dict[int, list[tuple[FigureKey, float]]] = {}
    with tqdm(total=len(bags), unit="bag", disable=None if progress else True) as bar:
        for index, rows in engine.run(run_function(_measure), bags):
            if isinstance(rows, Lost):
                msg = f"{bags[index]}: lost: {rows.reason}"
                raise RefuError(msg)
            figures[index] = rows
            bar.update()
    found = {key: value for index in sorted(figures) for key, value in figures[index]}
    if renew:
        about = "refu evaluate --quick holds its figures against these; written by --set-reference"
        kept = [{**key._asdict(), "value": value} for key, value in found.items()]
        write_json(file, {"about": about, "rows": kept})
        known = found
    keys = dict.fromkeys([*known, *found])
    compared = [Comparison(key, found.get(key), known.get(key), TOLERANCES[key.metric]) for key in keys]
    return QuickResult(compared, file, is_renewed=renew)


def quick_table(result: QuickResult) -> str:
    """What `refu evaluate --quick` prints."""
    rows = []
    for c in result.comparisons:
        verdict = "new" if c.reference is None else "ok" if c.is_passed else "FALLEN"
        values = (format_value(c.key.metric, c.value), format_value(c.key.metric, c.reference))
        rows.append((*c.key[:3], label_of(c.key.metric), *values, f"{c.tolerance:g}", verdict))
    table = format_table(("bag", "garment", "method", "figure", "now", "reference", "tolerance", ""), rows)
    if result.is_renewed:
        return f"{table}\n\nwrote {result.reference}"
    fallen = sum(not c.is_passed for c in result.comparisons)
    verdict = f"{fallen} of {len(rows)} figures have fallen" if fallen else f"none of {len(rows)} figures has fallen"
    return f"{table}\n\n{verdict} (reference: {result.reference})"


def _measure(source: str) -> list[tuple[FigureKey, float]]:
    """The figures of a bag."""
    found = []
    with fetched(source) as bag:
        true = _true_garments(bag)
        for backbone, sdf in _MODES:
            how: dict[str, Any] = {"garments": true or DEFAULT_GARMENTS, "backbone": backbone, "sdf": sdf}
            options = ReplayOptions(input=bag, max_frames=_FRAMES, **how)
            result = replay(options, pipeline=pipeline_for(options))
            for garment in options.garments:
                methods = {backbone: result.before[garment], f"node, {backbone}, {sdf}": result.after[garment]}
                for (method, figures), metric in product(methods.items(), TOLERANCES):
                    value = getattr(figures, metric)
                    if value is not None:
                        found.append((FigureKey(bag.stem, garment, method, metric), value))
    return found


def _true_garments(bag: Path) -> tuple[str, ...]:
    """The garments that a bag has ground truth of."""
    with adapters.BagReader(bag) as reader:
        if TOPIC not in {topic.name for topic in reader.topics}:
            return ()
        names = {m.ns: None for message in reader.messages([TOPIC]) for m in adapters.decode_marker_array(message.data)}
    return tuple(names)


def _read(file: Path) -> dict[FigureKey, float]:
    """The reference's figures."""
    if not file.exists():
        msg = f"{file}: no reference there; write one with --set-reference, or name another with --reference"
        raise RefuError(msg)
    try:
        content = read_json(file, error=RefuError, wanted="a reference, as --set-reference writes it")
        figures = {FigureKey(*(str(r[name]) for name in FigureKey._fields)): float(r["value"]) for r in content["rows"]}
        if unknown := {key.metric for key in figures} - TOLERANCES.keys():
            raise KeyError(*unknown)
    except (RefuError, ValueError, KeyError, TypeError) as error:
        msg = f"{file}: not a reference of refu evaluate --quick ({error!r}); write one with --set-reference"
        raise RefuError(msg) from error
    return figures
