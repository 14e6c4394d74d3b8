"""What the commands share: argument types, common options, exit codes, the JSON file."""

from __future__ import annotations

import argparse
import math
import os
import re
import stat
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from refu_core import RefuError
from refu_core._files import check_no_dead_link, expanded
from refu_core.errors import escaped, printable
from refu_core.modes import BetasSource
from refu_core.options import Spec, setting, specs_of
from refu_core.recordings import AXES
from refu_lab.tables import write_json

Number = TypeVar("Number", int, float)

EXIT_CHECK_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_BUG = 70
EXIT_INTERRUPTED = 130
EXIT_UNREAD = 141
"""Nobody reads the output any more: what a shell says of a program that SIGPIPE has ended."""
_MOST = 10**9


class Parser(argparse.ArgumentParser):
    """A parser that reports errors in one line, as for any other bad input, and that takes negative numbers."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._negative_number_matcher = re.compile(r"-[\d.]")  # argparse's own takes -1,0 for an option

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: error: {printable(message)} (see {self.prog} --help)\n")


def add_subcommands(parser: argparse.ArgumentParser, *, metavar: str) -> Any:
    """Adds subcommands to a parser, which prints its help if none is given."""

    def run(_args: argparse.Namespace) -> int:
        parser.print_help(sys.stderr)
        return EXIT_BAD_INPUT

    parser.set_defaults(run=run)
    return parser.add_subparsers(dest=metavar.lower(), metavar=metavar, parser_class=Parser)


def names(text: str) -> tuple[str, ...]:
    """Parses `A,B`: at least one name; spaces are only in paths of garments."""
    found = tuple(expanded(name.strip()) for name in text.split(",") if name.strip())
    if not found or any(len(name.split()) > 1 and not name.endswith(".npz") for name in found):
        raise argparse.ArgumentTypeError(f"wanted names with commas between them, got {printable(repr(text))}")
    return found


def numbers(count: int, *, least: int = 1) -> Callable[[str], tuple[float, ...]]:
    """A parser of `X,Y,...`: `least` to `count` numbers, the rest are zero."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(number) for number in text.split(","))
        except ValueError:
            found = ()
        if not least <= len(found) <= count or not all(map(math.isfinite, found)):
            most = f"up to {count}" if least < count else count
            raise argparse.ArgumentTypeError(f"wanted {most} finite numbers with commas between them, got {text!r}")
        return found + (0.0,) * (count - len(found))

    return parse


def _number(kind: type[Number], text: str, *, low: float, high: float) -> Number:
    try:
        number = kind(text)
    except ValueError:
        number = None
    if number is None or not low <= number <= high:
        bounds = f"from {low:g} to {high:,}"
        if high == _MOST and (number is None or number < low):  # nobody has to hear of the largest
            bounds = "above zero" if low else "of zero or more"
        msg = f"wanted a {'whole ' if kind is int else ''}number {bounds}, got {printable(repr(text))}"
        raise argparse.ArgumentTypeError(msg)
    return number


positive = partial(_number, int, low=1, high=_MOST)
seed = partial(_number, int, low=0, high=_MOST)
port = partial(_number, int, low=1, high=65_535)


def between(low: float, high: float) -> Callable[[str], float]:
    return partial(_number, float, low=low, high=high)


def in_path(text: str) -> Path:
    """The path of something to read; its reader checks whether it exists."""
    try:
        os.fsencode(text)
    except UnicodeError:
        text = ""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError("wanted a path, got nothing, or a name that no file has")
    return Path(expanded(text))


def name_or_path(text: str) -> str:
    """The name of something that ships, or the path of a file."""
    return expanded(word(text))


