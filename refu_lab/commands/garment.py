"""`refu garment`: adds your own garments and lists all."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refu_core.options import setting
from refu_lab.commands import _common as cli


@dataclass(frozen=True, kw_only=True)
class AddOptions:
    mesh: Path
    body: str = setting("neutral", "male, female or neutral")
    name: str | None = setting(None, "its name (default: that of the mesh's file)")
    output: Path | None = setting(
        None, "file to write (default: NAME.npz in the user's folder)", parse=cli.out_file, metavar="FILE"
    )
    layer: int = setting(1, "lower layers are worn underneath", parse=int, metavar="N")
    color: tuple[float, float, float] | None = setting(
        None, "sRGB, each from 0 to 1", parse=cli.numbers(3, least=3), metavar="R,G,B"
    )
    held_at: str | None = setting(
        None, "what holds it: waist or shoulders (default: found from where it lies)", choices=("waist", "shoulders")
    )
    unit: str | None = setting(None, "unit of length: m, dm, cm, mm, in, or how many metres one is", metavar="U")
    up: str | None = setting(None, "the axis that is up", choices=("y", "z"))
    pose: str | None = setting(None, "pose it was modelled in: t, how far the arms hang [degrees], or a motion .npz")
    as_placed: bool = setting(False, "its origin is the body's own: don't look for another place")
    longest_edge: float = setting(0.02, "longer edges are split [m]", within=(0.005, 0.2), metavar="M")
    source: str = setting("a mesh of the user's", "author and licence", metavar="TEXT")
    picture: Path | None = setting(None, "write a picture (.png) of it, worn", parse=cli.out_picture, metavar="FILE")
    overwrite: bool = setting(False, "replace an existing garment")


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "garment",
        help="add a garment of your own, or list all garments",
        description="Garments are files. Some ship; yours are in a folder, and anywhere by their path.",
    )
    actions = cli.add_subcommands(parser, metavar="ACTION")
    adding = actions.add_parser(
        "add",
        help="make a garment of a mesh",
        description="Make a garment of a mesh (OBJ, PLY, STL, OFF, GLB) that was modelled round a body: its unit, "
        "axes, place and pose are inferred unless they are given. It can be worn at once, simulated and trained.",
    )
    adding.add_argument("mesh", type=cli.in_path, metavar="MESH", help="the mesh's file")
    cli.add_options(adding, AddOptions)
    cli.add_common(adding, run_add)
    listing = actions.add_parser("list", help="the garments that have a name", description="The garments by name.")
    cli.add_common(listing, run_list)


def run_add(args: argparse.Namespace) -> int:
    from refu_lab.garment import add_garment, added_text

    if not args.quiet:
        print(f"{args.mesh}: looking for its unit, its axes and its place on the body …", file=sys.stderr, flush=True)
    result = add_garment(AddOptions(**cli.given(args, AddOptions)))
    return cli.tell(args, added_text(result), result)


def run_list(args: argparse.Namespace) -> int:
    from refu_core.garments import garments_folder
    from refu_lab.garment import garments_table, list_garments

    rows, folder = list_garments(), garments_folder()
    text = f"{garments_table(rows)}\nyours go to {folder} (REFU_GARMENTS)"
    return cli.tell(args, text, {"folder": str(folder), "garments": rows})
