"""`refu garment`: garments of one's own."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from refu_lab.commands import _common as cli


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "garment",
        help="add a garment of your own, or list those that there are",
        description="Garments are files. Some ship; yours are in a folder, and anywhere by their path.",
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _add_add(actions)
    listing = actions.add_parser("list", help="the garments that have a name", description="The garments by name.")
    cli.add_common(listing)
    listing.set_defaults(run=run_list)


def _add_add(actions: Any) -> None:
    parser = actions.add_parser(
        "add",
        help="make a garment of a mesh",
        description="Make a garment of a mesh (OBJ, PLY, STL, OFF, GLB) that was modelled round a body: its unit, "
        "axes, place and pose are found out, unless they are given. It can be worn at once, simulated and trained.",
    )
    parser.add_argument("mesh", type=cli.in_path, metavar="MESH", help="the mesh's file")
    parser.add_argument("--body", metavar="BODY", help="male, female or neutral (default)")
    parser.add_argument("--name", type=cli.word, metavar="NAME", help="what it is called (default: as the mesh's file)")
    parser.add_argument(
        "--output", type=cli.out_file, metavar="FILE", help="where it goes (default: NAME.npz in the user's folder)"
    )
    parser.add_argument("--layer", type=int, metavar="N", help="0 under 1 under 2 … (1)")
    parser.add_argument("--color", type=cli.numbers(3), metavar="R,G,B", help="sRGB, each from 0 to 1")
    parser.add_argument("--held-at", choices=("waist", "shoulders"), help="what holds it (default: as its place says)")
    parser.add_argument("--unit", type=cli.word, metavar="U", help="of lengths: m, dm, cm, mm, in, or metres of one")
    parser.add_argument("--up", choices=("y", "z"), help="the axis that is up")
    parser.add_argument(
        "--pose", type=cli.word, metavar="POSE", help="it was modelled in: t, degrees of hanging arms, or a motion .npz"
    )
    parser.add_argument(
        "--as-placed", action="store_true", help="its origin is the body's own: don't look for another place"
    )
    parser.add_argument(
        "--longest-edge", type=cli.between(0.005, 0.2), metavar="M", help="longer edges are split [m] (0.02)"
    )
    parser.add_argument("--source", type=cli.word, metavar="TEXT", help="author and licence")
    parser.add_argument("--picture", type=cli.out_file, metavar="FILE", help="write a picture (.png) of it, worn")
    parser.add_argument("--overwrite", action="store_true", help="replace a garment that is there already")
    cli.add_common(parser)
    parser.set_defaults(run=run_add)


def run_add(args: argparse.Namespace) -> int:
    from refu_lab.garment import AddOptions, add_garment, added_text

    if not args.quiet:
        print(f"{args.mesh}: looking for its unit, its axes and its place on the body …", file=sys.stderr, flush=True)
    result = add_garment(AddOptions(**cli.given(args, AddOptions)))
    return cli.tell(args, added_text(result), result)


def run_list(args: argparse.Namespace) -> int:
    from refu_core.garments import garments_folder
    from refu_lab.garment import garments_table, list_garments

    rows = list_garments()
    print(garments_table(rows))
    return cli.tell(
        args, f"yours go to {garments_folder()} (REFU_GARMENTS)", {"folder": str(garments_folder()), "garments": rows}
    )