def _output(wanted: str, kinds: Sequence[Callable[[int], bool]], text: str) -> Path:
    """The path of something to write; whatever exists there must be of one of these kinds."""
    found = in_path(text)
    try:
        is_right = any(is_kind(found.stat().st_mode) for is_kind in kinds)
    except FileNotFoundError:
        is_right = True
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{printable(text)} can't be written: {error.strerror}") from error
    if not is_right or not found.name:
        raise argparse.ArgumentTypeError(f"wanted {wanted} to write, or a new one, not {printable(text)}")
    return found


out_file = partial(_output, "a file", [stat.S_ISREG])
out_folder = partial(_output, "a folder", [stat.S_ISDIR])


def out_picture(text: str) -> Path:
    """The path of a picture to write; with a suffix other than .png it could be some other file."""
    found = out_file(text)
    if found.suffix.lower() != ".png":
        raise argparse.ArgumentTypeError(f"wanted a name that ends in .png, got {printable(text)}")
    return found


def out_bag(text: str) -> Path:
    """The path of a bag to write, a file or a folder; a new folder isn't named like a file of another kind."""
    path = in_path(text)
    if (path.suffix[1:].isalpha() or path.suffix == ".db3") and path.suffix != ".mcap" and not path.is_dir():
        msg = f"bags are written as NAME.mcap, or as a folder, whose name has no {path.suffix}; got {printable(text)}"
        raise argparse.ArgumentTypeError(msg)
    return _output("a file or a folder", [stat.S_ISREG, stat.S_ISDIR], text)


def word(text: str) -> str:
    """Text that can be sent in a message."""
    if not text.isprintable() or not text:  # lone surrogates, which can't be encoded, aren't printable, either
        raise argparse.ArgumentTypeError(f"wanted text without control characters, got {printable(text)!r}")
    return text


