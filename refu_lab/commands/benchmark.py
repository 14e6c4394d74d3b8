"""`refu benchmark`: run time against error."""

from __future__ import annotations

import argparse
from typing import Any

from refu_lab.commands import _common as cli


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "benchmark",
        help="measure run time against error of every mode and signed distance",
        description="Measure stages, signed distances, modes, persons, memory and errors side by side "
        "in one process on one core, and write a page, a JSON file and a plot.",
    )
    parser.add_argument("--garments", type=cli.names, metavar="A,B", help="what is worn, the main one first (all)")
    parser.add_argument(
        "--motions", type=cli.in_path, metavar="DIR", help="folder of AMASS-style .npz files (the bags)"
    )
    parser.add_argument("--bags", type=cli.in_path, metavar="DIR", help="the repository's bags (bags)")
    parser.add_argument("--rounds", type=cli.positive, metavar="N", help="times that all motion is run (3)")
    parser.add_argument(
        "--quick", action="store_true", help="a tiny round of one garment, as continuous integration runs it"
    )
    parser.add_argument(
        "--weights", type=cli.in_path, metavar="DIR", help="folder with a folder a garment of one's own weights"
    )
    parser.add_argument("--device", metavar="DEVICE", help="cpu, or cuda for both (default: cuda where there is one)")
    parser.add_argument(
        "--output", type=cli.out_folder, metavar="DIR", help="where page, data and plot go (docs/results)"
    )
    cli.add_body(parser)
    cli.add_collider(parser)
    cli.add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.benchmark import BenchmarkOptions, benchmark, benchmark_text, write_results

    options = BenchmarkOptions(**cli.given(args, BenchmarkOptions))
    cli.check_writable(options.output)
    result = benchmark(options, progress=not args.quiet)
    print(benchmark_text(result))
    return cli.tell(
        args,
        f"\nwrote {', '.join(map(str, write_results(result, options.output)))}",
        result.as_dict(),
        code=cli.EXIT_INTERRUPTED if result.interrupted else 0,
    )
