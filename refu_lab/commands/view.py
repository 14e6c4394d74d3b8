"""`refu view`: recorded motion, dressed, in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from refu_core.keypoints import LAYOUTS
from refu_core.modes import DEFAULT_GARMENTS, DEFAULT_MARGIN, BackboneName
from refu_lab.commands._common import (
    add_axes,
    add_body,
    add_collider,
    given,
    in_path,
    names,
    numbers,
    port,
    word,
)

if TYPE_CHECKING:
    import argparse


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "view",
        help="look at recorded motion in the browser, dressed",
        description="Serve a 3D view at http://localhost:8080. A bag with garments (of refu replay, or of the node) is "
        "shown as it was recorded; motion is dressed while you look. Needs the extra view.",
    )
    parser.add_argument(
        "input", type=in_path, nargs="+", metavar="INPUT", help="a bag or motion file; of several, each is a person"
    )
    parser.add_argument("--dress", action="store_true", help="dress the motion anew, though the bag has garments")
    parser.add_argument("--port", type=port, metavar="N", help="where to listen (the first one free from 8080 on)")
    parser.add_argument(
        "--host", type=word, default="localhost", metavar="NAME", help="who may look: localhost (default); 0.0.0.0: all"
    )
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="print the address alone")
    parser.add_argument(
        "--garments",
        type=names,
        default=DEFAULT_GARMENTS,
        metavar="A,B",
        help=f"garments of one body, by name or .npz (default: {','.join(DEFAULT_GARMENTS)})",
    )
    parser.add_argument("--backbone", default=BackboneName.AUTO, metavar="NAME", help="as of refu replay (auto)")
    parser.add_argument("--sdf", default="hybrid", metavar="MODE", help="as of refu replay (hybrid)")
    parser.add_argument("--weights", type=in_path, metavar="DIR", help="weights of one's own")
    parser.add_argument("--margin", type=float, default=DEFAULT_MARGIN, metavar="M", help="clearance from the skin [m]")
    parser.add_argument("--betas", type=numbers(10), metavar="B0,…", help="shape to use instead of the recorded one")
    parser.add_argument("--style", type=numbers(4), metavar="G0,…", help="garment style γ")
    parser.add_argument("--topic", type=word, metavar="NAME", help="input topic; without it, everybody is shown")
    parser.add_argument("--input-type", type=word, metavar="TYPE", help="as of refu replay")
    parser.add_argument(
        "--keypoints", default="zed38", choices=LAYOUTS, help="which points of the body, with keypoints as input"
    )
    parser.add_argument("--person", type=word, metavar="NAME", help="whose motion, where a file has several people")
    parser.add_argument("--device", default="cpu", metavar="DEVICE", help="cpu (default) or cuda")
    add_axes(parser, "recorded", "those of the frame itself, set upright as far as it shows")
    add_body(parser)
    add_collider(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    from refu_lab.replay import ReplayOptions
    from refu_lab.view import ViewOptions, view

    replay = ReplayOptions(**given(args, ReplayOptions) | {"input": Path(), "output": None})
    view(
        ViewOptions(**given(args, ViewOptions) | {"inputs": tuple(args.input), "replay": replay}),
        progress=not args.quiet,
    )
    return 0
