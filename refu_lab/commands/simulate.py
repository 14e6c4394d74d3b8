"""`refu simulate`: data sets of simulated garments."""

from __future__ import annotations

import argparse
from typing import Any

from refu_lab.commands._cluster import add_cluster
from refu_lab.commands._common import (
    add_axes,
    add_body,
    add_common,
    between,
    check_writable,
    in_path,
    out_folder,
    positive,
    seed,
    write_json,
)


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "simulate",
        help="make a data set of simulated garments",
        description="Simulate collision-free garments on bodies of many poses, shapes and styles. An interrupted run "
        "goes on when the same command is given again.",
    )
    parser.add_argument("garment", metavar="GARMENT", help="a garment's name (refu garment list), or its .npz")
    parser.add_argument(
        "--count", type=positive, required=True, metavar="N", help="samples (or sequences), training and test together"
    )
    parser.add_argument("--output", type=out_folder, required=True, metavar="DIR", help="folder of the data set")
    parser.add_argument(
        "--motions",
        type=in_path,
        metavar="DIR",
        help="folder of motion files, two at least (default: drawn poses alone)",
    )
    add_axes(parser, "motions'", "z up, as ROS has it")
    add_body(parser)
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="of everything that is drawn (0)")
    add_cluster(parser)
    parser.add_argument(
        "--sequences", action="store_true", help="continuous motions at 30 Hz with dynamics, instead of poses at rest"
    )
    parser.add_argument("--shapes", type=positive, default=5, metavar="K", help="body shapes of the sequences (5)")
    parser.add_argument(
        "--seconds", type=between(0.1, 3600), default=10.0, metavar="T", help="length of each sequence [s] (10)"
    )
    add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    from refu_lab.fleet import open_engine
    from refu_lab.simulate import simulate, simulation_table

    check_writable(args.json)
    with open_engine(args.jobs, args.scheduler) as engine:
        card = simulate(
            args.garment,
            args.count,
            args.output,
            motions=args.motions,
            axes=args.input_axes,
            fps=args.fps,
            body=args.body,
            seed=args.seed,
            engine=engine,
            sequences=args.sequences,
            shapes=args.shapes,
            seconds=args.seconds,
            progress=not args.quiet,
        )
    print(simulation_table(card, args.output))
    write_json(args.json, card)
    return 0
