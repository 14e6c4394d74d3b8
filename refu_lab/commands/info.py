"""`refu info`: what is installed, built in and usable."""

from __future__ import annotations

import argparse
from typing import Any

from refu_lab.commands._common import add_common, write_json


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "info", help="what is installed, built in and usable", description="What is installed."
    )
    parser.add_argument("--body", metavar="FILE", help="say what a body model (.npz or official .pkl) holds instead")
    add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    from refu_lab.info import collect, describe_body

    facts = collect() if args.body is None else describe_body(args.body)
    for name, value in facts.items():
        print(f"{name:>19}  {value if isinstance(value, str) else _short(value)}")
    write_json(args.json, facts)
    return 0


def _short(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)