def add_common(parser: argparse.ArgumentParser, run: Callable[[argparse.Namespace], int]) -> None:
    """Adds what every command has; `run` does the command's work."""
    parser.set_defaults(run=run)
    parser.add_argument("--json", type=out_file, metavar="FILE", help="write the results as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def add_options(parser: argparse.ArgumentParser, options: type) -> None:
    """Adds an option for each described field of a dataclass (`refu_core.options.setting`)."""
    for name, spec in specs_of(options).items():
        flag, told = f"--{name.replace('_', '-')}", dict[str, Any](dest=name, default=None, help=_help(spec))
        if isinstance(spec.default, bool):
            action: Any = argparse.BooleanOptionalAction if spec.default else "store_true"
            parser.add_argument(flag, action=action, **told)
        elif spec.choices:
            parser.add_argument(flag, choices=[str(choice) for choice in spec.choices], **told)
        else:
            parser.add_argument(flag, type=_parse(spec), metavar=spec.metavar or name.upper(), **told)


def _help(spec: Spec) -> str:
    text, default = spec.description.rstrip("."), spec.default
    values = default if isinstance(default, tuple) else (default,)
    is_shown = not isinstance(default, bool) and (any(values) or type(default) in (int, float))
    shown = f" ({','.join(map(str, values))})" if is_shown else ""
    return f"{text[:1].lower()}{text[1:]}{shown}".replace("%", "%%")


def _parse(spec: Spec) -> Callable[[str], Any]:
    if spec.parse is not None:
        return spec.parse
    if isinstance(spec.default, tuple):
        return names if spec.kind is str else numbers(len(spec.default))
    if spec.kind is float:
        return between(*(spec.within or (-math.inf, math.inf)))
    return (lambda text: str(in_path(text))) if spec.metavar in ("FILE", "DIR") else word


def place(text: str) -> str:
    """A path, folder, glob or URL, as it was typed."""
    return text if "://" in text else str(in_path(text))


def place_for(kind: Callable[[str], Path]) -> Callable[[str], str]:
    """A parser of an output: a path, checked by `kind`, or a URL."""
    return lambda text: word(text) if "://" in text else str(kind(text))


def axes_of(what: str, frame: str) -> Any:
    """A setting of commands that read motion files: the axes that their numbers are in."""
    return setting(
        "auto",
        f"axes of the {what} root: inferred from the people, and reported (auto); y up (smpl); z-up (AMASS); y-down (a "
        f"camera); z-down (Motion-X); or {frame} (frame)",
        choices=AXES,
    )


# Settings of commands that read motion files, dress bodies, or draw random numbers; each call makes a field.
rate_of_files = partial(
    setting, None, "frame rate of motion files, in place of their own", parse=between(0.001, 10_000), metavar="HZ"
)
worn_by = partial(
    setting,
    None,
    "body to dress: an SMPL file (.npz, official .pkl), or a built-in body's name; garments and networks are "
    "transferred to it (default: the body the garments were made for)",
    parse=name_or_path,
    metavar="FILE",
)
off_collider = partial(
    setting, True, "resolve collisions against the collider, or (--no-collider) against the raw posed body"
)
seeded = partial(setting, 0, "random seed", parse=seed, metavar="S")


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """Adds what every command has that spreads its work over processes."""
    parser.add_argument(
        "--jobs", type=positive, metavar="N", help="local processes, one thread each (1; more need the extra cluster)"
    )
    parser.add_argument(
        "--scheduler",
        type=word,
        metavar="ADDRESS",
        help="Dask scheduler whose workers do the work (docs/guide/fleets.md)",
    )


def given(args: argparse.Namespace, options: type) -> dict[str, Any]:
    """The given arguments that are fields of a dataclass, by name; the rest is left to its defaults."""
    known = {field.name for field in fields(options)}
    named = {name: value for name, value in vars(args).items() if name in known and value is not None}
    if "betas" in named and named.setdefault("betas_source", BetasSource.FIXED) != BetasSource.FIXED:
        raise RefuError(f"--betas is everybody's shape: leave it or --betas-source {named['betas_source']} out")
    return {name: tuple(value) if isinstance(value, list) else value for name, value in named.items()}


def require_use(args: argparse.Namespace, needed: Mapping[str, str]) -> None:
    """Raises `RefuError` for an option given without the one it depends on; `needed` maps the former to the latter."""
    for name, other in needed.items():
        if getattr(args, name) is not None and not getattr(args, other):
            raise RefuError(f"--{name.replace('_', '-')} is of no use without --{other}: give both, or leave it out")


def check_writable(path: Path) -> None:
    """Raises `RefuError` if a result couldn't be written, before the work is done.

    A file is first written beside its final place, so its folder must be writable, too.
    """
    folder = path.absolute() if path.is_dir() else path.absolute().parent
    while not folder.exists():
        check_no_dead_link(folder, error=RefuError)
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise RefuError(f"{path}: can't be written, {folder} is not a writable folder")
    if path.is_file() and not os.access(path, os.W_OK):
        raise RefuError(f"{path}: can't be written over, it is read-only; name another place")


def require_distinct(written: Mapping[str, Path]) -> None:
    """Raises `RefuError` if two options would write to the same place."""
    places: dict[str, str] = {}
    for option, path in written.items():
        other = places.setdefault(os.path.realpath(path), option)
        if other != option:
            raise RefuError(f"{path}: both {other} and {option} would be written there; name two places")


def require_apart(given: Path, written: Path) -> None:
    """Raises `RefuError` if the output `written` is the input `given`, or one of them lies in the other."""
    here, there = (Path(os.path.realpath(path)) for path in (given, written))  # also for links that go in a circle
    if here == there or there in here.parents or here in there.parents:
        raise RefuError(f"{written}: would be written over the input {given}; name another place")


def tell(args: argparse.Namespace, text: str, content: dict[str, Any], *, code: int = 0) -> int:
    """Writes the result as JSON if that was asked for, prints its text, and returns the exit code."""
    if args.json is not None:
        write_json(args.json, content)
    # Names of files and topics may be anybody's. Last: its reader may be gone (| head)
    print("\n".join(map(escaped, text.split("\n"))))
    return code
