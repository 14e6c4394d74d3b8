"""What `refu evaluate` does: the paper's tables and figures, each beside the paper's, as pages and JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

from tqdm import tqdm

import msg_adapters as adapters
from refu_core import RefuError
from refu_core._device import one_thread
from refu_core._engine import Engine
from refu_lab import reproduction as rp
from refu_lab.commands.evaluate import EvaluateOptions
from refu_lab.tables import RESULT_TABLES

_TIMED = 40
"""Test samples of a garment that times are measured on."""


def _command(options: EvaluateOptions, table: str) -> str:
    """The command that makes a table again, with the names of folders alone."""
    parts = ["refu evaluate", f"--table {table}"]
    if table == "motion":
        parts += ["--motions motions/"]
        parts += [f"--motion-every {options.motion_every}"] if options.motion_every > 1 else []
    else:
        parts += [f"--data {' '.join(f'data/{path.resolve().name}' for path in options.data)}"]
        parts += [f"--every {options.every}"] if options.every > 1 else []
    parts += [f"--body {Path(options.body).name}"] if options.body is not None else []
    parts += [] if options.collider else ["--no-collider"]
    parts += [f"--weights {path.resolve().name}" for path in options.weights]
    return " ".join(parts)


def evaluate(options: EvaluateOptions, *, progress: bool, engine: Engine | None = None) -> list[rp.ResultTable]:
    """Makes and writes the tables that were asked for.

    Methods are run by `engine`, a block of samples a task; the tables sdf, time and motion by this process alone.

    Raises:
        RefuError: there is nothing to make them of, a data set or motion can't be read, or the results can't be
        written.
    """
    maker = _Maker(options, progress, engine)
    tables = [maker.make(name) for name in maker.wanted]
    rp.write_summary(options.output)
    return tables


class _Maker:
    """Makes tables of what was opened; methods are run when the first table needs them."""

    def __init__(self, options: EvaluateOptions, progress: bool, engine: Engine | None) -> None:
        self._engine = engine
        self._options = options
        self._progress = progress
        if not options.data and (options.table not in ("all", "motion") or options.motions is None):
            need = "--motions DIR" if options.table == "motion" else "--data DIR"
            msg = f"nothing to evaluate: the table {options.table} needs {need}"
            raise RefuError(msg)
        sets = [rp.SampleSet.open(path, every=options.every) for path in options.data]
        _check_sets(sets)
        self._posed = [samples for samples in sets if samples.shapes is None]
        self._moving = [samples for samples in sets if samples.shapes is not None]
        self._library = rp.Library(options.weights, collider=options.collider, body=options.body)
        self.wanted = [name for name in RESULT_TABLES if options.table in ("all", name) and self._has_data_for(name)]
        if not self.wanted:
            kind = "sequences (refu simulate --sequences)" if options.table == "sequence" else "poses"
            need = "--motions DIR" if options.table == "motion" else f"a data set of {kind} in --data"
            msg = f"the table {options.table} needs {need}"
            raise RefuError(msg)

    def _has_data_for(self, table: str) -> bool:
        if table == "motion":
            return self._options.motions is not None
        return bool(self._moving if table == "sequence" else self._posed)

    def make(self, name: str) -> rp.ResultTable:
        """Makes a table, its plots and pictures, and writes them."""
        output, n_samples = self._options.output, {samples.garment: len(samples) for samples in self._posed}
        output.mkdir(parents=True, exist_ok=True)
        if name == "sequence":
            table = rp.sample_table(self._sequence_study, name)
            n_samples = {f"{samples.garment}, {samples.shapes} shapes": len(samples) for samples in self._moving}
        elif name == "motion":
            table, n_samples = self._motion(), {}
        elif name == "sdf":
            with _bar(name, self._progress) as advance:
                table = rp.sdf_table(self._posed, library=self._library, progress=advance)
        elif name == "time":
            study = self._time_study()
            table, n_samples = rp.time_table(study), study.n_samples
        else:
            table = rp.sample_table(self._study, name)
            if name in rp.PLOTS:
                table.plots += rp.PLOTS[name](self._study, output)
            if name == "comparison":
                table.plots += rp.picture_garments(self._study, self._posed, output, library=self._library)
        table.write(output, command=_command(self._options, name), n_samples=n_samples)
        return table

    @cached_property
    def _study(self) -> rp.Study:
        names = [name for name in self.wanted if name in rp.SAMPLE_TABLES and name != "sequence"]
        methods = list(dict.fromkeys(method for name in names for method in rp.SAMPLE_TABLES[name].methods))
        study = rp.Study()
        for samples in self._posed:
            self._run(study, samples, methods)
        return study

    @cached_property
    def _sequence_study(self) -> rp.Study:
        """Sets of several numbers of body shapes in one study, as each has methods of its own."""
        study = rp.Study()
        for samples in self._moving:
            self._run(study, samples, [f"mlp-{samples.shapes}{refu}" for refu in ("", "-refu-approx")])
        return study

    def _run(self, study: rp.Study, samples: rp.SampleSet, methods: Sequence[str]) -> None:
        options: dict[str, Any] = {"library": self._library, "cache_folder": self._options.cache}
        with _bar(samples.garment, self._progress) as advance:
            rp.run_methods(study, samples, methods, progress=advance, engine=self._engine, **options)

    def _motion(self) -> rp.ResultTable:
        clips = read_clips(self._options.motions or Path())
        with _bar("motion", self._progress) as advance:
            return rp.motion_table(clips, library=self._library, every=self._options.motion_every, progress=advance)

    def _time_study(self) -> rp.Study:
        """Measured now, never taken from a cache, with nothing else in the same run."""
        study = rp.Study()
        with one_thread():
            for samples in self._posed:
                few = samples.thinned(_TIMED)
                with _bar(f"time, {samples.garment}", self._progress) as advance:
                    rp.run_methods(study, few, rp.TIMED_METHODS, library=self._library, progress=advance)
        return study


def _check_sets(sets: Sequence[rp.SampleSet]) -> None:
    twice = [name for name, n in Counter((samples.garment, samples.shapes) for samples in sets).items() if n > 1]
    if twice:
        msg = f"wanted one data set a garment, got several of {twice[0][0]}"
        raise RefuError(msg)
    unknown = [samples.shapes for samples in sets if samples.shapes not in (None, *rp.SEQUENCE_SHAPES)]
    if unknown:
        msg = f"wanted sequences of {' or '.join(map(str, rp.SEQUENCE_SHAPES))} body shapes, got {unknown[0]}"
        raise RefuError(msg)


def results_text(tables: Sequence[rp.ResultTable], output: Path) -> str:
    """What `refu evaluate` prints: every table in short, and where the pages are."""
    parts = []
    for table in tables:
        parts += [grid.text() for grid in table.in_short()]
        if missing := sorted({m.method for m in table.missing}):
            parts.append(f"not measured: {', '.join(missing)}")
    return "\n\n".join([*parts, f"wrote {output / 'README.md'}"])


def results_dict(tables: Sequence[rp.ResultTable]) -> dict[str, Any]:
    """The machine-readable result (`--json`)."""
    return {
        "rows": [row._asdict() for table in tables for row in table.rows],
        "missing": [{"table": table.name, **asdict(missing)} for table in tables for missing in table.missing],
    }


def read_clips(folder: Path) -> dict[str, adapters.Motion]:
    """A folder's AMASS-style motions, by name.

    Raises:
        RefuError: there is none, or one can't be read.
    """
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        msg = f"{folder}: no motion in it, wanted AMASS-style .npz files"
        raise RefuError(msg)
    return {path.stem: adapters.read_motion(path) for path in paths}


@contextmanager
def _bar(title: str, progress: bool) -> Iterator[Callable[[int, int], None]]:
    with tqdm(desc=title, unit="sample", disable=None if progress else True) as bar:

        def advance(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield advance
