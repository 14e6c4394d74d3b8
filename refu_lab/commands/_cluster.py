"""Arguments of the commands that take many inputs, or share their work."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from refu_lab.commands._common import in_path, positive, word


def place(text: str) -> str:
    """A path, folder, glob or URL, as it was typed."""
    return text if "://" in text else str(in_path(text))


def place_for(kind: Callable[[str], Path]) -> Callable[[str], str]:
    """A path that is written to, as `kind` takes it, or a URL."""
    return lambda text: word(text) if "://" in text else str(kind(text))


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """What every command has that shares its work."""
    parser.add_argument(
        "--jobs", type=positive, metavar="N", help="processes of this machine, a thread each (1; others: extra cluster)"
    )
    parser.add_argument(
        "--scheduler", type=word, metavar="ADDRESS", help="a Dask scheduler whose workers do it (docs/guide/fleets.md)"
    )
