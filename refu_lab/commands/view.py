"""`refu view`: shows recorded motion, dressed, or a running node in the browser."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refu_core.options import setting
from refu_lab.commands import _common as cli
from refu_lab.commands.replay import RecordingOptions


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    inputs: tuple[Path, ...] = ()
    live: tuple[str, ...] | None = None
    """Marker topics to show in place of inputs; if empty, the node's own; None shows the inputs."""
    dressing: RecordingOptions
    """How motion is dressed; its `input` is ignored."""
    dress: bool = setting(False, "dress the motion again, even if the bag has garments")
    host: str = setting("localhost", "address to listen on; 0.0.0.0: all", metavar="NAME")
    port: int | None = setting(
        None, "where to listen: the first one free from 8080 on, if not given", parse=cli.port, metavar="N"
    )
    browser: bool = setting(True, "open the address in a browser; without, it is printed alone")


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "view",
        help="show dressed motion, or a running node, in the browser",
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
    cli.add_options(parser, ViewOptions)
    cli.add_options(parser, RecordingOptions)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.view import view

    dressing = RecordingOptions(**cli.given(args, RecordingOptions) | {"input": Path()})
    options = ViewOptions(**cli.given(args, ViewOptions) | {"inputs": tuple(args.input), "dressing": dressing})
    view(options, progress=not args.quiet)
    return 0
