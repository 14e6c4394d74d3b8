"""What `refu evaluate` does: the paper's tables and figures, each beside the paper's, as pages and JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from tqdm import tqdm

import msg_adapters as adapters
from refu_core import RefuError
from refu_core._device import one_thread
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
        parts += [f"--weights {path.resolve().name}" for path in self.weights]
        return " ".join(parts)


def evaluate(options: EvaluateOptions, *, progress: bool) -> list[rp.Table]:
    """Makes and writes the tables that were asked for.

    Raises:
        RefuError: there is nothing to make them of, a data set or motion can't be read, or the results can't be
        written.
    """
    wanted = options.tables
    sets = [rp.Samples.open(path, every=options.every) for path in options.data]
    maker = _Maker(options, sets, progress)
    if options.table == "all":
        wanted = [name for name in wanted if maker.has_data_for(name)]
    elif not maker.has_data_for(options.table):
        kind = "sequences (refu simulate --sequences)" if options.table == "sequence" else "poses"
        msg = f"the table {options.table} needs a data set of {kind} in --data"
        raise RefuError(msg)
    options.output.mkdir(parents=True, exist_ok=True)
    tables = [maker.make(name) for name in wanted]
    rp.write_summary(options.output)
    return tables


class _Maker:
    """Makes tables of what was opened; methods are run when the first table needs them."""

    def __init__(self, options: EvaluateOptions, sets: Sequence[rp.Samples], progress: bool) -> None:
        self._options = options
        self._progress = progress
        self._posed = [samples for samples in sets if samples.shapes is None]
        self._moving = [samples for samples in sets if samples.shapes is not None]
        _check_sets(self._posed, self._moving)
        self._library = rp.Library(options.weights)
        self._cache = rp.Cache(options.cache) if options.cache is not None else None

    def has_data_for(self, table: str) -> bool:
        """Whether there are sets of the kind that the table is about."""
        if table in _NEED_MOTION:
            return True
        return bool(self._moving if table == "sequence" else self._posed)

    def make(self, name: str) -> rp.Table:
        """Makes a table, its plots and pictures, and writes them."""
        samples_of: dict[str, int] = {}
        plots: list[tuple[str, str]] = []
        if name == "sequence":
            table = rp.sequence_table(self._sequence_studies)
            samples_of = {f"{s.garment}, {s.shapes} shapes": len(s) for s in self._moving}
        elif name == "motion":
            table = self._motion()
        elif name == "sdf":
            with _bar(name, self._progress) as advance:
                table = rp.sdf_table(self._posed, library=self._library, progress=advance)
            samples_of = {s.garment: len(s) for s in self._posed}
        elif name == "time":
            table, samples_of = self._time()
        else:
            table = rp.SAMPLE_BUILDERS[name](self._study)
            samples_of = self._study.n_samples
            if name in rp.PLOTS:
                plots += rp.PLOTS[name](self._study, self._options.output)
            if name in rp.PICTURES:
                draw = rp.PICTURES[name]
                plots += draw(self._study, self._posed, self._options.output, library=self._library)
        table.plots = plots
        command = self._options.command(name)
        rp.write_table(table, self._options.output, command=command, facts={"samples": samples_of})
        return table

    @cached_property
    def _study(self) -> rp.Study:
        names = [name for name in self._options.tables if name in rp.SAMPLE_BUILDERS and name != "time"]
        methods = list(dict.fromkeys(chain.from_iterable(rp.SAMPLE_TABLES[name] for name in names)))
        study = rp.Study()
        for samples in self._posed:
            self._run(study, samples, methods)
        return study

    @cached_property
    def _sequence_studies(self) -> dict[int, rp.Study]:
        studies: dict[int, rp.Study] = {}
        for samples in self._moving:
            shapes = samples.shapes or 0
            study = studies.setdefault(shapes, rp.Study())
            self._run(study, samples, (f"mlp-{shapes}", f"mlp-{shapes}-refu-approx"))
        return studies

    def _run(self, study: rp.Study, samples: rp.Samples, methods: Sequence[str]) -> None:
        with _bar(samples.garment, self._progress) as advance:
            rp.run_methods(study, samples, methods, library=self._library, cache=self._cache, progress=advance)

    def _motion(self) -> rp.Table:
        clips = read_clips(self._options.motions or Path())
        worn = [samples.garment for samples in self._posed] or BUILTIN_GARMENTS
        every = self._options.motion_every
        with _bar("motion", self._progress) as advance:
            return rp.motion_table(clips, worn, library=self._library, every=every, progress=advance)

    def _time(self) -> tuple[rp.Table, dict[str, int]]:
        """Measured now, never taken from a cache, with nothing else in the same run."""
        study = rp.Study()
        with one_thread():
            for samples in self._posed:
                with _bar(f"time, {samples.garment}", self._progress) as advance:
                    few = samples.thinned(_TIMED)
                    rp.run_methods(study, few, rp.SAMPLE_TABLES["time"], library=self._library, progress=advance)
            neural = rp.neural_time_rows(self._posed)
        table = rp.SAMPLE_BUILDERS["time"](study)
        table.rows += neural
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
