"""What `refu evaluate` does: the paper's tables and figures, ours beside the paper's, as pages and JSON."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msg_adapters as adapters
from refu_core import RefuError
from refu_core._device import one_thread
from refu_core._engine import Engine
from refu_lab.commands.evaluate import EvaluateOptions
from refu_lab.reproduction import _build
from refu_lab.reproduction._methods import SEQUENCE_SHAPES, Library
from refu_lab.reproduction._motion import motion_table
from refu_lab.reproduction._plots import PLOTS, picture_garments
from refu_lab.reproduction._runs import SampleSet, Study, run_methods
from refu_lab.reproduction._sdf import sdf_table
from refu_lab.reproduction._tables import ResultTable, is_summary, write_summary
from refu_lab.tables import RESULT_TABLES

_TIMED = 40
"""Number of a garment's test samples that times are measured on."""


def _command(options: EvaluateOptions, table: str) -> str:
    """The command that makes a table again, with folder names in place of full paths."""
    every = ["--motion-every", str(options.motion_every)] if options.motion_every > 1 else []
    data = ["/".join(path.resolve().parts[-2:]) for path in options.data]
    parts = ["refu", "evaluate", "--table", table]
    parts += ["--motions", "motions/", *every] if table == "motion" else ["--data", *data]
    parts += ["--body", Path(options.body).name] if options.body is not None else []
    parts += [] if options.collider else ["--no-collider"]
    parts += ["--weights", *(path.resolve().name for path in options.weights)] if options.weights else []
    return shlex.join(parts)


def evaluate(options: EvaluateOptions, *, progress: bool, engine: Engine | None = None) -> list[ResultTable]:
    """Makes and writes the tables that were asked for.

    `engine` runs the methods, a block of samples a task; this process alone makes the tables sdf, time and motion.
    Raises `RefuError`: nothing to make them from, an input that can't be read, or results that can't be written.
    """
    page = options.output / "README.md"
    if page.exists() and not is_summary(page):
        raise RefuError(f"{page}: is there already, and no page of refu evaluate; name another folder with --output")
    sets = SampleSet.joined([SampleSet.open(path) for path in options.data])
    if unknown := [samples.shapes for samples in sets if samples.shapes not in (None, *SEQUENCE_SHAPES)]:
        raise RefuError(f"wanted sequences of {' or '.join(map(str, SEQUENCE_SHAPES))} body shapes, got {unknown[0]}")
    posed = [samples for samples in sets if samples.shapes is None]
    moving = [samples for samples in sets if samples.shapes is not None]
    has_data = {name: bool(posed) for name in RESULT_TABLES}
    has_data |= {"sequence": bool(moving), "motion": options.motions is not None}
    wanted = [name for name in RESULT_TABLES if options.table in ("all", name) and has_data[name]]
    if not wanted:
        kind = "sequences (refu simulate --sequences)" if options.table == "sequence" else "poses"
        of_data = f"a data set of {kind} in --data" if options.data else "--data DIR"
        need = "--motions DIR" if options.table == "motion" else of_data
        raise RefuError(f"nothing to evaluate: the table {options.table} needs {need}")
    library = Library(options.weights, collider=options.collider, body=options.body)
    how: dict[str, Any] = {"library": library, "progress": progress}
    output, n_posed = options.output, {samples.garment: len(samples) for samples in posed}
    output.mkdir(parents=True, exist_ok=True)
    study, tables = Study(), []
    of_study = [name for name in wanted if name in _build.SAMPLE_TABLES and name != "sequence"]
    methods = list(dict.fromkeys(method for name in of_study for method in _build.SAMPLE_TABLES[name].methods))
    methods += [name for name in _build.POSTURE_METHODS if "postures" in wanted and name not in methods]
    for samples in posed if methods else ():
        run_methods(study, samples, methods, engine=engine, **how)
    for name in wanted:
        n_samples = n_posed
        if name == "sequence":  # one study for all numbers of body shapes, as each has its own methods
            in_motion = Study()
            for samples in moving:
                own = [f"mlp-{samples.shapes}{refu}" for refu in ("", "-refu-approx")]
                run_methods(in_motion, samples, own, engine=engine, **how)
            table = _build.sample_table(in_motion, name)
            n_samples = {f"{samples.garment}, {samples.shapes} shapes": len(samples) for samples in moving}
        elif name == "motion":
            table = motion_table(read_clips(options.motions or Path()), every=options.motion_every, **how)
            n_samples = {}
        elif name == "postures":
            table = _build.posture_table(study)
        elif name == "sdf":
            table = sdf_table(posed, **how)
        elif name == "time":  # in a run of its own
            timed = Study()
            with one_thread():
                for samples in posed:
                    run_methods(timed, samples.thinned(_TIMED), _build.TIMED_METHODS, **how)
            table, n_samples = _build.time_table(timed), timed.n_samples
        else:
            table = _build.sample_table(study, name)
            table.plots += PLOTS[name](study, output) if name in PLOTS else []
            if name == "comparison":
                table.plots += picture_garments(study, posed, output, library=library)
        table.write(output, command=_command(options, name), n_samples=n_samples)
        tables.append(table)
    write_summary(output)
    return tables


def results_text(tables: Sequence[ResultTable], output: Path) -> str:
    """What `refu evaluate` prints: a short form of every table, and where the pages are."""
    parts = []
    for table in tables:
        parts += [grid.text() for grid in table.in_short()]
        if missing := sorted({m.method for m in table.missing}):
            parts.append(f"not measured: {', '.join(missing)}")
    return "\n\n".join([*parts, f"wrote {output / 'README.md'}"])


def results_dict(tables: Sequence[ResultTable]) -> dict[str, Any]:
    return {
        "rows": [row._asdict() for table in tables for row in table.rows],
        "missing": [{"table": table.name, **asdict(missing)} for table in tables for missing in table.missing],
    }


def read_clips(folder: Path) -> dict[str, adapters.Motion]:
    """A folder's AMASS-style motions, by name. Raises `RefuError`: there is no motion, or one can't be read."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise RefuError(f"{folder}: no motion in it, wanted AMASS-style .npz files")
    return {path.stem: adapters.read_motion(path) for path in paths}
