"""What `refu evaluate` does: the paper's tables and figures, each beside the paper's, as pages and JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from tqdm import tqdm

import msg_adapters as adapters
from refu_core import RefuError
from refu_core.evaluation import reproduction as rp
from refu_core.garments import BUILTIN_GARMENTS
from refu_ros.tables import format_table

OUTPUT = Path("docs/results")
_NEED_MOTION = ("motion",)
_TIMED = 40
"""Test samples of a garment that times are measured on."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What to evaluate; the fields are the options of `refu evaluate`."""

    data: tuple[Path, ...] = ()
    table: str = "all"
    weights: tuple[Path, ...] = ()
    motions: Path | None = None
    output: Path = OUTPUT
    cache: Path | None = None
    every: int = 1
    motion_every: int = 10

    @property
    def tables(self) -> list[str]:
        """The tables that can be made of what is given.

        Raises:
            RefuError: none can, or the one that was asked for can't.
        """
        possible = [name for name in rp.TABLES if (self.motions if name in _NEED_MOTION else self.data)]
        wanted = possible if self.table == "all" else [self.table]
        if not wanted or wanted[0] not in possible:
            need = "--motions DIR" if self.table in _NEED_MOTION else "--data DIR"
            msg = f"nothing to evaluate: the table {self.table} needs {need}"
            raise RefuError(msg)
        return wanted

    def command(self, table: str) -> str:
        """The command that makes a table again, with the names of folders alone."""
        parts = ["refu evaluate", f"--table {table}"]
        if table in _NEED_MOTION:
            parts += ["--motions motions/", f"--motion-every {self.motion_every}"]
        else:
            parts += [f"--data {' '.join(f'data/{path.resolve().name}' for path in self.data)}"]
            parts += [f"--every {self.every}"] if self.every > 1 else []
        return " ".join(parts)


def evaluate(options: EvaluateOptions, *, progress: bool) -> list[rp.Table]:
    """Makes and writes the tables that were asked for.

    Raises:
        RefuError: there is nothing to make them of, a data set or motion can't be read, or the results can't be
        written.
    """
    names = options.tables
    sets = [rp.Samples.open(path, every=options.every) for path in options.data]
    posed = [samples for samples in sets if samples.shapes is None]
    moving = [samples for samples in sets if samples.shapes is not None]
    _check_sets(posed, moving)
    library = rp.Library(options.weights)
    cache = rp.Cache(options.cache) if options.cache is not None else None

    def run(study: rp.Study, samples: rp.Samples, methods: Sequence[str]) -> None:
        with _bar(samples.garment, progress) as advance:
            rp.run_methods(study, samples, methods, library=library, cache=cache, progress=advance)

    study = rp.Study()
    studies: dict[int, rp.Study] = {}
    sampled = [rp.SAMPLE_TABLES[name] for name in names if name in rp.SAMPLE_BUILDERS and name != "time"]
    for samples in posed if sampled else []:
        run(study, samples, list(dict.fromkeys(chain.from_iterable(sampled))))
    for samples in moving if "sequence" in names else []:
        shapes = samples.shapes or 0
        run(studies.setdefault(shapes, rp.Study()), samples, (f"mlp-{shapes}", f"mlp-{shapes}-refu-approx"))
    tables = []
    options.output.mkdir(parents=True, exist_ok=True)
    for name in names:
        samples_of = study.n_samples
        if name == "sequence":
            table = rp.sequence_table(studies)
            samples_of = {f"{s.garment}, {s.shapes} shapes": len(s) for s in moving}
        elif name == "sdf":
            with _bar(name, progress) as advance:
                table = rp.sdf_table(posed, library=library, progress=advance)
            samples_of = {s.garment: len(s) for s in posed}
        elif name == "motion":
            with _bar(name, progress) as advance:
                table = _motion(options, [s.garment for s in posed] or BUILTIN_GARMENTS, advance)
        elif name == "time":
            table, samples_of = _time(posed, library, progress=progress)
        else:
            table = rp.SAMPLE_BUILDERS[name](study)
        if name in rp.PLOTS:
            table.plots = rp.PLOTS[name](study, options.output)
        if name in rp.PICTURES:
            table.plots += rp.PICTURES[name](study, posed, options.output, library=library)
        rp.write_table(table, options.output, command=options.command(name), facts={"samples": samples_of})
        tables.append(table)
    rp.write_summary(options.output)
    return tables


