"""The command `refu`. Every subcommand has `--help` and `--json FILE`; bad input is one clear line and exit code 2."""

from __future__ import annotations

import signal
import sys
from typing import TYPE_CHECKING

from refu_core import RefuError, __version__
from refu_ros._commands import COMMANDS
from refu_ros._commands._common import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_INTERRUPTED, Parser

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType


def _parser() -> Parser:
    parser = Parser(prog="refu", description="Garments on SMPL bodies, free of body-garment collisions.")
    parser.add_argument("--version", action="version", version=f"refu {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for command in COMMANDS:
        command.add(commands)
    return parser


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    signal.signal(signal.SIGTERM, _interrupt)  # a terminated replay closes its bag like an interrupted one
    try:
        args = _parser().parse_args(arguments)
        code: int = args.run(args)
    except RefuError as error:
        print(f"refu: error: {' '.join(str(error).split())}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OSError as error:
        print(f"refu: error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except ModuleNotFoundError as error:  # an extra's package; those of the core are imported by every command
        print(f'refu: error: {error.name} is not installed: pip install "refu-ros[train]"', file=sys.stderr)
        return EXIT_BAD_INPUT
    except RuntimeError as error:
        from refu_core._device import is_device_loss

        if not is_device_loss(error):
            raise
        reason = str(error).splitlines()[0]
        print(f"refu: error: the device has failed: {reason}; run it again, or on the cpu", file=sys.stderr)
        return EXIT_CHECK_FAILED
    except KeyboardInterrupt:
        print("refu: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return code


if __name__ == "__main__":
    sys.exit(main())
