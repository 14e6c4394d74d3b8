"""`refu fuzz`: damaged and hostile input for every reader."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from refu_ros._commands._common import EXIT_CHECK_FAILED, add_common, check_writable, names, positive, write_json

if TYPE_CHECKING:
    import argparse


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "fuzz",
        help="give every reader damaged and hostile input",
        description="Mutate messages, bags, motions, bodies, weights, data sets and parameters, and read them: what "
        "ends in anything but a result or a clear refusal is a finding, and the exit code 1.",
    )
    parser.add_argument("--target", type=names, default=(), metavar="A,B", help="what to fuzz (default: everything)")
    parser.add_argument("--executions", type=positive, metavar="N", help="of each target (default: its own number)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of all mutations (0)")
    parser.add_argument("--hours", type=float, metavar="T", help="go on with other seeds for so long [h]")
    parser.add_argument("--output", type=Path, metavar="DIR", help="keep the input of each finding")
    add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    from refu_ros.fuzz import FuzzOptions, fuzz, fuzz_dict, fuzz_progress, fuzz_table

    for path in (args.json, args.output):
        check_writable(path)
    options = FuzzOptions(
        targets=args.target, executions=args.executions, seed=args.seed, hours=args.hours, output=args.output
    )
    with fuzz_progress(quiet=args.quiet) as report:
        rows = fuzz(options, report=report)
    print(fuzz_table(rows))
    write_json(args.json, fuzz_dict(rows))
    return EXIT_CHECK_FAILED if any(row.failures for row in rows) else 0
