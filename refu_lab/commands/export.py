"""`refu export`: writes dressed persons as meshes for other programs."""

from __future__ import annotations

import argparse
from typing import Any

from refu_core.errors import printable
from refu_lab.commands import _common as cli
from refu_lab.commands.replay import RecordingOptions


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "export",
        help="write dressed persons as GLB, OBJ or USD",
        description="Dress frames of a bag or motion file and write them as meshes, garments with their UVs: a USD "
        "stage that moves, or a GLB or OBJ file a frame.",
    )
    parser.add_argument(
        "input", type=cli.in_path, metavar="INPUT", help="a bag or motion file, as refu replay takes it"
    )
    parser.add_argument(
        "--output", type=cli.out_file, required=True, metavar="FILE", help="FILE.glb, .obj, .usda or .usdc (extra usd)"
    )
    parser.add_argument("--first", type=cli.seed, default=0, metavar="N", help="number of the first frame (0)")
    parser.add_argument("--count", type=cli.positive, default=1, metavar="N", help="how many frames (1)")
    parser.add_argument("--no-body", dest="with_body", action="store_false", help="the garments alone")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    cli.add_options(parser, RecordingOptions)
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.export import export

    options = RecordingOptions(**cli.given(args, RecordingOptions))
    what = {"first": args.first, "count": args.count, "with_body": args.with_body, "overwrite": args.overwrite}
    written, warnings = export(options, args.output, **what)
    lines = [f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)" for path in written]
    lines += [printable(f"warning: {warning}") for warning in warnings]
    return cli.tell(args, "\n".join(lines), {"files": [str(path) for path in written], "warnings": warnings})
