"""`refu evaluate`: makes the paper's tables and figures on your own data."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refu_core.options import setting
from refu_lab.commands import _common as cli
from refu_lab.tables import RESULT_TABLES


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    data: tuple[Path, ...] = ()
    table: str = setting("all", "one table, or all", choices=(*RESULT_TABLES, "all"))
    weights: tuple[Path, ...] = ()
    motions: Path | None = setting(
        None, "folder of AMASS-style .npz files, for motion", parse=cli.in_path, metavar="DIR"
    )
    output: Path = setting(Path("docs/results"), "where the pages go", parse=cli.out_folder, metavar="DIR")
    motion_every: int = setting(1, "every N-th frame of a motion", parse=cli.positive, metavar="N")
    body: str | None = cli.worn_by()
    collider: bool = cli.off_collider()


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="make the paper's tables and figures on your own data, beside the paper's figures",
        description="Run every method on test samples of data sets or bags, and write a page and a JSON file a table. "
        "A method whose networks aren't trained stays in its table, with the command that trains it.",
    )
    parser.add_argument(
        "--data",
        type=cli.place,
        nargs="+",
        default=[],
        metavar="DIR",
        help="data sets of refu simulate or bags with ground truth, or folders and globs of them",
    )
    cli.add_options(parser, EvaluateOptions)
    parser.add_argument(
        "--weights",
        type=cli.in_path,
        nargs="+",
        metavar="DIR",
        help="folders with GARMENT/NAME.safetensors that are searched before the weights that ship",
    )
    cli.add_cluster(parser)
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.fleet import find_data_sets, open_engine
    from refu_lab.reproduction import evaluate, results_dict, results_text

    options = EvaluateOptions(**cli.given(args, EvaluateOptions) | {"data": tuple(find_data_sets(args.data))})
    with open_engine(args.jobs, args.scheduler) as engine:
        tables = evaluate(options, progress=not args.quiet, engine=engine)
    return cli.tell(args, results_text(tables, options.output), results_dict(tables))
