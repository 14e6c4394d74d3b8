"""`refu view`: recorded motion, dressed, or a node that runs, in the browser."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from refu_lab.commands import _common as cli


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "view",
        help="look at recorded motion, dressed, or at a node that runs, in the browser",
        description="Serve a 3D view at http://localhost:8080. A bag with garments (of refu replay, or of the node) is "
        "shown as it was recorded; motion is dressed while you look; a running node is shown live. Needs the extra "
        "view.",
    )
    parser.add_argument(
        "input", type=cli.in_path, nargs="*", metavar="INPUT", help="a bag or motion file; of several, each is a person"
    )
    parser.add_argument(
        "--live",
        type=cli.word,
        nargs="*",
        metavar="TOPIC",
        help="what a running node publishes on topics of markers (garments, body), in place of INPUT; needs rclpy",
    )
    parser.add_argument("--dress", action="store_true", help="dress the motion anew, though the bag has garments")
    parser.add_argument("--port", type=cli.port, metavar="N", help="where to listen (the first one free from 8080 on)")
    parser.add_argument("--host", type=cli.word, metavar="NAME", help="who may look: localhost (default); 0.0.0.0: all")
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="print the address alone")
    cli.add_pipeline(parser)
    cli.add_recording(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.replay import ReplayOptions
    from refu_lab.view import ViewOptions, view

    replay = ReplayOptions(**cli.given(args, ReplayOptions) | {"input": Path(), "output": None})
    options = ViewOptions(**cli.given(args, ViewOptions) | {"inputs": tuple(args.input), "replay": replay})
    view(options, progress=not args.quiet)
    return 0
