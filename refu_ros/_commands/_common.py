"""What the commands share: types of arguments, common options, exit codes, the JSON file."""

from __future__ import annotations

import argparse
import json
import math
import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from refu_core import RefuError

if TYPE_CHECKING:
    from collections.abc import Callable

EXIT_CHECK_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


class Parser(argparse.ArgumentParser):
    """Whose errors are one line, as for every other kind of bad input."""

    def error(self, message: str) -> NoReturn:
        """Ends the program."""
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def names(text: str) -> tuple[str, ...]:
    """`A,B`: one name at least."""
    found = tuple(name.strip() for name in text.split(",") if name.strip())
    if not found:
        msg = "wanted one name or several with commas between them"
        raise argparse.ArgumentTypeError(msg)
    return found


def numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    """`X,Y,...`: up to `count` of them; the rest are zero."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(number) for number in text.split(","))
        except ValueError:
            found = ()
        if not 1 <= len(found) <= count or not all(map(math.isfinite, found)):
            msg = f"wanted up to {count} finite numbers with commas between them, got {text!r}"
            raise argparse.ArgumentTypeError(msg)
        return found + (0.0,) * (count - len(found))

    return parse


def positive(text: str) -> int:
    """A whole number above zero."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        msg = f"wanted a whole number above zero, got {text!r}"
        raise argparse.ArgumentTypeError(msg)
    return number


def shard(text: str) -> tuple[int, int]:
    """`I/N`: the I-th of N parts, from 0."""
    index, _, count = text.partition("/")
    if not (index.isdigit() and count.isdigit() and int(index) < int(count)):
        msg = f"wanted I/N with 0 <= I < N, such as 0/4, got {text!r}"
        raise argparse.ArgumentTypeError(msg)
    return int(index), int(count)


def add_common(parser: argparse.ArgumentParser) -> None:
    """What every command has."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def given(args: argparse.Namespace, options: type) -> dict[str, Any]:
    """The arguments that are fields of a dataclass of options, by name."""
    names_of_fields = {field.name for field in fields(options)}
    return {name: value for name, value in vars(args).items() if name in names_of_fields}


def check_writable(path: Path | None) -> None:
    """Raises `RefuError` before the work is done where its result couldn't be written."""
    if path is None:
        return
    existing = path.absolute()
    while not existing.exists():
        existing = existing.parent
    if not os.access(existing, os.W_OK) or (existing != path.absolute() and not existing.is_dir()):
        msg = f"{path}: can't be written, {existing} is not a writable folder"
        raise RefuError(msg)


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    """Writes it where a path was given."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
