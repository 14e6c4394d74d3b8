"""`refu train`: a garment's networks from a data set."""

from __future__ import annotations

import argparse
from typing import Any

from refu_core.modes import DEFAULT_MARGIN
from refu_lab.commands import _common as cli


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train a garment's networks on a data set",
        description="Train a backbone on a data set of refu simulate, alone or together with ReFU. An interrupted run "
        "goes on when the same command is given again; torchrun shares it among GPUs.",
    )
    parser.add_argument("garment", metavar="GARMENT", help="a garment's name (refu garment list), or its .npz")
    parser.add_argument("--data", type=cli.in_path, required=True, metavar="DIR", help="the garment's data set")
    parser.add_argument(
        "--mode",
        metavar="MODE",
        help="hybrid (default), approx or accurate: with ReFU; none: the backbone alone; collision-approx or "
        "collision-accurate: a collision loss without ReFU, the paper's baseline",
    )
    parser.add_argument("--backbone", metavar="NAME", help="tailornet (default), mlp or gcnn")
    parser.add_argument("--preset", metavar="NAME", help="realtime (default) or paper")
    parser.add_argument(
        "--like",
        metavar="GARMENT",
        help="carry the shipped networks of this related garment over: for sets of a hundred samples; writes all modes",
    )
    parser.add_argument(
        "--start",
        type=cli.in_path,
        metavar="DIR",
        help="go on from a garment's weights in this folder, those that ship (refu_core/weights/GARMENT) or your own",
    )
    parser.add_argument(
        "--output", type=cli.out_folder, metavar="DIR", help="folder of the weights (default: weights/GARMENT)"
    )
    parser.add_argument(
        "--network",
        metavar="NAME",
        help="garment (default), or sdf: the paper's network for the body's distance (preset paper or small)",
    )
    parser.add_argument(
        "--scale",
        metavar="KIND",
        help="what ReFU's scale is predicted from: vertex (default, the paper's), shared (Alt. 1), distance (Alt. 2), "
        "or fixed at 1",
    )
    parser.add_argument(
        "--margin", type=float, metavar="M", help=f"clearance that ReFU is trained to keep [m] ({DEFAULT_MARGIN:g})"
    )
    parser.add_argument("--unblended", action="store_true", help="pushed vertices don't take their neighbours along")
    cli.add_body(parser)
    parser.add_argument("--seed", type=cli.seed, metavar="S", help="of everything that is drawn (0)")
    parser.add_argument("--steps", type=cli.positive, metavar="N", help="steps of each stage (default: the preset's)")
    parser.add_argument("--device", metavar="DEVICE", help="cpu (default) or cuda")
    cli.add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.train import TrainOptions, train, training_table

    options = TrainOptions(**cli.given(args, TrainOptions))
    card = train(options, progress=not args.quiet)
    return cli.tell(args, training_table(card, options), card)
