"""`refu info`: shows what is installed, built in and usable."""

from __future__ import annotations

import argparse
from typing import Any

from refu_lab.commands import _common as cli


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "info", help="what is installed, built in and usable", description="What is installed."
    )
    parser.add_argument(
        "--body",
        type=cli.name_or_path,
        metavar="FILE",
        help="say what a body model (.npz or official .pkl) holds instead",
    )
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.info import collect, describe_body

    facts = collect() if args.body is None else describe_body(args.body)
    lines = (f"{name:>19}  {_short(value)}" for name, value in facts.items())
    return cli.tell(args, "\n".join(lines), facts)


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return f"\n{'':>21}".join(f"{name}: {_short(one)}" for name, one in value.items())
    if isinstance(value, list):
        return ", ".join(map(_short, value))
    return f"{value:.2f}" if isinstance(value, float) else str(value)
