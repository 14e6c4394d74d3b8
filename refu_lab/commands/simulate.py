"""`refu simulate`: data sets of simulated garments."""

from __future__ import annotations

import argparse
from typing import Any

from refu_lab.commands import _common as cli


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "simulate",
        help="make a data set of simulated garments",
        description="Simulate collision-free garments on bodies of many poses, shapes and styles. An interrupted run "
        "goes on when the same command is given again.",
    )
    parser.add_argument("garment", metavar="GARMENT", help="a garment's name (refu garment list), or its .npz")
    parser.add_argument(
        "--count",
        type=cli.positive,
        required=True,
        metavar="N",
        help="samples (or sequences), training and test together",
    )
    parser.add_argument("--output", type=cli.out_folder, required=True, metavar="DIR", help="folder of the data set")
    parser.add_argument(
        "--motions",
        type=cli.in_path,
        metavar="DIR",
        help="folder of motion files, two at least (default: drawn poses alone)",
    )
    cli.add_axes(parser, "motions'", "z up, as ROS has it")
    cli.add_body(parser)
    parser.add_argument("--seed", type=cli.seed, metavar="S", help="of everything that is drawn (0)")
    cli.add_cluster(parser)
    parser.add_argument(
        "--sequences", action="store_true", help="continuous motions at 30 Hz with dynamics, instead of poses at rest"
    )
    parser.add_argument("--shapes", type=cli.positive, metavar="K", help="body shapes of the sequences (5)")
    parser.add_argument("--seconds", type=cli.between(0.1, 3600), metavar="T", help="length of each sequence [s] (10)")
    cli.add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.fleet import open_engine
    from refu_lab.simulate import SimulateOptions, simulate, simulation_table

    with open_engine(args.jobs, args.scheduler) as engine:
        options = SimulateOptions(**cli.given(args, SimulateOptions))
        card = simulate(options, engine=engine, progress=not args.quiet)
    return cli.tell(args, simulation_table(card, args.output), card)
