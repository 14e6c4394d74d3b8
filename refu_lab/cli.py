"""The command `refu`. Every subcommand has `--help` and `--json FILE`; bad input is one clear line and exit code 2."""

from __future__ import annotations

import argparse
import io
import logging
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy reads it; more threads would wait for busy cores

from refu_core import RefuError, __version__
from refu_core._collector import collect_rarely
from refu_core._files import keep_streams
from refu_core.errors import printable
from refu_lab.commands import COMMANDS, _common
from refu_lab.interrupts import handled, interruptible

_OF_LAB = ("matplotlib", "PIL", "tqdm")
"""Packages of the extra `lab`; any other that may be missing belongs to `train`."""


def _parser() -> _common.Parser:
    parser = _common.Parser(prog="refu", description="Garments on SMPL bodies, free of body-garment collisions.")
    parser.add_argument("--version", action="version", version=f"refu {__version__}")
    commands = _common.add_subcommands(parser, metavar="COMMAND")
    for command in COMMANDS:
        command.add(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    keep_streams()
    collect_rarely()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal or file that has no → gets a ?
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # it warns of a home that it can't write to
    # A terminated command closes its files like an interrupted one.
    with handled({signal.SIGTERM: signal.default_int_handler}):
        return _run(arguments)


def _run(arguments: Sequence[str] | None) -> int:
    try:
        try:
            args = _parser().parse_args(arguments)
        finally:  # after its help the parser ends the program
            print(end="", flush=True)
        try:
            Path.cwd()
        except OSError as error:  # whatever needs it would name no file
            raise RefuError(f"the working directory is gone ({error.strerror}): cd to another") from error
        written = _outputs(args)
        for path in written.values():
            _common.check_writable(path)
        _common.require_distinct(written)
        for path in filter(Path.is_file, written.values()):
            for given in _inputs(args, written=path):
                _common.require_apart(given, path)
        with interruptible():
            code: int = args.run(args)
        print(end="", flush=True)
    except BrokenPipeError:  # who read the output has gone (| head)
        return _common.EXIT_UNREAD
    except RefuError as error:
        return _failed(f"error: {error}", _common.EXIT_BAD_INPUT)
    except (OSError, UnicodeError, MemoryError, RecursionError) as error:
        return _failed(f"error: {str(error) or type(error).__name__}", _common.EXIT_BAD_INPUT)
    except ModuleNotFoundError as error:  # a package of an extra: every command imports those of the core
        extra = "lab" if str(error.name).partition(".")[0] in _OF_LAB else "train"
        return _failed(f'error: {error.name} is not installed: pip install "refu-ros[{extra}]"', _common.EXIT_BAD_INPUT)
    except KeyboardInterrupt:
        return _failed("interrupted", _common.EXIT_INTERRUPTED)
    except Exception as error:
        from refu_core._device import is_device_loss

        if is_device_loss(error):
            what = f"error: the device has failed: {str(error).splitlines()[0]}; run it again, or on the cpu"
            return _failed(what, _common.EXIT_CHECK_FAILED)
        what = f"{type(error).__name__}: {error}"
        return _failed(f"a bug of refu, please report it; REFU_DEBUG=1 shows where: {what}", _common.EXIT_BUG)
    finally:
        _drop_unwritable()
    return code


def _drop_unwritable() -> None:
    """Output that can't be written goes nowhere: at its end the interpreter would try again, and complain."""
    try:
        print(end="", flush=True)
    except OSError:
        with suppress(OSError):  # it may be no file
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


_WRITTEN = ("json", "output", "report", "picture")
"""Options whose values are written to."""


def _outputs(args: argparse.Namespace) -> dict[str, Path]:
    """The files and folders that a command writes, by option."""
    given = {name: getattr(args, name, None) for name in _WRITTEN}
    return {f"--{name}": Path(path) for name, path in given.items() if path is not None and "://" not in str(path)}


def _inputs(args: argparse.Namespace, *, written: Path) -> list[Path]:
    """A command's inputs that writing the file `written` could destroy: recordings, and any input that is that file."""
    flat = [
        (name, one)
        for name, value in vars(args).items()
        for one in (value if isinstance(value, (list, tuple)) else [value])
        if name not in _WRITTEN and isinstance(one, (str, Path)) and os.path.exists(one)  # noqa: PTH110  (any text)
    ]
    return [Path(one) for name, one in flat if name == "input" or written.samefile(one)]


def _failed(reason: str, code: int) -> int:
    """Prints the reason in one line, with REFU_DEBUG also the traceback; returns the code."""
    if os.environ.get("REFU_DEBUG") and code != _common.EXIT_INTERRUPTED:
        traceback.print_exc()
    print(f"refu: {printable(reason)}", file=sys.stderr)
    return code
