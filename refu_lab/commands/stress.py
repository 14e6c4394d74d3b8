"""`refu stress`: attempts to break the pipeline."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from refu_lab.commands import _common as cli


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "stress",
        help="try to break the pipeline: numbers, guarantees, invariance, endurance",
        description="Run random and adversarial frames through the pipeline and hold the results against float64 and "
        "against what is promised; the worst trial of each check is kept as a file. Exits with 1 where one failed.",
    )
    parser.add_argument(
        "--parts", type=cli.names, metavar="A,B", help="numbers, guarantees, invariance, soak (default: all)"
    )
    parser.add_argument("--garments", type=cli.names, metavar="A,B", help="garments of any body (default: all four)")
    parser.add_argument(
        "--backbone", metavar="NAME", help="one mode (default: skinned accurate, tailornet accurate and hybrid)"
    )
    parser.add_argument("--sdf", metavar="MODE", help="accurate, hybrid, approx or none, with --backbone")
    parser.add_argument(
        "--weights", type=cli.in_path, metavar="DIR", help="folder with a folder a garment of weights of one's own"
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--quick", action="store_true", help="each check once: for CI")
    length.add_argument(
        "--hours", type=cli.between(0, 10_000), metavar="H", help="go on for so long (default: some minutes)"
    )
    parser.add_argument("--rounds", type=cli.positive, metavar="N", help="turns of each check (3)")
    parser.add_argument("--frames", type=cli.positive, metavar="N", help="frames of each soak (3000)")
    parser.add_argument(
        "--persons", type=cli.positive, metavar="P", help="persons of a soak, each one's frame counting (1)"
    )
    parser.add_argument("--seed", type=cli.seed, metavar="S", help="of everything that is drawn (0)")
    parser.add_argument(
        "--output",
        type=cli.out_folder,
        default=Path("stress"),
        metavar="DIR",
        help="where the worst trials go (stress)",
    )
    parser.add_argument("--replay", type=cli.in_path, metavar="FILE", help="try one of them again, and nothing else")
    cli.add_collider(parser)
    cli.add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.stress import StressOptions, StressResult, replay_trial, run_stress, stress_table

    options = StressOptions(**cli.given(args, StressOptions))
    if args.replay is not None:
        result = StressResult(tallies=[replay_trial(args.replay, weights=options.weights, collider=options.collider)])
    else:
        result = run_stress(
            options, progress=not args.quiet, report=lambda so_far: cli.write_json(args.json, so_far.as_dict())
        )
    return cli.tell(args, stress_table(result), result.as_dict(), code=cli.EXIT_CHECK_FAILED if result.failures else 0)
