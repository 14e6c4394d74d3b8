"""`refu export`: dressed persons as meshes for other programs."""

from __future__ import annotations

import argparse
from typing import Any

from refu_lab.commands._common import (
    add_common,
    add_pipeline,
    add_recording,
    check_writable,
    given,
    in_path,
    out_file,
    positive,
    seed,
    write_json,
)


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "export",
        help="write dressed persons as GLB, OBJ or USD",
        description="Dress frames of a bag or motion file and write them as meshes, garments with their UVs: a USD "
        "stage that moves, or a GLB or OBJ file a frame.",
    )
    parser.add_argument("input", type=in_path, metavar="INPUT", help="a bag or motion file, as refu replay takes it")
    parser.add_argument(
        "--output", type=out_file, required=True, metavar="FILE", help="FILE.glb, .obj, .usda or .usdc (extra usd)"
    )
    parser.add_argument("--first", type=seed, default=0, metavar="N", help="number of the first frame (0)")
    parser.add_argument("--count", type=positive, default=1, metavar="N", help="how many frames (1)")
    parser.add_argument("--no-body", dest="with_body", action="store_false", help="the garments alone")
    add_pipeline(parser)
    add_recording(parser)
    add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    from refu_lab.export import export
    from refu_lab.replay import ReplayOptions

    for path in (args.json, args.output):
        check_writable(path)
    options = ReplayOptions(**{**given(args, ReplayOptions), "output": None})
    written, warnings = export(options, args.output, first=args.first, count=args.count, with_body=args.with_body)
    for path in written:
        print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")
    for warning in warnings:
        print(f"warning: {warning}")
    write_json(args.json, {"files": [str(path) for path in written], "warnings": warnings})
    return 0
