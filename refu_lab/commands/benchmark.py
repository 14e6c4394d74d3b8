"""`refu benchmark`: run time against error."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from refu_lab.commands._common import (
    EXIT_INTERRUPTED,
    add_body,
    add_collider,
    add_common,
    check_writable,
    given,
    in_path,
    names,
    out_folder,
    positive,
    write_json,
)


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "benchmark",
        help="measure run time against error of every mode and signed distance",
        description="Measure stages, signed distances, modes, persons, memory and errors side by side "
        "in one process on one core, and write a page, a JSON file and a plot.",
    )
    parser.add_argument("--garments", type=names, metavar="A,B", help="what is worn, the main one first (all)")
    parser.add_argument("--motions", type=in_path, metavar="DIR", help="folder of AMASS-style .npz files (the bags)")
    parser.add_argument(
        "--bags", type=in_path, default=Path("bags"), metavar="DIR", help="the repository's bags (bags)"
    )
    parser.add_argument("--rounds", type=positive, default=3, metavar="N", help="times that all motion is run (3)")
    parser.add_argument(
        "--quick", action="store_true", help="a tiny round of one garment, as continuous integration runs it"
    )
    parser.add_argument(
        "--weights", type=in_path, metavar="DIR", help="folder with a folder a garment of one's own weights"
    )
    parser.add_argument("--device", metavar="DEVICE", help="cpu, or cuda for both (default: cuda where there is one)")
    parser.add_argument("--output", type=out_folder, metavar="DIR", help="where page, data and plot go (docs/results)")
    add_body(parser)
    add_collider(parser)
    add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    from refu_lab.benchmark import OUTPUT, BenchmarkOptions, benchmark, benchmark_text, write_results

    chosen = given(args, BenchmarkOptions) | {"output": args.output or OUTPUT}
    options = BenchmarkOptions(**chosen)
    for path in (args.json, options.output):
        check_writable(path)
    result = benchmark(options, progress=not args.quiet)
    print(benchmark_text(result))
    print(f"\nwrote {', '.join(map(str, write_results(result, options.output)))}")
    write_json(args.json, result.as_dict())
    return EXIT_INTERRUPTED if result.interrupted else 0