def _time(sets: Sequence[rp.Samples], library: rp.Library, *, progress: bool) -> tuple[rp.Table, dict[str, int]]:
    """Measured now, never taken from a cache, with nothing else in the same run."""
    study = rp.Study()
    for samples in sets:
        with _bar(f"time, {samples.garment}", progress) as advance:
            few = samples.thinned(_TIMED)
            rp.run_methods(study, few, rp.SAMPLE_TABLES["time"], library=library, progress=advance)
    table = rp.SAMPLE_BUILDERS["time"](study)
    table.rows += rp.neural_time_rows(sets)
    return table, study.n_samples


def _check_sets(posed: Sequence[rp.Samples], moving: Sequence[rp.Samples]) -> None:
    twice = [name for name, n in Counter((s.garment, s.shapes) for s in (*posed, *moving)).items() if n > 1]
    if twice:
        msg = f"wanted one data set a garment, got several of {twice[0][0]}"
        raise RefuError(msg)
    unknown = [s.shapes for s in moving if s.shapes not in rp.SEQUENCE_SHAPES]
    if unknown:
        msg = f"wanted sequences of {' or '.join(map(str, rp.SEQUENCE_SHAPES))} body shapes, got {unknown[0]}"
        raise RefuError(msg)


def results_text(tables: Sequence[rp.Table], output: Path) -> str:
    """What `refu evaluate` prints: every table in short, and where the pages are."""
    parts = []
    for table in tables:
        labels = rp.labels_of(table.name)
        rows = [
            (
                f"{row.garment}: {labels.get(row.method, row.method).replace('*', '')}",
                rp.label_of(row.metric),
                rp.format_value(row.metric, row.value),
                rp.format_value(row.metric, row.paper),
            )
            for row in table.rows
            if row.value is not None and (table.name != "motion" or row.garment.endswith("all clips"))
        ]
        missing = sorted({m.method for m in table.missing})
        note = f"\nnot measured: {', '.join(missing)}" if missing else ""
        parts.append(format_table((table.title, "", "here", "paper"), rows) + note)
    return "\n\n".join([*parts, f"wrote {output / 'README.md'}"])


def results_dict(tables: Sequence[rp.Table]) -> dict[str, Any]:
    """The machine-readable result (`--json`)."""
    return {
        "rows": [row._asdict() for table in tables for row in table.rows],
        "missing": [{"table": table.name, **missing.as_dict()} for table in tables for missing in table.missing],
        "findings": {table.name: table.findings for table in tables},
    }


def _motion(options: EvaluateOptions, garments: Sequence[str], advance: Callable[[int, int], None] | None) -> rp.Table:
    assert options.motions is not None
    return rp.motion_table(read_clips(options.motions), garments, every=options.motion_every, progress=advance)


def read_clips(folder: Path) -> list[rp.Clip]:
    """The AMASS-style motions of a folder, by name.

    Raises:
        RefuError: there is none, or one can't be read, or isn't finite.
    """
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        msg = f"{folder}: no motion in it, wanted AMASS-style .npz files"
        raise RefuError(msg)
    motions = [(path.stem, adapters.read_motion(path)) for path in paths]
    return [rp.Clip(name, [motion.frame(i) for i in range(len(motion))]) for name, motion in motions]


@contextmanager
def _bar(title: str, progress: bool) -> Iterator[Callable[[int, int], None]]:
    with tqdm(desc=title, unit="sample", disable=None if progress else True) as bar:

        def advance(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield advance
