"""`refu evaluate`: the paper's tables and figures on own data."""

from __future__ import annotations

import argparse
from typing import Any

from refu_lab.commands._cluster import add_cluster, place
from refu_lab.commands._common import (
    EXIT_CHECK_FAILED,
    add_body,
    add_collider,
    add_common,
    check_writable,
    in_path,
    out_file,
    out_folder,
    positive,
    write_json,
)
from refu_lab.tables import RESULT_TABLES


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "evaluate",
        help="make the paper's tables and figures on own data, beside the paper's figures",
        description="Run every method on the test samples of data sets, and write a page and a JSON file a table. "
        "A method whose networks aren't trained stays in its table, with the command that trains it.",
    )
    parser.add_argument(
        "--data",
        type=place,
        nargs="+",
        default=[],
        metavar="DIR",
        help="data sets of refu simulate, one a garment, or folders and globs of them; with --quick: bags",
    )
    parser.add_argument("--table", choices=(*RESULT_TABLES, "all"), default="all", help="one table (default: all)")
    parser.add_argument(
        "--weights",
        type=in_path,
        nargs="+",
        default=[],
        metavar="DIR",
        help="folders with GARMENT/NAME.safetensors that are looked at before the weights that ship",
    )
    parser.add_argument("--motions", type=in_path, metavar="DIR", help="folder of AMASS-style .npz files, for motion")
    parser.add_argument("--output", type=out_folder, metavar="DIR", help="where the pages go (docs/results)")
    parser.add_argument("--cache", type=out_folder, metavar="DIR", help="keep what was measured, and use it again")
    parser.add_argument("--every", type=positive, default=1, metavar="N", help="every N-th test sample (1)")
    parser.add_argument(
        "--motion-every", type=positive, default=1, metavar="N", help="every N-th frame of a motion (1)"
    )
    add_body(parser)
    add_collider(parser)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="measure the bags of --data (default: bags) instead, and exit with 1 where a figure has fallen",
    )
    parser.add_argument(
        "--reference",
        type=out_file,
        metavar="FILE",
        help="figures that --quick holds its own against (docs/results/quick.json)",
    )
    parser.add_argument("--set-reference", action="store_true", help="write that file instead of comparing with it")
    add_cluster(parser)
    add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    for path in (args.json, args.output, args.cache):
        check_writable(path)
    from refu_lab.fleet import find_data_sets, open_engine

    if args.quick:
        from refu_lab.quick import quick_check, quick_table

        with open_engine(args.jobs, args.scheduler) as engine:
            result = quick_check(
                args.data,
                reference=args.reference,
                renew=args.set_reference,
                progress=not args.quiet,
                engine=engine,
            )
        print(quick_table(result))
        write_json(args.json, result.as_dict())
        return 0 if result.is_passed else EXIT_CHECK_FAILED
    from refu_lab.evaluate import OUTPUT, EvaluateOptions, evaluate, results_dict, results_text

    output = args.output or OUTPUT
    options = EvaluateOptions(
        data=tuple(find_data_sets(args.data)),
        table=args.table,
        weights=tuple(args.weights),
        motions=args.motions,
        output=output,
        cache=args.cache,
        every=args.every,
        motion_every=args.motion_every,
        collider=args.collider,
        body=args.body,
    )
    with open_engine(args.jobs, args.scheduler) as engine:
        tables = evaluate(options, progress=not args.quiet, engine=engine)
    print(results_text(tables, output))
    write_json(args.json, results_dict(tables))
    return 0
